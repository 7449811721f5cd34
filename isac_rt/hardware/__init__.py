"""What a terminal's hardware does to the signal: oscillators, channels, converters. No paths and no
receivers here: `isac_rt.signal.received` applies these models to the samples."""
