"""Fused tracks of cooperating terminals, by messages with tracks or with detections."""
