"""Judges a recording before it is run: numbers, faults with what to do about them, and one picture.

streams.py looks at each stream by itself, image_check.py at events beside grey images, pose_check.py at true
poses beside depth, edge_check.py at depth edges beside events, tracked.py at events beside depth through the
tracker, clock_offsets.py puts the offsets between streams together, report.py all of it.
"""
