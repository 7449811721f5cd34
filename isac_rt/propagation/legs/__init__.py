"""Ways from one end to the other over walls, edges and UAVs, in float64: what a path of several
legs is made of."""
