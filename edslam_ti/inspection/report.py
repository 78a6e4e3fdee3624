"""Everything that an inspection finds of a recording."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edslam_ti.config import Config, dataset_differences
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.event_images.sensor import SensorEstimate, estimate_sensor
from edslam_ti.inspection.calibration import DepthCalibration, calibrate_depth
from edslam_ti.inspection.clock_offsets import Offset, clock_findings
from edslam_ti.inspection.edge_check import EdgeCheck, check_edges
from edslam_ti.inspection.event_volume import EventVolume, liveliest_part
from edslam_ti.inspection.findings import Finding
from edslam_ti.inspection.image_check import (
    TRANSFORMS,
    ImageCheck,
    TransformedEvents,
    check_images,
)
from edslam_ti.inspection.pose_check import TOLERANCE, PoseCheck, check_poses, fits_better
from edslam_ti.inspection.streams import (
    DepthFacts,
    EventFacts,
    depth_facts,
    depth_findings,
    event_facts,
    event_findings,
    truth_findings,
)
from edslam_ti.inspection.tracked import Tracked, track

MOST_LOST = 0.1  # share of the frames
# Times the expected difference of poses by depth and by brightness: of good recordings up to 8.2, and up to
# 5.6 after the delay and the rotation that suit them best are taken back.
SUSPICIOUS, CONTRADICTION = 6.0, 8.0
SURE, SMALLEST_DELAY = 4.5, 0.004  # standard deviations, s
SMALLEST_TURN, TURNED = 0.7, 0.6  # degrees; share of the misfit that remains if depth is turned back
RESOLVED = 0.5  # a delay explains a contradiction if at most this share of it remains without the delay
STANDS_OUT, HIDDEN = 4.0, 1.7  # heights of a peak of depth edges in events: clear, and none
# Faults with which tracking makes no sense.
CERTAIN = ("swapped_axes", "mirrored_events", "mirrored_depth", "frozen_depth", "no_depth", "one_polarity")
LATE_TRACKER = 0.004  # s, bias of the tracker's delay, besides its own deviation

Progress = Callable[[str], None]  # receives what is being looked at


@dataclass(frozen=True)
class Checks:
    """What a recording is, and what looks wrong in it without tracking."""

    part: tuple[float, float]  # s, looked at closely
    events: EventFacts | None
    depth: DepthFacts | None
    images: ImageCheck | None
    poses: PoseCheck | None
    edges: EdgeCheck | None
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Report:
    """What a recording is, and what looks wrong in it."""

    sequence: EventDepthSequence
    checks: Checks
    tracked: Tracked | None
    sensor: SensorEstimate | None  # None: there are no events
    findings: tuple[Finding, ...]


def inspect(sequence: EventDepthSequence, config: Config, progress: Progress) -> Report:
    """Return a report on a recording; Taichi must have been started."""
    config = config.updated(dataset_differences(sequence.preset or sequence.dataset))
    checks = check(sequence, progress)
    findings, offsets = list(checks.findings), offsets_of(checks)
    tracked, poses = None, checks.poses
    is_certain = any(f.fault in CERTAIN for f in findings)
    if sequence.has_events and checks.depth is not None and not is_certain:
        progress("tracking")
        tracked, found, delay = _track(sequence, config, checks, progress)
        findings += found
        offsets += delay
        if delay and tracked is not None and poses is not None and poses.is_good:
            findings += fits_better(sequence, tracked.trajectory, poses, *checks.part)
    if not any(f.fault in ("truth_elsewhere", "truth_convention") for f in findings):
        findings += clock_findings(offsets)
    sensor = None
    if sequence.has_events:
        progress("looking at the sensor")
        sensor = estimate_sensor(sequence, *sequence.time_range)
    return Report(sequence, checks, tracked, sensor, tuple(findings))


def check(sequence: EventDepthSequence, progress: Progress) -> Checks:
    """Return what can be said of a recording without tracking."""
    progress("counting events")
    events, depth = event_facts(sequence), depth_facts(sequence)
    findings = [] if events is None else event_findings(sequence, events)
    findings += depth_findings(sequence, depth) + truth_findings(sequence)
    part = liveliest_part(sequence)
    images = poses = edges = None
    if sequence.has_events:
        volume = EventVolume(sequence, *part)
        progress("comparing events with images")
        images = check_images(sequence, volume)
        progress("comparing events with edges of depth")
        edges = check_edges(sequence, volume)
    known = {f.fault for f in findings}
    if images is not None and "one_polarity" not in known:  # which explains that images do not fit
        findings += images.findings
    if "frozen_depth" not in known:
        progress("comparing depth with true poses")
        poses = check_poses(sequence, *part)
        findings += () if poses is None else poses.findings
    return Checks(part, events, depth, images, poses, edges, tuple(findings))


def offsets_of(checks: Checks) -> list[Offset]:
    """Return the offsets that images and true poses give."""
    offsets, images, poses = [], checks.images, checks.poses
    if images is not None and images.is_good:
        offsets.append(Offset("events", "images", images.offset, images.tolerance / 2))
    if (
        poses is not None
        and poses.is_good
        and SURE * poses.deviation < 2 * max(abs(poses.offset), 2 * TOLERANCE)
    ):
        offsets.append(Offset("depth", "truth", poses.offset, poses.deviation + TOLERANCE / 3))
    return offsets


def _track(
    sequence: EventDepthSequence, config: Config, checks: Checks, progress: Progress
) -> tuple[Tracked | None, list[Finding], list[Offset]]:
    """Return the tracked path, what events and depth contradict each other in, and the delay of depth."""
    part, images, poses = checks.part, checks.images, checks.poses
    tracked = track(sequence, *part, config)
    if tracked is None:
        return None, [], []
    c = tracked.consistency
    delay, found = 0.0, list[Finding]()
    best, sigma = tracked, LATE_TRACKER if c is None else c.depth_delay_sigma_s
    if _is_late(tracked) or _misfit(tracked) > SUSPICIOUS:
        progress("aligning depth with events")
        try:
            calibration = calibrate_depth(sequence, config, progress, part)
            best, delay, sigma = calibration.tracked, calibration.delay, float(calibration.sigma[0])
            found = _turned(calibration, float(np.degrees(1 / sequence.camera.fx)))
        except DataError:  # too far off, or too little was compared
            pass
    if (_misfit(best) > CONTRADICTION and _misfit(best) > RESOLVED * _misfit(tracked)) or (
        best.lost_share > MOST_LOST
    ):
        is_good = images is not None and images.is_good, poses is not None and poses.is_good
        mirrored = _mirrored(sequence, part, config, best, *is_good)
        return tracked, [mirrored or _contradiction(best, checks.edges)], []
    if best.consistency is None:
        return tracked, [], []
    return best, found, [Offset("depth", "events", delay, sigma + LATE_TRACKER)]


def _turned(calibration: DepthCalibration, pixel: float) -> list[Finding]:  # degrees of a pixel
    """Return a line if depth is turned against the events by more than their noise could feign."""
    angle = float(np.degrees(np.linalg.norm(calibration.rotation)))
    is_needed = calibration.after < TURNED * calibration.before
    if angle < max(SMALLEST_TURN, pixel) or not is_needed:
        return []
    return [
        Finding(
            "depth_turned",
            f"depth does not lie quite where the events are: {calibration.text}: calibrate the two "
            "cameras, or run with --calibrate depth",
        )
    ]


def _misfit(tracked: Tracked) -> float:
    """Return how much events and depth contradict each other, in expected differences of poses."""
    if tracked.consistency is None:
        return np.inf if tracked.lost_share > MOST_LOST else 0.0
    return float(np.sqrt(tracked.consistency.disagreement))


def _is_late(tracked: Tracked) -> bool:
    """Return whether the tracker is sure of a delay of depth."""
    c = tracked.consistency
    return c is not None and abs(c.depth_delay_s) > max(SURE * c.depth_delay_sigma_s, SMALLEST_DELAY)


def _start(tracked: Tracked) -> str:
    how = f"{_misfit(tracked):.0f} times the expected difference of poses, 2 to 8 is usual"
    if tracked.lost_share > MOST_LOST:
        how = f"{tracked.lost_share:.0%} of the frames cannot be tracked"
    return f"events and depth contradict each other ({how})"


def _mirrored(
    sequence: EventDepthSequence,
    part: tuple[float, float],
    config: Config,
    tracked: Tracked,
    is_like_images: bool,  # the events
    is_like_truth: bool,  # depth
) -> Finding | None:
    """Return that events and depth agree once one of them is mirrored or transposed; None: they never do."""
    for name, (fault, _) in TRANSFORMS.items():
        other = track(TransformedEvents(sequence, name), *part, config)
        if other is None or other.consistency is None or other.lost_share > MOST_LOST:
            continue
        if _misfit(other) < min(CONTRADICTION, RESOLVED * _misfit(tracked)):
            what = "depth" if is_like_images else "the events" if is_like_truth else "the events, or of depth"
            return Finding(
                "mirrored_depth" if is_like_images else fault,
                f"{_start(tracked)}, and agree ({_misfit(other):.0f} times) after this change: {name} of "
                f"{what}",
            )
    return None


def _contradiction(tracked: Tracked, edges: EdgeCheck | None) -> Finding:
    """Return what kind of contradiction of events and depth the edges show."""
    start = _start(tracked)
    if edges is not None and edges.here < HIDDEN and edges.best > STANDS_OUT:
        x, y = edges.displacement
        return Finding(
            "depth_elsewhere",
            f"{start}, and edges of depth fit the events {x:+.0f}, {y:+.0f} pixels (x, y) away: depth "
            "is of another camera: register it to the event camera with both calibrations "
            "(docs/my_camera.md)",
        )
    return Finding(
        "depth_elsewhere",
        f"{start}: depth is of another camera or not registered to the event camera, the focal length or the "
        "principal point is wrong, or one of the two is mirrored or of another recording: look at the last "
        "picture of the sheet (docs/my_camera.md)",
    )
