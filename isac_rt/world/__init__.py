"""The world before any wave: the city's mesh and the swarm's flights."""
