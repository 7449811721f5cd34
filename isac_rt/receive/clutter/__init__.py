"""Clutter at the receiver: filtered, predicted from the mesh, whitened, and detectors that look
beside it."""
