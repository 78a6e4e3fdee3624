"""Pictures of rendered views without a display: comparisons with the truth, contact sheets, a fly-through."""

import base64
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError, EdSlamError
from edslam_ti.output import atomic_file
from edslam_ti.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAP, HEAD, CAPTION = 6, 34, 20  # pixels: between panels, above the sheet, above each row
LETTER = 8  # pixels, height and about the width of letters
LARGEST_ERROR = 0.25  # brightness at the end of the error's colour scale
SMOOTHING = 0.1  # seconds, Gaussian width over which the fly-through's path is smoothed


# ---------------------------------------------------------------- rows of views


@dataclass(frozen=True)
class PictureRow:
    """A rendered view and the truth, where it is known."""

    caption: str
    truth: np.ndarray | None  # [H, W] brightness in [0, 1]
    render: np.ndarray  # [H, W] brightness, clipped to [0, 1]
    depth: np.ndarray  # [H, W] metres, 0 = nothing drawn


def write_contact_sheet(path: Path, rows: Sequence[PictureRow], panel_width: int = 384) -> None:
    """Write one row per view: truth, render, absolute error and rendered depth.

    Images narrower than `panel_width` pixels are enlarged by a whole number, much wider ones are reduced.
    """
    if not rows:
        raise DataError(f"{path.name}: expected at least one view, got none")
    shape = rows[0].render.shape
    for row in rows:
        for name, image in (("render", row.render), ("truth", row.truth), ("depth", row.depth)):
            if image is not None and image.shape != shape:
                raise DataError(f"{name}: expected shape {shape} as the first render's, got {image.shape}")
    near, far = _depth_range([row.depth for row in rows])
    h, w = _panel_size(shape, panel_width)
    panels = [[_resized(panel, h, w) for panel in _panels(row, near, far)] for row in rows]
    lefts = [GAP + column * (w + GAP) for column in range(4)]
    tops = [HEAD + k * (CAPTION + h) + CAPTION for k in range(len(rows))]
    width, height = lefts[-1] + w + GAP, tops[-1] + h + GAP
    sheet = np.full((height, width, 3), 255, np.uint8)
    titles = ("truth", "render", f"error, 0 to {LARGEST_ERROR}", f"depth, {near:.2f} to {far:.2f} m")
    for column, title in enumerate(titles):
        _write_text(sheet, lefts[column] + (w // 4 + 8 if column > 1 else 0), HEAD // 2, title)
    for row, row_panels, top in zip(rows, panels, tops):
        _write_text(sheet, GAP, top - CAPTION // 2, row.caption)
        for panel, left in zip(row_panels, lefts):
            if panel is None:
                _write_text(sheet, left + w // 2 - 4 * LETTER, top + h // 2, "no truth")
            else:
                sheet[top : top + h, left : left + w] = panel
    scale = np.linspace(0, 1, w // 4)[None].repeat(8, 0)
    for left, colours in ((lefts[2], cv2.COLORMAP_MAGMA), (lefts[3], cv2.COLORMAP_VIRIDIS)):
        sheet[HEAD // 2 - 4 : HEAD // 2 + 4, left : left + w // 4] = _coloured(scale, colours)
    _write_png(path, sheet)


def read_panels(path: Path) -> tuple[np.ndarray, np.ndarray]:  # [h, w, 3] uint8 each
    """Return truth and render of a contact sheet of one row; one without truth has only words there."""
    sheet = cv2.imread(str(path))
    if sheet is None:
        raise DataError(f"{path}: expected a picture of a rendered view; it cannot be read")
    top, w = HEAD + CAPTION, (sheet.shape[1] - GAP) // 4 - GAP
    panels = [sheet[top:-GAP, left : left + w, ::-1] for left in (GAP, GAP + w + GAP)]
    return panels[0], panels[1]


def as_data_uri(picture: np.ndarray, quality: int = 85) -> str:  # [H, W, 3] uint8
    """Return a picture as text that an HTML page can hold in place of a link, a JPEG."""
    done, data = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))
    if not done:
        raise DataError("picture: could not be written as JPEG")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _write_text(picture: np.ndarray, x: int, y: int, text: str) -> None:
    """Write dark letters into a picture [H, W, 3], from x on and centred at y (pixels)."""
    base = (x, y + LETTER // 2)
    cv2.putText(picture, text, base, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)


def _panels(row: PictureRow, near: float, far: float) -> list[np.ndarray | None]:  # 4 of [H, W, 3]
    truth = error = None
    if row.truth is not None:
        truth = _grey(row.truth)
        difference = np.abs(np.clip(row.render, 0, 1) - row.truth)
        error = _coloured(difference / LARGEST_ERROR, cv2.COLORMAP_MAGMA)
    return [truth, _grey(row.render), error, depth_colours(row.depth, near, far)]


def depth_colours(depth: np.ndarray, near: float, far: float) -> np.ndarray:  # [H, W] -> [H, W, 3] uint8
    """Return depth (metres) in colours from dark (near) to bright (far), white where there is none."""
    colours = _coloured((depth - near) / max(far - near, 1e-3), cv2.COLORMAP_VIRIDIS)
    colours[depth <= 0] = 255
    return colours


def _depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:  # metres
    known = np.concatenate([d[d > 0] for d in depths])
    if len(known) == 0:
        return 0.0, 1.0
    near, far = np.percentile(known, (1, 99))
    return float(near), float(far)


def _coloured(values: np.ndarray, colours: int) -> np.ndarray:  # [H, W] in [0, 1] -> [H, W, 3] uint8
    return np.asarray(cv2.applyColorMap(_bytes(values), colours))[..., ::-1]


def _bytes(image: np.ndarray) -> np.ndarray:  # [...] -> uint8, clipped to [0, 1]
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


def _grey(image: np.ndarray) -> np.ndarray:  # [H, W] -> [H, W, 3] uint8
    return np.repeat(_bytes(image)[..., None], 3, axis=-1)


def _panel_size(shape: tuple[int, ...], panel_width: int) -> tuple[int, int]:
    """Return height and width of a panel."""
    height, width = shape
    zoom = max(1, round(panel_width / width))
    if width <= 1.25 * panel_width:
        return zoom * height, zoom * width
    return round(height * panel_width / width), panel_width


def _resized(panel: np.ndarray | None, height: int, width: int) -> np.ndarray | None:
    if panel is None or panel.shape[:2] == (height, width):
        return panel
    way = cv2.INTER_NEAREST if panel.shape[1] < width else cv2.INTER_AREA
    return np.asarray(cv2.resize(panel, (width, height), interpolation=way))


# ---------------------------------------------------------------- fly-through


class NoEncoderError(EdSlamError):
    """This OpenCV cannot encode video."""


def smooth_path(
    trajectory: Trajectory,
    fps: float,  # frames per second of the sequence
    max_frames: int,
) -> Iterator[np.ndarray]:  # [4, 4]
    """Yield poses evenly spaced in time: means of the key poses around each, in a Gaussian window."""
    stamps = trajectory.timestamps
    count = min(max_frames, max(1, round((stamps[-1] - stamps[0]) * fps)))
    for t in np.linspace(stamps[0], stamps[-1], count):
        # A window that shrinks towards the ends keeps its mean at the time in its middle.
        width = max(min(SMOOTHING, (t - stamps[0]) / 2, (stamps[-1] - t) / 2), 1e-6)
        near = np.unique(np.clip(np.arange(-8, 9) / 4 * width + t, stamps[0], stamps[-1]))
        weights = np.exp(-0.5 * ((near - t) / width) ** 2)
        around = trajectory.resampled(near).poses
        T = np.eye(4)
        T[:3, :3] = Rotation.from_matrix(around[:, :3, :3]).mean(weights).as_matrix()
        T[:3, 3] = np.average(around[:, :3, 3], axis=0, weights=weights)
        yield T


def fly_through_frames(
    views: Iterable[tuple[np.ndarray, np.ndarray]],  # brightness and depth [H, W] of every frame
) -> Iterator[np.ndarray]:  # [H, 2 W, 3] uint8
    """Yield render and depth side by side; the first frame with depth sets the colour scale."""
    near = far = 0.0
    for intensity, depth in views:
        if far == 0.0 and (depth > 0).any():
            near, far = _depth_range([depth])
        yield np.concatenate([_grey(intensity), depth_colours(depth, near, far)], 1)


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames ([H, W, 3] RGB, uint8) as an .mp4 file; odd edges are cut off, it has even sizes."""
    writer = None
    with atomic_file(path) as temporary:
        for frame in frames:
            h, w = (n // 2 * 2 for n in frame.shape[:2])
            if writer is None:
                writer = _video_writer(temporary, fps, (w, h))
            writer.write(np.ascontiguousarray(frame[:h, :w, ::-1]))
        if writer is None:
            raise DataError(f"{path.name}: expected at least one frame, got none")
        writer.release()


def _video_writer(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    """Return a writer of VP9, which browsers play, or of MPEG-4 Part 2 where OpenCV has no VP9."""
    for code in ("vp09", "mp4v"):
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, size)
        if writer.isOpened():
            return writer
    raise NoEncoderError(f"{path.name}: OpenCV cannot write MPEG-4 here; no video is made")


# ---------------------------------------------------------------- matplotlib without global state


def new_figure(width: float, height: float, dpi: int = 120) -> "Figure":
    """Return a figure (inches) that is not registered with pyplot: it needs no display and is freed."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG."""
    _write_png(path, _drawn(figure))


def _drawn(figure: "Figure") -> np.ndarray:  # [H, W, 3] uint8
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _write_png(path: Path, rgb: np.ndarray) -> None:  # [H, W, 3] uint8
    with atomic_file(path) as temporary:
        is_done, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
        if not is_done:
            raise DataError(f"{path}: could not be encoded")
        temporary.write_bytes(data.tobytes())  # OpenCV would say why it cannot write to the terminal only
