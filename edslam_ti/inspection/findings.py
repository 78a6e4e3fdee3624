"""What an inspection finds wrong in a recording."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A likely fault, and what to do about it."""

    fault: str  # which kind, as FAULTS names it
    text: str  # one line: what is seen, what it looks like, what to do


FAULTS = (
    *("event_gap", "depth_gap", "hot_pixels", "one_polarity", "inverted_polarity"),
    *("swapped_axes", "mirrored_events", "unrelated_images", "mirrored_depth", "frozen_depth"),
    *("depth_unit", "depth_elsewhere", "depth_turned", "refused", "no_depth", "depth_coverage"),
    *("truth_convention", "truth_scale", "truth_elsewhere", "truth_coverage", "truth_jumps"),
    *("depth_clock", "events_clock", "images_clock", "truth_clock"),
)
