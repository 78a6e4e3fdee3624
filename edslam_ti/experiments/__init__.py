"""Measurements over many recordings: the runs of `edslam reproduce`, and its tables."""
