"""Measurements over many recordings: what `apps/reproduce.py` runs, and how its tables come about."""
