"""Reads event files in tests."""

import numpy as np

from edslam_ti.event_files import EventStream
from edslam_ti.events import Events


def everything(stream: EventStream) -> Events:
    """Return all events of a stream."""
    first, last = stream.time_range
    return stream.between(first, np.nextafter(last, np.inf))
