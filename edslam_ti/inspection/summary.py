"""An inspection as lines of text."""

import numpy as np

from edslam_ti.datasets.base import stamp_text
from edslam_ti.event_images.contrast import contrast_from_images
from edslam_ti.inspection.findings import Finding
from edslam_ti.inspection.report import Report
from edslam_ti.inspection.streams import RATE_BIN
from edslam_ti.results.sensor import sensor_lines


def lines(report: Report | None, refusal: Finding | None) -> list[str]:
    """Return what a recording is, a line for each stream, then every finding with what to do about it."""
    result = [] if report is None else _facts(report)
    findings = [*([refusal] if refusal is not None else []), *(report.findings if report is not None else ())]
    if not findings:
        return [*result, "nothing looks wrong"]
    return [*result, *(f"WARNING {f.fault}: {f.text}" for f in findings)]


def _facts(report: Report) -> list[str]:
    sequence, camera = report.sequence, report.sequence.camera
    result = [f"{sequence.scene}: {sequence.description}, layout {sequence.dataset}"]
    lens = f"camera: {camera.width}x{camera.height} pixels, lens not known"
    if sequence.dataset != "events":
        lens = (
            f"camera: {camera.width}x{camera.height} pixels, fx {camera.fx:.6g}, fy {camera.fy:.6g}, "
            f"cx {camera.cx:.6g}, cy {camera.cy:.6g}, undistorted"
        )
    result.append(lens)
    result += _events(report) + _depth(report) + _images(report) + _truth(report)
    if sequence.imu is not None:
        result.append(f"IMU: {len(sequence.imu)} samples")
    if sequence.time_offset:
        result.append(f"clock: the recording's own starts at {sequence.time_offset:.6f} s")
    return result + list(sequence.notes)


def _events(report: Report) -> list[str]:
    facts, sequence = report.checks.events, report.sequence
    if facts is None:
        return ["events: none"]
    length = facts.end - facts.start
    peak = max(float(facts.rates.max()) / RATE_BIN, facts.count / max(length, 1e-9))
    silent = float((facts.numbers == 0).mean())
    return [
        f"events: {facts.count} in {length:.6g} s ({stamp_text(sequence, facts.start)} to "
        f"{stamp_text(sequence, facts.end)} s), {facts.count / max(length, 1e-9) / 1e6:.3g} M/s on average, "
        f"{peak / 1e6:.3g} M/s at most, {facts.positive_share:.0%} brighter, {silent:.1%} of the pixels "
        "silent"
        + (f", {sequence.num_dropped_events} bad rows left out" if sequence.num_dropped_events else ""),
        "sensor: " + "; ".join(sensor_lines(report.sensor, None) if report.sensor is not None else ["-"]),
    ]


def _depth(report: Report) -> list[str]:
    facts, stamps = report.checks.depth, report.sequence.depth_timestamps
    if facts is None:
        return ["depth: none"]
    return [
        f"depth: {facts.count} images at {facts.rate:.3g} Hz ({stamp_text(report.sequence, stamps[0])} to "
        f"{stamp_text(report.sequence, stamps[-1])} s), {facts.nearest:.3g} to {facts.farthest:.3g} m, "
        f"median {facts.median:.3g} m, {facts.measured_share:.0%} of the pixels measured"
    ]


def _images(report: Report) -> list[str]:
    sequence, stamps = report.sequence, report.sequence.image_timestamps
    if len(stamps) == 0:
        return ["images: none"]
    rate = 1 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    line = f"images: {len(stamps)} at {rate:.3g} Hz"
    if report.checks.images is not None:
        line += f", changes correlate with those of the events at {report.checks.images.correlation:.2f}"
    result = [line]
    stated = sequence.contrast_threshold
    estimate = contrast_from_images(sequence, *report.checks.part) if sequence.has_events else None
    said = [] if stated is None else [f"stated {stated:g}"]
    if estimate is not None:
        positive, negative = estimate.by_polarity
        said.append(f"from images {estimate.value:.3f} (brighter {positive:.3f}, darker {negative:.3f})")
        if estimate.deviations is not None:
            said.append("each +- {:.3f}, {:.3f}".format(*estimate.deviations))
    return [*result, f"contrast threshold: {', '.join(said)}"] if said else result


def _truth(report: Report) -> list[str]:
    sequence = report.sequence
    if sequence.truth is None:
        return ["true poses: none"]
    stamps = sequence.truth.timestamps
    rate = 1 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    line = (
        f"true poses: {len(stamps)} at {rate:.4g} Hz ({stamp_text(sequence, stamps[0])} to "
        f"{stamp_text(sequence, stamps[-1])} s), path of {sequence.truth.length():.3g} m"
    )
    if report.checks.poses is not None:
        line += f", depth reprojected with them is off by {10 * report.checks.poses.cost:.1f} %"
    return [line]
