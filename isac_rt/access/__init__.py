"""How terminals share the band and find each other: Chirp-DMA, on-off keyed messages, the stages
before the data, and feedback."""
