"""IF samples from paths and payload, by methods of different accuracy, and thermal noise."""
