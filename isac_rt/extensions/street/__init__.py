"""The street lives: rotors and airframes, rain, foreign radars."""
