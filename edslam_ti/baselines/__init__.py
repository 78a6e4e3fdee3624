"""Trackers and mappers made of other people's libraries, to compare with."""
