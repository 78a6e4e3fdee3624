"""Trackers and mappers from other libraries, for comparison."""
