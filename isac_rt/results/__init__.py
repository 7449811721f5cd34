"""What a run leaves: records and scores of every frame, one dataset, one summary, files."""
