"""Symbol decisions of a passive terminal."""
