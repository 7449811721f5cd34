"""Results of a run: records and scores of every frame, one dataset, one summary, files."""
