"""Writes any sequence in one of our own layouts, without loss.

events.py writes events slice by slice, pictures.py depth and grey images, layouts.py whole recordings.
"""

from edslam_ti.conversion.layouts import LAYOUTS, Summary, convert

__all__ = ["LAYOUTS", "Summary", "convert"]
