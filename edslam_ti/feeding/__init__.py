"""Data that come while they are processed: taken in, cut into samples, and run."""
