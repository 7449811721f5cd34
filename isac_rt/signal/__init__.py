"""Paths and payload to IF samples, by several methods that are as exact as the scene needs, and the
noise."""
