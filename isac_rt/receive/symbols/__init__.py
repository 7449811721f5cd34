"""How a passive terminal reads symbols."""
