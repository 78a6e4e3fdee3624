"""Clocks of a recording: gives all stamps one zero, and checks that they belong to one clock.

Kernels count integer microseconds in 32 bits. Therefore a recording whose first event is later than
`LATEST_START` (stamps since the epoch or since boot) is shifted. The shift is in whole seconds, which
preserves differences of stamps to the last bit.
"""

import math
from pathlib import Path

import numpy as np

from edslam_ti.datasets.base import EventDepthSequence, stamp_text
from edslam_ti.errors import DataError

LATEST_START = 1000.0  # s; 32-bit microseconds overflow at 2147 s
OTHER_UNIT = 300  # stamps whose span is this many times longer or shorter are in another unit
UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
LITTLE = 0.5  # of the events' time
VERY_LITTLE = 0.15  # at 100 images per second, indices read as milliseconds span a tenth of the true time
FASTEST_DEPTH = 100.0  # Hz; depth cameras take up to 90 images per second


def clock_offset(first: float) -> float:
    """Return the whole seconds to subtract from all stamps of a recording that begins at `first`."""
    return float(math.floor(first)) if abs(first) > LATEST_START else 0.0


def check_clock(
    sequence: EventDepthSequence,  # its time_range and time_offset are those of the events
    folder: Path,
    name: str,  # of the file or the folder, for messages
    stamps: np.ndarray,  # [N] s, increasing, shifted as the sequence's
) -> None:
    """Refuse stamps outside the events' times: they belong to another clock, or are in another unit."""
    if len(stamps) == 0:
        return
    first, last = sequence.time_range
    length, duration = float(stamps[-1] - stamps[0]), last - first + 1e-3
    slack = min(1.0, 0.1 * duration)
    inside = int(((stamps >= first - slack) & (stamps <= last + slack)).sum())
    covers = stamps[0] <= last + slack and stamps[-1] >= first - slack
    too_short = length > 0 and length * OTHER_UNIT < duration
    too_long = length > duration * OTHER_UNIT and inside < 2
    if covers and not too_short and not too_long:
        return
    own = np.array([stamps[0], stamps[-1]]) + sequence.time_offset
    events = np.array([first, last]) + sequence.time_offset
    hint = ""
    for unit, factor in UNITS.items():
        if np.abs(own / factor - events).max() < 0.5 * duration:
            hint = f"; {name} looks as if it were in {unit}"
        if np.abs(events / factor - own).max() < 0.5 * length:
            hint = f"; the events look as if they were in {unit}"
    raise DataError(
        f"{folder}: the clocks differ: {name} covers {own[0]:.12g} to {own[1]:.12g} s, events "
        f"{events[0]:.12g} to {events[1]:.12g} s{hint}; expected the same clock, in seconds"
    )


def check_milliseconds(
    sequence: EventDepthSequence,
    folder: Path,  # of the images
    numbers: list[int],  # of their names, increasing
    rate: str,  # the key of camera.json that states their rate
) -> None:
    """Refuse numbers that are indices, not milliseconds: their span is far shorter than the events'."""
    steps = np.diff(np.array(numbers, float))
    first, last = sequence.time_range
    if len(steps) == 0:
        return
    length, duration = steps.sum() / 1000, last - first
    is_steady = len(steps) > 1 and bool((steps == steps[0]).all())
    is_fast = np.median(steps) <= 1000 / FASTEST_DEPTH
    is_short = is_fast and length < LITTLE * duration
    # `check_clock` handles other factors, those between milliseconds and seconds.
    is_shorter = is_steady and duration / OTHER_UNIT < length < VERY_LITTLE * duration
    if not is_short and not is_shorter:
        return
    raise DataError(
        f"{folder}: the numbers in the names look like indices, not milliseconds: {len(numbers)} files, "
        f"{numbers[0]} to {numbers[-1]}, would span {length:.3g} s, the events span {duration:.3g} s; state "
        f"their rate in Hz (--depth-rate for depth, or '{rate}' in camera.json), or their times in "
        f"{folder.name}/timestamps.txt, lines 'number seconds'"
    )


def note_coverage(sequence: EventDepthSequence) -> None:
    """Add a note if depth covers less than half of the events' time."""
    first, last = sequence.time_range
    stamps = sequence.depth_timestamps
    duration = last - first
    covered = min(last, float(stamps[-1])) - max(first, float(stamps[0]))
    if duration > 0 and covered < LITTLE * duration:
        sequence.note(
            f"depth covers {max(covered, 0.0):.3g} s of the events' {duration:.3g} s: {len(stamps)} images, "
            f"{stamp_text(sequence, stamps[0])} to {stamp_text(sequence, stamps[-1])} s"
        )
