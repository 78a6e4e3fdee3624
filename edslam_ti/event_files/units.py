"""Detects the unit of a file's stamps from its values."""

from typing import Protocol

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.checks import LONGEST_RECORDING
from edslam_ti.event_files.stream import Clock

EPOCH_NANOSECONDS = 1e17  # larger whole numbers are nanoseconds since the epoch; 1e17 us are 3000 years
EDGE = 1000  # stamps looked at, at either end
ENOUGH_TO_TELL = 10  # different stamps; fewer whole ones may be seconds by chance


class Stamps(Protocol):
    """Numbers for the time of events, in the order of the file."""

    def __len__(self) -> int: ...

    def times(self, start: int, end: int) -> np.ndarray: ...


def clock_of(stamps: Stamps, name: str, offset: int = 0) -> Clock:
    """Return the clock of stamps: whole numbers are microseconds, also where they are stored as floats.

    They are nanoseconds if they would be a date after the year 5000 in microseconds, or a recording of more
    than two days. Numbers with fractions are seconds; raises `DataError` where they cannot be.
    """
    number = len(stamps)
    parts = [stamps.times(0, min(EDGE, number)), stamps.times(max(0, number - EDGE), number)]
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return Clock(1e6, offset)
    first, last = (float(np.median(part[np.isfinite(part)])) if len(part) else 0.0 for part in parts)
    span = last - first
    is_whole = values.dtype.kind != "f" or (
        len(np.unique(values)) >= ENOUGH_TO_TELL and bool((values == np.rint(values)).all())
    )
    if is_whole:
        is_late = abs(float(values[0]) + offset) > EPOCH_NANOSECONDS
        return Clock(1e9 if is_late or span > LONGEST_RECORDING * 1e6 else 1e6, offset)
    if span > LONGEST_RECORDING:
        raise DataError(
            f"{name}: expected times in seconds, got {span / 86400:.3g} days of recording; these look like "
            "micro- or nanoseconds: divide them by 1e6 or 1e9, or save whole microseconds"
        )
    return Clock(1.0, offset)
