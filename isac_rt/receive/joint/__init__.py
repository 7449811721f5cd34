"""All paths at once on the samples, at the Cramer-Rao bound."""
