"""Target images for views of the map: a start image plus the change measured by events since (Eq. 11).

Every window of a few seconds of events has one start image. Grey images, where given, are targets themselves
and fix the start image.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.depth_images import block_means, with_holes_filled
from edslam_ti.event_images.change import ChangeArchive
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.event_images.pixel_thresholds import Compared, PixelThresholds, fit_pixel_thresholds
from edslam_ti.event_images.sharp import SharpImage, SharpImages
from edslam_ti.event_images.solve import EventView, solve_start_image
from edslam_ti.frame import Frame
from edslam_ti.trajectory import Trajectory

MIN_VIEWS = 3  # frames needed before a start image can be solved
QUICK = {4: 60}  # solver iterations for each reduction of the images, during the run
THOROUGH = {4: 100, 2: 80}  # the same at the end
GIVEN_VIEWS = 6  # frames of earlier windows that a start image is tied to
LEAST_SPREAD = 0.04  # of pixels' thresholds; a smaller one may be the map's errors
DETAIL_SIGMA = 4.0  # px; details smaller than this are learned from renders
DETAIL_RATE = 0.1  # share of a render's difference that is added to the start image


@dataclass
class _Window:
    """Frames whose changes are measured from one start image."""

    first: int  # frame
    start: np.ndarray  # [H, W] float32 log brightness


class EventImages:
    """Log brightness at the times of frames, reconstructed from events, depth and poses.

    Each window has a start image of its own, so that errors of the events (noise, a wrong threshold) do not
    accumulate. Frames of earlier windows are included in each solve. Without grey images the absolute level
    of brightness is unknown.
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastThreshold,
        config: MappingConfig,
        sharp_images: SharpImages | None = None,  # None: events alone
    ) -> None:
        self.is_solved = False
        self._camera = camera
        self._contrast_threshold = contrast.value
        self._config = config
        self._sharp_images = sharp_images
        self._archive = ChangeArchive(
            camera.shape, *contrast.relative, contrast.start_bias, keeps_activity=contrast.has_faults
        )
        self._depths: dict[int, np.ndarray | None] = {}
        self._grey: dict[int, SharpImage] = {}  # by frame
        self._windows: list[_Window] = []
        self.noisy_pixels = NoisyPixels(camera.shape)
        self._pixels: PixelThresholds | None = None  # None: all pixels are alike
        self._may_differ = contrast.has_faults  # ideal pixels are alike
        self._started = -np.inf  # time of the current window's first frame

    @property
    def frames(self) -> list[int]:
        """Frames that have an image, in order of time."""
        return self._archive.frames

    @property
    def newest_frames(self) -> list[int]:
        """Frames of the newest window."""
        return [k for k in self.frames if self._window_of(k) is self._windows[-1]]

    def depth(self, index: int) -> np.ndarray | None:
        """Return a frame's measured depth [H, W] in metres, 0 = missing."""
        return self._depths[index]

    def add(self, frame: Frame, index: int) -> None:
        """Add a frame's events, and its image unless the frame is held out."""
        self._archive.add(frame.event_counts, index, is_kept=not frame.is_held_out)
        self.noisy_pixels.add(frame.event_counts)
        if not frame.is_held_out:
            self._depths[index] = frame.depth
            self._add_grey(frame, index)
        if not self._windows:
            level = np.float32(np.log(self._config.background))
            self._begin(index, frame.timestamp, np.full(self._camera.shape, level))
        elif frame.timestamp - self._started > self._config.stretch:
            change, activity = (self._contrast_threshold * part for part in self._archive.reset())
            if self._pixels is not None:
                change = self._pixels.corrected(change, activity)
            self._begin(index + 1, frame.timestamp, self._windows[-1].start + change)

    def forget_depth(self, frames: Sequence[int]) -> None:
        """Take frames for such without depth."""
        for index in frames:
            if index in self._depths:
                self._depths[index] = None

    def log_brightness(self, index: int) -> np.ndarray:  # [H, W] float32
        """Return the image at a frame, corrected by its grey image if it has one."""
        image = self._window_of(index).start + self._change(index)
        return self._grey[index].imposed_on(image) if index in self._grey else image

    def solve(self, trajectory: Trajectory, is_thorough: bool = False) -> bool:
        """Solve the newest start image (thorough: all of them); return whether one has been solved so far."""
        windows = self._windows if is_thorough else self._windows[-1:]
        iterations = THOROUGH if is_thorough else QUICK
        for window in windows:
            own = [k for k in self.frames if self._window_of(k) is window]
            given = [k for k in self.frames if k < window.first][-GIVEN_VIEWS:] if self.is_solved else []
            if not own or len(own) + len(given) < MIN_VIEWS:
                continue
            chosen = evenly(own, self._config.solved_views)
            views = [self._view(k, trajectory, is_relative=k in chosen) for k in given + chosen]
            solved = solve_start_image(views, self._camera, window.start, iterations)
            if not given:  # the level is not observed: keep the previous one
                change = (solved.log_brightness - window.start)[solved.is_observed]
                solved.log_brightness[:] -= np.median(change) if len(change) else np.float32(0)
            window.start = solved.log_brightness
            self._tie_to_grey(window, own)
            self.is_solved = True
        return self.is_solved

    def learn_detail_from_render(self, index: int, difference: np.ndarray) -> None:
        """Move details of a frame's start image towards a render, which combines many views.

        `difference` [H, W]: log brightness of the render minus that of the image. Larger structures stay,
        because the solve determines them better. A frame with a grey image changes nothing.
        """
        if index in self._grey:
            return
        details = difference - cv2.GaussianBlur(difference, (0, 0), DETAIL_SIGMA)
        window = self._window_of(index)
        window.start = window.start + DETAIL_RATE * details

    def set_white_level(self, brightness: float) -> float:
        """Shift all images so that the brightest percent is at `brightness`; return the shift in log.

        With grey images the level is known, and the shift is 0.
        """
        if self._grey:
            return 0.0
        small = [block_means(self.log_brightness(k), 4) for k in self.frames]
        shift = float(np.log(brightness + self._config.log_epsilon) - np.percentile(small, 99))
        for window in self._windows:
            window.start = window.start + np.float32(shift)
        return shift

    def drop_surplus(self, keep: set[int]) -> None:
        """Drop frames above the limit, from the densest part of the path first; frames in `keep` go last.

        Only the older half of the frames is thinned.
        """
        while len(frames := self.frames) > self._config.max_views:
            older = range(1, max(2, len(frames) // 2))
            candidates = [i for i in older if frames[i] not in keep] or list(older)
            densest = min(candidates, key=lambda i: frames[i + 1] - frames[i - 1])
            self._archive.drop(frames[densest])
            del self._depths[frames[densest]]
            self._grey.pop(frames[densest], None)
            in_use = {self._window_of(k).first for k in self.frames}
            self._windows = [s for s in self._windows[:-1] if s.first in in_use] + self._windows[-1:]

    def compare(self, shown: Iterable[tuple[int, np.ndarray, np.ndarray]]) -> bool:
        """Find how pixels' thresholds differ; return whether they do, so that all images have changed.

        `shown`: a frame, the map's log brightness [H, W], and where it shows a surface [H, W].
        """
        if not self._may_differ:
            return False
        C = np.float32(self._contrast_threshold)

        def compared() -> Iterator[Compared]:
            for k, brightness, is_shown in shown:
                window = self._window_of(k)
                change, activity = C * self._archive.change(k), C * self._archive.activity(k)
                difference = brightness - (window.start + change)
                yield Compared(window.first, difference, change, activity, is_shown)

        found = fit_pixel_thresholds(compared(), self._camera.shape)
        if self._pixels is None and found.spread < LEAST_SPREAD:
            return False
        self._pixels = found
        return True

    def _add_grey(self, frame: Frame, index: int) -> None:
        grey = None if self._sharp_images is None else self._sharp_images.at(frame)
        if grey is not None:
            without_noise = self.noisy_pixels.replaced(grey.log_brightness)
            self._grey[index] = replace(grey, log_brightness=without_noise)

    def _tie_to_grey(self, window: _Window, frames: list[int]) -> None:
        """Shift a start image to agree with its frames' grey images, per pixel where they are not clipped."""
        total, count = np.zeros(self._camera.shape, np.float32), np.zeros(self._camera.shape, np.float32)
        for k in frames:
            if k in self._grey:
                is_exact = self._grey[k].clipped == 0
                shift = self._grey[k].log_brightness - (window.start + self._change(k))
                total += np.where(is_exact, shift, np.float32(0))
                count += is_exact
        if count.any():
            known = total[count > 0] / count[count > 0]
            shift = np.full_like(total, np.median(known))
            shift[count > 0] = known
            window.start = window.start + shift

    def _begin(self, first: int, time: float, start: np.ndarray) -> None:
        self._windows.append(_Window(first, start.astype(np.float32)))
        self._started = time

    def _window_of(self, index: int) -> _Window:
        return next(s for s in reversed(self._windows) if s.first <= index)

    def _change(self, index: int) -> np.ndarray:
        change = np.float32(self._contrast_threshold) * self._archive.change(index)
        if self._pixels is not None:
            activity = np.float32(self._contrast_threshold) * self._archive.activity(index)
            change = self._pixels.corrected(change, activity)
        return self.noisy_pixels.replaced(change)

    def _view(self, index: int, trajectory: Trajectory, is_relative: bool) -> EventView:
        change = self._change(index) if is_relative else self.log_brightness(index)
        measured = self._depths[index]
        depth = None if measured is None else with_holes_filled(measured)
        return EventView(change, depth, trajectory.pose(index), is_relative)


def evenly(frames: list[int], most: int) -> list[int]:
    """Return at most `most` of the frames, evenly spaced, including the last one."""
    if len(frames) <= most:
        return frames
    return [frames[int(k)] for k in np.linspace(0, len(frames) - 1, most)]


class FrameSampler:
    """Draws the frame for each optimisation step."""

    def __init__(self, random: np.random.Generator, num_recent: int) -> None:
        self._random = random
        self._num_recent = num_recent
        self._order: list[int] = []  # frames not yet drawn in this round

    def recent(self, frames: list[int]) -> int:
        """Draw a frame: with probability one half one of the newest, else any."""
        pool = frames[-self._num_recent :] if self._random.random() < 0.5 else frames
        return pool[int(self._random.integers(len(pool)))]

    def any(self, frames: list[int]) -> int:
        """Draw a frame; every frame is drawn once before any is drawn again."""
        if not self._order:
            self._order = list(self._random.permutation(frames))
        return int(self._order.pop())
