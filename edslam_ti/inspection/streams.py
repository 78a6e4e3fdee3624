"""Looks at each stream by itself: counts, rates, gaps, hot pixels, units, stamps."""

from dataclasses import dataclass

import cv2
import numpy as np

from edslam_ti.conversion.events import slices
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.base import stamp_text
from edslam_ti.event_images.noisy import AROUND, NOISY, NOISY_EVENTS
from edslam_ti.events import Events
from edslam_ti.inspection.findings import Finding
from edslam_ti.truth import true_path

RATE_BIN = 0.01  # s
ABRUPT = 0.2  # of the usual rate, in the bins beside a gap: a camera that comes to rest slows down first
SILENT = 0.02  # of the usual rate
SHORTEST_GAP = 0.03  # s
ONE_POLARITY = 0.02  # share of the rarer polarity
LOOKED_AT = 12  # depth images
NEAR, FAR = 0.05, 100.0  # m, medians of depth that a depth camera can have
FROZEN = 0.5  # share of depth images that repeat the one before
LONG_STEP, SHORTEST_STEP = 4.0, 0.15  # median steps, and s, of a gap between depth images
COVERED = 0.9  # of the time of events


@dataclass(frozen=True)
class EventFacts:
    """Numbers of a stream of events."""

    count: int
    start: float  # s
    end: float  # s
    positive_share: float
    rates: np.ndarray  # [B] events per RATE_BIN
    numbers: np.ndarray  # [H, W] events of each pixel


@dataclass(frozen=True)
class DepthFacts:
    """Numbers of depth images, from a few of them."""

    count: int
    rate: float  # Hz, median
    nearest: float  # m, 1st percentile
    median: float  # m
    farthest: float  # m, 99th percentile
    measured_share: float  # of the pixels


def event_facts(sequence: EventDepthSequence) -> EventFacts | None:
    """Read all events once; None: there are none."""
    if not sequence.has_events:
        return None
    start, end = sequence.time_range
    height, width = sequence.camera.shape
    numbers = np.zeros(height * width, np.int64)
    rates = np.zeros(int((end - start) / RATE_BIN) + 1, np.int64)
    count = positive = 0
    for events, _ in slices(sequence):
        count += len(events)
        positive += int((events.polarity > 0).sum())
        numbers += _per_pixel(events, height, width)
        bins = ((events.t - start) / RATE_BIN).astype(np.int64)
        rates += np.bincount(np.clip(bins, 0, len(rates) - 1), minlength=len(rates))
    share = positive / max(count, 1)
    return EventFacts(count, start, end, share, rates, numbers.reshape(height, width))


def _per_pixel(events: Events, height: int, width: int) -> np.ndarray:
    return np.bincount(events.y.astype(np.int64) * width + events.x, minlength=height * width)


def event_findings(sequence: EventDepthSequence, facts: EventFacts) -> list[Finding]:
    """Return gaps, hot pixels, and events of one polarity only."""
    findings = []
    for start, end in _gaps(facts):
        findings.append(
            Finding(
                "event_gap",
                f"no events from {stamp_text(sequence, start)} to {stamp_text(sequence, end)} s, although "
                "the rate before and after is high: the stream was interrupted (bandwidth, a full buffer); "
                "tracking bridges it with depth alone",
            )
        )
    hot = hot_pixels(facts)
    if len(hot):
        share = facts.numbers[hot[:, 1], hot[:, 0]].sum() / facts.count
        shown = ", ".join(f"({x}, {y})" for x, y in hot[:4])
        findings.append(
            Finding(
                "hot_pixels",
                f"{len(hot)} hot pixel{'s' if len(hot) > 1 else ''} fire{'s' if len(hot) == 1 else ''} "
                f"{share:.1%} of all events: (x, y) = {shown}{', ...' if len(hot) > 4 else ''}: mask them "
                "in the camera; tracker and map leave them out",
            )
        )
    rarer = min(facts.positive_share, 1 - facts.positive_share)
    if rarer < ONE_POLARITY and facts.count > 1000:
        findings.append(
            Finding(
                "one_polarity",
                f"{1 - rarer:.1%} of the events have one polarity: expected both; is polarity another "
                "column, or coded in a way that was lost?",
            )
        )
    return findings


def _gaps(facts: EventFacts) -> list[tuple[float, float]]:
    """Return the intervals (s) without events that begin and end abruptly."""
    rates = facts.rates.astype(float)
    usual = float(np.median(rates[rates > 0])) if (rates > 0).any() else 0.0
    if usual <= 0:
        return []
    silent = np.concatenate([[False], rates < SILENT * usual, [False]])
    edges = np.flatnonzero(np.diff(silent.astype(int)))
    gaps = []
    for first, end in zip(edges[::2], edges[1::2]):
        if (end - first) * RATE_BIN < SHORTEST_GAP or first < 2 or end > len(rates) - 2:
            continue
        # The bins beside the gap may be cut by it; those next to them are whole.
        if min(rates[first - 2], rates[end + 1]) > ABRUPT * usual:
            gaps.append((facts.start + first * RATE_BIN, facts.start + end * RATE_BIN))
    return gaps


def hot_pixels(facts: EventFacts) -> np.ndarray:  # [P, 2] x, y, most active first
    """Return pixels with many times the events of their neighbours and of the liveliest pixels."""
    numbers = np.minimum(facts.numbers, np.iinfo(np.int32).max).astype(np.float32)
    around = cv2.medianBlur(numbers, AROUND)
    usual = float(np.percentile(numbers, 90))
    y, x = np.nonzero(numbers > np.maximum(NOISY * np.maximum(around, 0.1 * usual), NOISY_EVENTS))
    order = np.argsort(-numbers[y, x], kind="stable")
    return np.stack([x[order], y[order]], -1)


# --- depth ---


def depth_facts(sequence: EventDepthSequence) -> DepthFacts | None:
    """Return what a few depth images show; None: there is no depth."""
    stamps = sequence.depth_timestamps
    found = [sequence.depth_or_none(int(k)) for k in _some(len(stamps))]
    depths = [d for d in found if d is not None and (d > 0).any()]
    if not depths:
        return None
    values = np.concatenate([d[d > 0] for d in depths])
    near, median, far = (float(v) for v in np.percentile(values, [1, 50, 99]))
    rate = 1 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return DepthFacts(len(stamps), rate, near, median, far, float(np.mean([(d > 0).mean() for d in depths])))


def depth_findings(sequence: EventDepthSequence, facts: DepthFacts | None) -> list[Finding]:
    """Return missing, frozen and interrupted depth, and a unit that cannot be right."""
    if facts is None and sequence.dataset == "events":  # nobody expects depth in a file of events
        return []
    if facts is None:
        return [
            Finding(
                "no_depth",
                "there is no depth: tracking and mapping need it; give depth.txt and depth/ of a depth "
                "camera that is registered to the events (docs/my_camera.md)",
            )
        ]
    findings, stamps = [], sequence.depth_timestamps
    if not NEAR < facts.median < FAR:
        findings.append(
            Finding(
                "depth_unit",
                f"half of the depth is within {facts.median:.3g} m: expected {NEAR} to {FAR:g} m: check "
                "depth_scale in camera.json (units per metre: 1000 for millimetres, 5000 for TUM's)",
            )
        )
    steps = np.diff(stamps)
    usual = float(np.median(steps)) if len(steps) else 0.0
    long = np.flatnonzero(steps > max(LONG_STEP * usual, SHORTEST_STEP))
    if len(long):
        k = int(long[steps[long].argmax()])
        findings.append(
            Finding(
                "depth_gap",
                f"no depth for {steps[k]:.3g} s from {stamp_text(sequence, stamps[k])} s on, otherwise every "
                f"{1000 * usual:.0f} ms ({len(long)} such gap{'s' if len(long) > 1 else ''}): images were "
                "lost; events alone carry the pose there",
            )
        )
    repeated = _repeated_share(sequence)
    if repeated > FROZEN:
        findings.append(
            Finding(
                "frozen_depth",
                f"{repeated:.0%} of the depth images repeat the one before: the depth stream has stopped, "
                "or the same image was saved again and again",
            )
        )
    first, last = sequence.time_range
    covered = min(last, float(stamps[-1])) - max(first, float(stamps[0]))
    if sequence.has_events and covered < COVERED * (last - first) - 2 * usual:
        findings.append(
            Finding(
                "depth_coverage",
                f"depth covers {max(covered, 0.0):.3g} of the events' {last - first:.3g} s: only that part "
                "can be used; are the clocks the same?",
            )
        )
    return findings


def _repeated_share(sequence: EventDepthSequence) -> float:
    pairs = [int(k) for k in _some(len(sequence.depth_timestamps) - 1)]
    same = []
    for k in pairs:
        a, b = sequence.depth_or_none(k), sequence.depth_or_none(k + 1)
        if a is not None and b is not None:
            same.append(bool(np.array_equal(a, b)))
    return float(np.mean(same)) if same else 0.0


def _some(number: int) -> np.ndarray:
    return np.unique(np.linspace(0, number - 1, LOOKED_AT).astype(int)) if number > 0 else np.empty(0, int)


# --- truth ---


def truth_findings(sequence: EventDepthSequence) -> list[Finding]:
    """Return a truth that covers little of the recording, and poses that jump."""
    if sequence.truth is None:
        return []
    findings, path = [], true_path(sequence.truth)
    stamps = sequence.depth_timestamps
    if len(stamps):
        known = float(path.is_known(stamps).mean())
        if known < 1 - COVERED + 0.4:
            a, b = (stamp_text(sequence, float(t)) for t in sequence.truth.timestamps[[0, -1]])
            c, d = (stamp_text(sequence, float(t)) for t in stamps[[0, -1]])
            findings.append(
                Finding(
                    "truth_coverage",
                    f"true poses are known for {known:.0%} of the depth images: the truth covers {a} to "
                    f"{b} s, depth {c} to {d} s: is the truth on another clock, or of another recording?",
                )
            )
    if len(path.jumps):
        findings.append(
            Finding(
                "truth_jumps",
                f"{len(path.jumps)} true poses jump away from the rest of the path, the first at "
                f"{stamp_text(sequence, float(path.jumps[0]))} s: they are left out of errors",
            )
        )
    return findings
