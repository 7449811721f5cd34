"""How terminals share the band and find each other: Chirp-DMA, on-off keyed messages, and the stages before the data."""
