"""The results folder of a run: written, read, drawn."""
