"""Shared use of the band: Chirp-DMA, on-off keyed messages, the stages before the data, and
feedback."""
