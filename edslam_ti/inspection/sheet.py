"""The contact sheet of an inspection: what each stream shows at a few times, and depth edges over events."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.base import stamp_text
from edslam_ti.inspection.edge_check import depth_edges
from edslam_ti.inspection.report import Report
from edslam_ti.output import atomic_file
from edslam_ti.results.pictures import depth_colours

ROWS = 4
PANEL = 320  # px, width
GAP, HEAD, CAPTION = 6, 22, 18  # px: between panels, above the sheet, above each row
HISTORY = 0.1  # s of events of the time surface
DECAY = 0.03  # s, of the time surface
EVENTS_PER_PIXEL = 0.25  # in the event image
LONGEST = 0.1  # s, of the event image to either side
RED, BLUE, GREEN = (214, 60, 50), (40, 90, 200), (0, 150, 60)
TITLES = ("events: red brighter, blue darker", "time surface", "depth", "image", "depth edges over events")
Panel = np.ndarray  # [H, W, 3] uint8


def write_sheet(report: Report, path: Path) -> None:
    """Write a PNG with one row per time: events, time surface, depth, image, depth edges over events."""
    sequence = report.sequence
    times = _times(report)
    rows = [_row(sequence, t, report) for t in times]
    height = round(PANEL * sequence.camera.height / sequence.camera.width)
    sheet = np.full(
        (HEAD + len(rows) * (CAPTION + height + GAP), GAP + len(TITLES) * (PANEL + GAP), 3), 255, np.uint8
    )
    for column, title in enumerate(TITLES):
        _write(sheet, GAP + column * (PANEL + GAP), HEAD - 8, title)
    for k, (t, panels) in enumerate(zip(times, rows)):
        top = HEAD + k * (CAPTION + height + GAP)
        _write(sheet, GAP, top + CAPTION - 6, f"{stamp_text(sequence, t)} s")
        for column, panel in enumerate(panels):
            left = GAP + column * (PANEL + GAP)
            if panel is None:
                _write(sheet, left + PANEL // 3, top + CAPTION + height // 2, "none")
                continue
            way = cv2.INTER_NEAREST if panel.shape[1] < PANEL else cv2.INTER_AREA
            shown = cv2.resize(panel, (PANEL, height), interpolation=way)
            sheet[top + CAPTION : top + CAPTION + height, left : left + PANEL] = shown
    done, data = cv2.imencode(".png", sheet[..., ::-1])
    assert done, "OpenCV encodes PNG"
    with atomic_file(path) as temporary:
        temporary.write_bytes(data.tobytes())


def _times(report: Report) -> list[float]:
    """Return the times of the rows: those of depth images in the part that was looked at, if there are "
    "any."""
    start, end = report.checks.part
    stamps = report.sequence.depth_timestamps
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    if len(stamps) == 0:
        return [float(t) for t in np.linspace(start, end, ROWS + 2)[1:-1]]
    chosen = np.unique(np.linspace(0, len(stamps) - 1, ROWS + 2).astype(int))
    return [float(t) for t in stamps[chosen[1:-1] if len(chosen) > ROWS else chosen]]


def _row(sequence: EventDepthSequence, time: float, report: Report) -> Sequence[Panel | None]:
    events, surface = _event_panels(sequence, time) if sequence.has_events else (None, None)
    index = int(np.searchsorted(sequence.depth_timestamps, time))
    has_depth = index < len(sequence.depth_timestamps) and sequence.depth_timestamps[index] == time
    depth = sequence.depth_or_none(index) if has_depth else None
    image = sequence.image_at(time, tolerance=0.05)
    grey = None if image is None else _grey(image)
    near, far = (
        (report.checks.depth.nearest, report.checks.depth.farthest)
        if report.checks.depth is not None
        else (0.0, 1.0)
    )
    colours = None if depth is None else depth_colours(depth, near, far)
    background = events if events is not None else grey
    overlay = None if depth is None or background is None else _overlay(background, depth)
    return events, surface, colours, grey, overlay


def _event_panels(sequence: EventDepthSequence, time: float) -> tuple[Panel, Panel]:
    """Return the events around a time, red and blue, and the time surface at it."""
    shape = sequence.camera.shape
    half = 0.0025
    around = sequence.events(time - half, time + half)
    while len(around) < EVENTS_PER_PIXEL * shape[0] * shape[1] and half < LONGEST:
        half *= 1.5
        around = sequence.events(time - half, time + half)
    change, number = np.zeros(shape), np.zeros(shape)
    np.add.at(change, (around.y, around.x), around.polarity)
    np.add.at(number, (around.y, around.x), 1)
    picture = np.full((*shape, 3), 255, np.uint8)
    picture[(number > 0) & (change >= 0)] = RED
    picture[(number > 0) & (change < 0)] = BLUE
    before = sequence.events(time - HISTORY, time)
    last = np.full(shape, -np.inf)
    last[before.y, before.x] = before.t  # the latest is written last
    surface = np.exp((last - time) / DECAY)
    return picture, _grey(surface)


def _overlay(background: Panel, depth: np.ndarray) -> Panel:
    """Return a faded picture with the edges of depth on it."""
    picture = (0.5 * background + 127.5).astype(np.uint8)
    picture[depth_edges(depth) > 0] = GREEN
    return picture


def _grey(image: np.ndarray) -> Panel:  # [H, W] in [0, 1]
    return np.repeat(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)[..., None], 3, axis=-1)


def _write(picture: Panel, x: int, y: int, text: str) -> None:
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
