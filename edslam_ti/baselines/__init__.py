"""Trackers and mappers from other people's libraries, for comparison."""
