"""Measurements over many recordings: what `edslam reproduce` runs, and how its tables come about."""
