"""Compiled building blocks that no physics is in: vectors of 16 float32, and a Fourier transform
over them."""
