"""Propagation: poses in, path sets out."""
