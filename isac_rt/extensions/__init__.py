"""Parts beyond the core, each loaded by its name in `isac_rt.registry`; no room imports them."""
