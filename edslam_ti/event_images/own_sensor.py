"""What a run finds out about its event sensor from its own recording, before the first frame."""

from dataclasses import replace

from edslam_ti.datasets.base import FIRST_HISTORY, EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.event_images.contrast import ContrastThreshold, contrast_threshold
from edslam_ti.event_images.sensor import SensorEstimate, estimate_sensor
from edslam_ti.event_images.start_bias import start_bias


def own_sensor(
    threshold: float | None,  # that the settings state
    dead_time: float | None,  # seconds, the same
    sequence: EventDepthSequence,
    start: float,  # seconds
    end: float,
) -> tuple[ContrastThreshold, SensorEstimate | None]:
    """Return contrast threshold, dead time and start of the pixels; and what the events in [start, end] show.

    The second is None where there are no events, or where they cannot be read that far.
    """
    sensor = _examined(sequence, start, end)
    if dead_time is None:
        dead_time = (sensor.dead_time if sensor is not None else None) or 0.0
    found = contrast_threshold(threshold, sequence, start, end, dead_time)
    if not dead_time and (sensor is None or not sensor.is_noisy):
        return found, sensor
    begin = max(start - FIRST_HISTORY, sequence.time_range[0])
    bias = start_bias(sequence, begin, found.relative)
    return replace(found, start_bias=bias, has_faults=True), sensor


def _examined(sequence: EventDepthSequence, start: float, end: float) -> SensorEstimate | None:
    if not sequence.has_events:
        return None
    try:
        return estimate_sensor(sequence, start, end)
    except (DataError, OSError) as error:
        sequence.note(f"the event sensor is not examined: {error}")
        return None
