"""Arrays as they come from a camera or a program: checked, in seconds and metres, on a clock near 0."""

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.clocks import clock_offset
from edslam_ti.datasets.depth import FARTHEST_DEPTH
from edslam_ti.errors import DataError
from edslam_ti.event_files.stream import Clock
from edslam_ti.events import Events
from edslam_ti.lenses import Lens, Undistortion

TimeUnit = Literal["s", "ms", "us", "ns"]
DepthUnit = Literal["m", "cm", "mm"]
TICKS: dict[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # per second
METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
FAR_FROM_OTHERS = 10.0  # s; single stamps this far from the middle of their chunk are damaged
USUALLY_EARLY = 2  # depth images before the first events are nothing to tell
LEAST_TO_COMPARE = 3  # events


@dataclass
class Counts:
    """What was added, and what of it was left out."""

    events: int = 0
    depth_images: int = 0
    images: int = 0
    events_outside: int = 0  # of the image
    events_damaged: int = 0  # a stamp that is no number, or far from all others of its chunk
    events_late: int = 0  # older than the last frame
    depth_late: int = 0  # not newer than the last frame
    depth_repeated: int = 0  # a second image with the stamp of one that waits
    depth_early: int = 0  # before there were enough events for the first frame

    @property
    def notes(self) -> list[str]:
        """A line for each kind of omission."""
        lines = {
            "events outside the image left out": self.events_outside,
            "events with damaged time stamps left out": self.events_damaged,
            "events came later than the frame they belong to and are left out": self.events_late,
            "depth images came later than the frame they belong to and are left out (a longer `patience` "
            "waits for them)": self.depth_late,
            "depth images repeat a time stamp and are left out": self.depth_repeated,
            "depth images before the first events are left out": self.depth_early
            * (self.depth_early > USUALLY_EARLY),
        }
        return [f"{number} {what}" for what, number in lines.items() if number]


@dataclass
class Intake:
    """Turns arrays of any common type into the events and images of an undistorted camera.

    The first stamp decides the zero of the clock: one later than 1000 s is shifted by whole seconds
    (datasets/clocks.py), which `time_offset` holds.
    """

    sensor: Camera | Lens
    time_unit: TimeUnit
    depth_unit: DepthUnit
    depth_is_undistorted: bool = False
    counts: Counts = field(default_factory=Counts)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name, value, known in (
            ("time_unit", self.time_unit, TICKS),
            ("depth_unit", self.depth_unit, METRES),
        ):
            if value not in known:
                raise DataError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
        lens = self.sensor if isinstance(self.sensor, Lens) else None
        self.pinhole = self.sensor.pinhole if isinstance(self.sensor, Lens) else self.sensor
        self._undistortion = Undistortion(lens) if lens is not None and lens.is_distorted else None
        self._clock = Clock(TICKS[self.time_unit])
        self.time_offset: float | None = None  # s; None: nothing has come yet

    # --- time ---

    def seconds(self, t: Any) -> np.ndarray:  # [N] in the time unit -> [N] float64 s
        """Return stamps as seconds of the session's clock."""
        stamps = _numbers("t", t)
        if self.time_offset is None:
            finite = stamps[np.isfinite(stamps)]
            if len(finite) == 0:
                return np.full(len(stamps), np.nan)
            near = np.abs(finite - np.median(finite)) <= FAR_FROM_OTHERS * self._clock.ticks
            self.time_offset = clock_offset(float(finite[near].min()) / self._clock.ticks)
        if stamps.dtype.kind == "f" and stamps.dtype.itemsize < 8:
            stamps = stamps.astype(np.float64)
            self._note("time stamps are float32, which holds microseconds up to 8 s only: give float64")
        return self._clock.seconds(stamps, self.time_offset)

    def second(self, t: float) -> float:
        """Return one stamp as seconds of the session's clock; raises DataError where it is no number."""
        value = self.seconds(t)
        if value.shape != (1,) or not np.isfinite(value[0]):
            raise DataError(f"t: expected one time stamp in {self.time_unit}, got {t!r}")
        return float(value[0])

    # --- data ---

    def events(self, x: Any, y: Any, t: Any, p: Any) -> Events:
        """Return new events, undistorted, in the order of time, without those that cannot be right."""
        columns = {name: _numbers(name, values) for name, values in zip("xytp", (x, y, t, p))}
        if len({len(column) for column in columns.values()}) != 1:
            lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
            raise DataError(f"events: expected x, y, t and p of one length, got {lengths}")
        seconds = self.seconds(columns["t"])
        with np.errstate(invalid="ignore"):
            column, row = (np.rint(columns[k]) if columns[k].dtype.kind == "f" else columns[k] for k in "xy")
            is_inside = (
                (column >= 0) & (column < self.pinhole.width) & (row >= 0) & (row < self.pinhole.height)
            )
        is_sound = np.isfinite(seconds)
        if len(seconds) >= LEAST_TO_COMPARE and is_sound.any():
            middle = np.median(seconds[is_sound])
            is_far = is_sound & (np.abs(seconds - middle) > FAR_FROM_OTHERS)
            if is_far.mean() < 0.1:  # more of them are a gap, or a chunk of minutes
                is_sound &= ~is_far
        self.counts.events += len(seconds)
        self.counts.events_damaged += int((~is_sound).sum())
        self.counts.events_outside += int((is_sound & ~is_inside).sum())
        kept = is_sound & is_inside
        if not kept.all():
            column, row, seconds, polarity = (a[kept] for a in (column, row, seconds, columns["p"]))
        else:
            polarity = columns["p"]
        events = Events(
            column.astype(np.int16),
            row.astype(np.int16),
            np.array(seconds),
            np.where(polarity > 0, 1, -1).astype(np.int8),
        )
        if (events.t[1:] < events.t[:-1]).any():
            events = events[np.argsort(events.t, kind="stable")]
        return events if self._undistortion is None else self._undistortion.events(events)

    def depth(self, depth: Any) -> np.ndarray:  # [H, W] -> [H, W] float32 m, 0 = missing
        """Return a depth image; missing are 0, less, nan, inf, 10 km and more, an integer's largest."""
        raw = self._image("depth", depth)
        with np.errstate(invalid="ignore", over="ignore"):
            metres = raw.astype(np.float32)
            if self.depth_unit != "m":
                metres *= np.float32(METRES[self.depth_unit])
            is_measured = (metres > 0) & (metres < FARTHEST_DEPTH)
        if raw.dtype.kind in "iu":
            is_measured &= raw != np.iinfo(raw.dtype).max
        metres[~is_measured] = 0
        if self._undistortion is None or self.depth_is_undistorted:
            return metres
        return self._undistortion.depth(metres)

    def image(self, image: Any) -> np.ndarray:  # [H, W] or [H, W, 3] RGB -> [H, W] float32 in [0, 1]
        """Return a grey image; integers count from 0 to their largest value, floats from 0 to 1."""
        raw = np.asarray(image)
        if raw.ndim == 3 and raw.shape[2] == 3 and raw.dtype in (np.uint8, np.uint16, np.float32):
            raw = cv2.cvtColor(raw, cv2.COLOR_RGB2GRAY)
        raw = self._image("image", raw)
        largest = np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else 1
        grey = raw.astype(np.float32) / np.float32(largest)
        if not np.isfinite(grey).all() or grey.min() < 0 or grey.max() > 1.001:
            raise DataError("image: expected integers, or floats from 0 to 1, got other values")
        return grey if self._undistortion is None else self._undistortion.image(grey)

    def _image(self, name: str, values: Any) -> np.ndarray:  # [H, W]
        image = np.asarray(values)
        if image.ndim == 3 and image.shape[2] == 1:
            image = image[..., 0]
        if image.shape != self.pinhole.shape or image.dtype.kind not in "iuf":
            raise DataError(
                f"{name}: expected numbers of shape {self.pinhole.shape}, got {image.dtype} of shape "
                f"{image.shape}"
            )
        return image

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _numbers(name: str, values: Any) -> np.ndarray:  # [N]
    """Return numbers as an array of one axis; a single number is an array of one."""
    array = np.atleast_1d(np.asarray(values))
    if array.dtype.kind == "b":
        array = array.astype(np.int8)
    if array.ndim != 1 or (array.dtype.kind not in "iuf" and array.size):
        raise DataError(f"{name}: expected a row of numbers, got {array.dtype} of shape {array.shape}")
    return array.astype(np.float64) if array.dtype.kind not in "iuf" else array
