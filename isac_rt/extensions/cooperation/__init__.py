"""Fused tracks of cooperating terminals, which exchange the detections of their tracks."""
