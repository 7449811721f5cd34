"""From a scenario to results: set-up, plan, the loop over the frames, and going on after a stop."""
