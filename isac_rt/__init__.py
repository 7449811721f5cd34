"""isac_rt: ray-traced integrated sensing and communication with UAV swarms over cities at 77 GHz."""
