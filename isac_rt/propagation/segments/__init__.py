"""Path segments from one end to the other over walls, edges and UAVs, in float64."""
