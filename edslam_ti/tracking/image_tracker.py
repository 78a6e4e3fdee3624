"""Tracking against log-brightness images made of events; time surfaces until there is one.

A keyframe's image comes from events alone (event_images/solve.py). Adding the change measured since then
gives the image at any later time, so that tracking is direct alignment of images and depth, as with a
camera: unbiased where time surfaces (Eq. 5) lag behind their edges, and possible between depth images.

The tracker is always in one of three states:

    Starting   no image yet: time surfaces are aligned, until the scene has moved enough to solve for one
    Tracking   frames are aligned to a keyframe's image and depth
    Coasting   events are missing although the camera moves: depth alone is aligned

A gap in the events leads from Tracking to Coasting, their return to Starting, and the next image, moved to
where an older keyframe recognises it (loop_closure.py), to Tracking.
"""

from dataclasses import dataclass, replace

import numpy as np

from edslam_ti.alignment import MIN_PIXELS
from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig, TrackingConfig
from edslam_ti.event_images.change import BrightnessChange
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse
from edslam_ti.tracking.consistency import Consistency, ConsistencyCheck, Misalignment
from edslam_ti.tracking.depth_check import FITS, OTHER_SCALE, UNUSUAL, DepthCheck, left_out, log_ratio
from edslam_ti.tracking.first_image import first_image
from edslam_ti.tracking.gaps import EventRate, bridge
from edslam_ti.tracking.keyframes import (
    BrightnessFrame,
    BrightnessKeyframe,
    KeyframeAligner,
)
from edslam_ti.tracking.loop_closure import OldKeyframes
from edslam_ti.tracking.patch_tracker import BidirectionalPatchTracker
from edslam_ti.tracking.segment import Segment
from edslam_ti.tracking.smoothing import PoseSmoother
from edslam_ti.tracking.tracker import Attempt, TrackingResult, best_attempt
from edslam_ti.tracking.uncertainty import measured
from edslam_ti.trajectory import PathDraft, Trajectory

FEW_PIXELS = 0.1  # share with depth, below which it is said: filling gaps goes only so far


@dataclass(frozen=True)
class Starting:
    """There is no brightness image yet."""

    silent_since: int = 0  # first frame of the gap in the events that has just ended, if there was one


@dataclass(frozen=True)
class Coasting:
    """Events are missing although the camera moves."""

    silent_since: int  # first frame without events


@dataclass(frozen=True)
class Tracking:
    """There is a keyframe with an image."""

    keyframe: BrightnessKeyframe
    num_misfits: int = 0  # frames in a row that could not be aligned


class BrightnessTracker:
    """Aligns each frame to the current keyframe's log-brightness image and depth (Tracker).

    Poses of recent frames are refined when a better image is known; where an older keyframe comes into view
    again, the drift since then is taken back.
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastThreshold,
        surface_config: TimeSurfaceConfig,
        config: TrackingConfig,
        seed: int,
    ) -> None:
        self._config, self._settings = config, config.images
        self._aligner = KeyframeAligner(camera, config, seed)
        self._surface_tracker = BidirectionalPatchTracker(camera, surface_config, config, seed)
        self._change = BrightnessChange(camera.shape, *contrast.by_polarity)
        self.noisy_pixels = NoisyPixels(camera.shape)
        self._segment = Segment(self._aligner, config)
        self._state: Starting | Coasting | Tracking = Starting()
        self._old_keyframes = OldKeyframes(self._aligner, config)
        self._rate = EventRate(self._settings.silent_share, self._settings.slowing_share)
        self._usual_misfit = np.inf  # log brightness; until the first image is aligned, any is usual
        self._smoother = PoseSmoother()
        self._check = ConsistencyCheck()
        self._depth_check = DepthCheck()
        self._has_noted_depth = False
        self._last_depth: np.ndarray | None = None  # [H, W] metres, as it came

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame` and corrections of earlier poses."""
        path = PathDraft(trajectory)
        note = ""
        self.noisy_pixels.add(frame.event_counts)
        if len(trajectory) > 0:
            self._rate.add(self.noisy_pixels.num_other_events(frame.event_counts))
            if self._rate.is_silent:
                note = self._without_events(path, guess)
        self._change.add(frame.event_counts)
        change = self.noisy_pixels.replaced(self._change.log_brightness())
        newest = self._aligner.brightness_frame(len(trajectory), frame, change)
        self._segment.add(newest)
        state = self._state
        if isinstance(state, Tracking):
            usual_misfit = self._usual_misfit
            best = self._follow(state.keyframe, newest, guess, path)
            path.newest = best.result.T_world_camera
            is_repeated = self._is_repeated(frame)
            without = self._compare(state.keyframe, newest, best, usual_misfit, is_repeated, path)
            if without is not None:
                newest, best = replace(newest, depth=None), without
                self._segment.recent[-1], self._usual_misfit = newest, usual_misfit
            result = best.result
            path.newest = result.T_world_camera
            self._last_depth = frame.depth if frame.depth is not None else self._last_depth
            note = note or self._keep_up(state, newest, result.converged, best.overlap, path)
        else:
            if isinstance(state, Coasting):
                result = self._coast(newest, guess, path)
                if frame.depth is not None and not self._rate.is_silent:
                    # Surfaces from before the gap are no reference: the pose may have drifted.
                    self._surface_tracker.refer_to(frame)
                    self._state = Starting(state.silent_since)
            else:
                result = self._surface_tracker.track(frame, guess, trajectory)
            path.newest = result.T_world_camera
            if isinstance(self._state, Starting) and (image := first_image(self._segment, path)) is not None:
                self._segment = image.segment
                self._depth_check.begin(image.flows)
                note = self._relocalise(image.keyframe, self._state.silent_since, path)
                self._state = Tracking(image.keyframe)
                if image.left_out:
                    distrusted = sorted(image.left_out)
                    note = f"{note}; {left_out(distrusted)}"
                    result = replace(result, distrusted=tuple(distrusted))
        notes = (result.message or note, self._note_on_depth(frame))
        message = "; ".join(text for text in notes if text)
        return replace(result, T_world_camera=path.newest, message=message, corrections=path.corrections)

    def log_brightness(self) -> np.ndarray | None:  # [h, w]
        """Return the newest frame's image as events determine it, for viewers; None before the first one."""
        if not isinstance(self._state, Tracking) or not self._segment.recent:
            return None
        return self._state.keyframe.image_at(self._segment.recent[-1])

    def consistency(self, trajectory: Trajectory) -> Consistency | None:
        """Return whether events and depth told the same motion; None: too little was compared."""
        return self._check.result(trajectory)

    def misalignment(self, trajectory: Trajectory) -> Misalignment | None:
        """Return the delay and the rotation of depth that explain how its poses differ; None: too few."""
        return self._check.misalignment(trajectory)

    def _note_on_depth(self, frame: Frame) -> str:
        """Return, once, that few pixels have depth."""
        share = 0.0 if frame.depth is None else np.count_nonzero(frame.depth > 0) / frame.depth.size
        if self._has_noted_depth or not 0 < share < FEW_PIXELS:
            return ""
        self._has_noted_depth = True
        return f"only {100 * share:.2g} % of the pixels have depth"

    def _is_repeated(self, frame: Frame) -> bool:
        """Return whether a depth image is that of the frame before, to the last bit."""
        last = self._last_depth
        return frame.depth is not None and last is not None and np.array_equal(frame.depth, last)

    def _compare(
        self,
        keyframe: BrightnessKeyframe,
        newest: BrightnessFrame,
        best: Attempt,
        usual_misfit: float,
        is_repeated: bool,
        path: PathDraft,
    ) -> Attempt | None:
        """Measure the newest pose by brightness alone, too, to see whether depth says the same.

        Return that pose where depth contradicts it and is to be left out.
        """
        if newest.depth is None or newest.index == keyframe.index:
            return None
        is_good = best.result.converged
        is_wanted = is_good and self._check.wants()
        T_now_keyframe = inverse(path.newest) @ path.pose(keyframe.index)
        ratio = log_ratio(keyframe.depth.small, newest.depth.small, T_now_keyframe, self._aligner.camera)
        is_other_scale = is_good and ratio > OTHER_SCALE
        if is_good and not is_wanted and not is_other_scale and best.misfit < UNUSUAL * usual_misfit:
            return None
        aligned = self._segment.align(keyframe, newest, None, path.newest, path)
        result = self._segment.judged(aligned, keyframe, path.newest, path)
        if not result.converged:
            return None
        T_now_then = inverse(result.T_world_camera) @ path.newest
        flow = self._aligner.flow(newest.depth.small, T_now_then)
        if is_other_scale:
            is_wrong = self._depth_check.may_leave_out()
        elif is_good:
            is_wrong = self._depth_check.contradicts(flow, best.misfit, aligned.misfit)
        else:
            fits = aligned.misfit < FITS * usual_misfit
            is_wrong = fits and self._depth_check.may_leave_out()
        if is_wrong:
            noted = replace(result, message=left_out([newest.index]), distrusted=(newest.index,))
            return Attempt(noted, True, aligned.overlap, aligned.misfit)
        if is_wanted:
            self._check.add(
                newest.index, keyframe.index, path.newest, result.T_world_camera, aligned.system, is_repeated
            )
        return None

    # --- without events ---

    def _without_events(self, path: PathDraft, guess: np.ndarray) -> str:
        """Start a new segment where events are missing although the camera moves; return what happened."""
        index = len(path.trajectory)
        if not isinstance(self._state, Tracking):
            self._begin_segment(index)
            return ""
        T_now_before = inverse(guess) @ path.pose(index - 1)
        flow = self._aligner.flow(self._state.keyframe.depth.small, T_now_before)
        if flow < self._settings.silent_flow or self._rate.was_slowing:
            return ""  # the camera has stopped: its image stays as it is
        self._give_up_image(self._state.keyframe, index)
        return "events are missing: depth alone is aligned"

    def _give_up_image(self, keyframe: BrightnessKeyframe, index: int) -> None:
        """Keep a keyframe as a place to be recognised, and go on by depth from frame `index` on."""
        self._old_keyframes.add(keyframe)
        self._state = Coasting(silent_since=index)
        self._begin_segment(index)

    def _begin_segment(self, index: int) -> None:
        self._segment.begin(index)
        self._change.reset()

    def _coast(self, newest: BrightnessFrame, guess: np.ndarray, path: PathDraft) -> TrackingResult:
        """Align depth alone to the last keyframe's."""
        if newest.depth is None or not newest.depth.small.any():
            return TrackingResult(guess, False, 0.0, "too few events, and no depth to align instead")
        old = self._aligner.with_points(self._old_keyframes.newest)
        T_world_old = path.pose(old.index)
        T, system = self._aligner.align_depth(old, newest.depth, inverse(T_world_old) @ guess)
        if system.num_depth < MIN_PIXELS:
            return TrackingResult(guess, False, 0.0, "too few events, and depth does not overlap")
        measurement = measured(old.index, [system])
        quality = 0.5 * system.num_depth / system.num_usable
        return TrackingResult(T_world_old @ T, True, quality, measurement=measurement)

    # --- the first image of a segment ---

    def _relocalise(self, keyframe: BrightnessKeyframe, silent_since: int, path: PathDraft) -> str:
        """Move the segment to where an older keyframe shows it to be; return what happened."""
        found = self._old_keyframes.relocalised(keyframe, path)
        if found is None:
            return "no place recognised" if len(self._old_keyframes) else "first brightness image"
        T_world_camera, message = found
        correction = T_world_camera @ inverse(path.pose(keyframe.index))
        bridge(path, silent_since - 1, self._segment.start, correction)
        return message

    # --- frame by frame ---

    def _follow(
        self, keyframe: BrightnessKeyframe, frame: BrightnessFrame, guess: np.ndarray, path: PathDraft
    ) -> Attempt:
        """Return the better alignment: from the predicted pose and, where that is in doubt, from the last."""

        def attempt(start: np.ndarray) -> Attempt:
            aligned = self._segment.align(keyframe, frame, frame.depth, start, path)
            result = self._segment.judged(aligned, keyframe, guess, path)
            is_sure = result.converged and aligned.misfit < self._settings.doubtful * self._usual_misfit
            return Attempt(result, is_sure, aligned.overlap, aligned.misfit)

        best = best_attempt(attempt, guess, path.trajectory.pose(-1))
        if best.result.converged:
            usual = self._usual_misfit if np.isfinite(self._usual_misfit) else best.misfit
            self._usual_misfit = 0.8 * usual + 0.2 * best.misfit
        return best

    def _keep_up(
        self, state: Tracking, newest: BrightnessFrame, is_good: bool, overlap: float, path: PathDraft
    ) -> str:
        """Change the keyframe when too little of it is in view, improve its image now and then."""
        keyframe = state.keyframe
        num_misfits = 0 if is_good else state.num_misfits + 1
        self._state = Tracking(keyframe, num_misfits)
        if num_misfits > self._settings.max_misfits:
            self._give_up_image(keyframe, len(path.trajectory))
            return "brightness image given up"
        if not is_good:
            return ""
        if newest.depth is not None:
            self._settle(keyframe, newest, path)
        is_new = newest.depth is not None and overlap < self._config.min_overlap
        if is_new:
            if keyframe.is_new_place:
                self._old_keyframes.add(keyframe)
            keyframe = self._segment.new_keyframe(newest, keyframe.image_at(newest))
            self._state = Tracking(keyframe)
        elif newest.index < keyframe.next_solution:
            return ""
        self._segment.solve(keyframe, path)
        keyframe.next_solution = newest.index + max(
            self._settings.solve_interval, newest.index - keyframe.index
        )
        return self._old_keyframes.close_loop(keyframe, path) if is_new else ""

    def _settle(self, keyframe: BrightnessKeyframe, newest: BrightnessFrame, path: PathDraft) -> None:
        """Correct the poses between the last two frames with depth, now that both ends are known."""
        frames = self._segment.since_depth(newest)
        if len(frames) < 3:
            return
        self._segment.solve(keyframe, path)
        by_brightness = [self._segment.without_depth(keyframe, f, path) for f in frames]
        known = [a for a in by_brightness if a is not None]
        if len(known) == len(frames):
            self._smoother.settle(frames, known, self._segment.recent, path)
