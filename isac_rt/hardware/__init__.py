"""Models of a terminal's hardware: oscillators, channels, converters. No paths and no receivers
here: `isac_rt.signal.received` applies these models to the samples."""
