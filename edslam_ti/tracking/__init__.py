"""Poses from events and depth (Sec. III-B)."""
