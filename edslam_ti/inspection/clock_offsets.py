"""Puts offsets between pairs of streams together, and names the stream whose clock is off."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edslam_ti.inspection.findings import Finding

STREAMS = ("events", "images", "truth", "depth")  # whose clock is believed, if there are as many for another
TOGETHER = 0.012  # s; streams whose stamps differ by less belong together


@dataclass(frozen=True)
class Offset:
    """By how much the stamps of one stream are late against those of another."""

    late: str
    against: str
    seconds: float
    deviation: float  # s, including what is not known of the method's own bias


def clock_findings(offsets: Sequence[Offset]) -> list[Finding]:
    """Return a line for each stream that is off against the largest group that agrees."""
    return [line for streams in _connected(offsets) for line in _of_connected(offsets, streams)]


def _connected(offsets: Sequence[Offset]) -> list[list[str]]:
    """Return the streams in groups within which there are offsets."""
    groups = [{s} for s in STREAMS]
    for offset in offsets:
        joined = [g for g in groups if offset.late in g or offset.against in g]
        groups = [g for g in groups if g not in joined] + [set().union(*joined)]
    return [[s for s in STREAMS if s in group] for group in groups if len(group) > 1]


def _of_connected(offsets: Sequence[Offset], streams: list[str]) -> list[Finding]:
    offsets = [o for o in offsets if o.late in streams]
    lateness, deviation = _solved(offsets, streams)
    group = max(([b for b in streams if abs(lateness[a] - lateness[b]) < TOGETHER] for a in streams), key=len)
    reference = float(np.mean([lateness[s] for s in group]))
    findings = []
    for s in streams:
        late = lateness[s] - reference
        if s in group or abs(late) < TOGETHER:
            continue
        others = " and ".join(group)
        sign = "late" if late > 0 else "early"
        verb = "subtract" if late > 0 else "add"
        number = "" if s in ("events", "images") else "s"
        end = f"{verb} {abs(late):.3f} s {'from' if late > 0 else 'to'} its stamps"
        if s == "depth":
            end += ", or run with --calibrate depth"
        findings.append(
            Finding(
                f"{s}_clock",
                f"{s} look{number} {1000 * abs(late):.0f} ms (+- {1000 * deviation[s]:.0f}) too {sign} "
                f"against {others}: {end}",
            )
        )
    return findings


def _solved(offsets: Sequence[Offset], streams: list[str]) -> tuple[dict[str, float], dict[str, float]]:
    """Return how late each stream is, by weighted least squares, and its standard deviation (s)."""
    rows = np.zeros((len(offsets) + 1, len(streams)))
    values = np.zeros(len(offsets) + 1)
    for k, offset in enumerate(offsets):
        rows[k, streams.index(offset.late)] = 1 / offset.deviation
        rows[k, streams.index(offset.against)] = -1 / offset.deviation
        values[k] = offset.seconds / offset.deviation
    rows[-1, 0] = 1e6  # the first stream is on time
    solution = np.linalg.lstsq(rows, values, rcond=None)[0]
    covariance = np.linalg.pinv(rows.T @ rows)
    return (
        dict(zip(streams, solution.tolist())),
        dict(zip(streams, np.sqrt(np.diag(covariance)).tolist())),
    )
