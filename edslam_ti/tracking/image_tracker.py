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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edslam_ti.alignment import MIN_PIXELS, mean_cost
from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig, TrackingConfig
from edslam_ti.event_images.change import BrightnessChange
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.noisy import NoisyPixels
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.tracking.consistency import Consistency, ConsistencyCheck
from edslam_ti.tracking.depth_check import (
    BETTER,
    FEWEST,
    FITS,
    ROUNDS,
    SETTLED_FLOW,
    SMALLEST_FLOW,
    UNUSUAL,
    DepthCheck,
    left_out,
    sets_to_try,
)
from edslam_ti.tracking.gaps import EventRate, bridge
from edslam_ti.tracking.keyframes import (
    Aligned,
    BrightnessFrame,
    BrightnessKeyframe,
    Depth,
    KeyframeAligner,
)
from edslam_ti.tracking.loop_closure import OldKeyframes
from edslam_ti.tracking.patch_tracker import BidirectionalPatchTracker
from edslam_ti.tracking.smoothing import PoseSmoother
from edslam_ti.tracking.tracker import Attempt, TrackingResult, best_attempt
from edslam_ti.tracking.uncertainty import measured
from edslam_ti.trajectory import PathDraft, Trajectory


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


@dataclass(frozen=True)
class _FirstImage:
    """A first image, from recent frames of which some may have lost their depth."""

    keyframe: BrightnessKeyframe
    recent: list[BrightnessFrame]
    path: PathDraft
    flows: list[float]  # px, between poses with depth and by brightness alone
    misfit: float  # log brightness, mean of the frames by brightness alone
    left_out: frozenset[int]  # frames whose depth is


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
        self._segment_start = 0  # first frame of the segment of uninterrupted events
        self._recent: list[BrightnessFrame] = []  # last frames of the segment
        self._state: Starting | Coasting | Tracking = Starting()
        self._old_keyframes = OldKeyframes(self._aligner, config)
        self._rate = EventRate(self._settings.silent_share, self._settings.slowing_share)
        self._usual_misfit = np.inf  # log brightness; until the first image is aligned, any is usual
        self._smoother = PoseSmoother()
        self._check = ConsistencyCheck()
        self._depth_check = DepthCheck()
        self._left_out: list[int] = []  # frames found to have wrong depth as the first image was solved for
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
        self._recent = [*self._recent, newest][-self._settings.window :]
        state = self._state
        if isinstance(state, Tracking):
            usual_misfit = self._usual_misfit
            best = self._follow(state.keyframe, newest, guess, path)
            path.newest = best.result.T_world_camera
            is_repeated = self._is_repeated(frame)
            without = self._compare(state.keyframe, newest, best, usual_misfit, is_repeated, path)
            if without is not None:
                newest, best = replace(newest, depth=None), without
                self._recent[-1], self._usual_misfit = newest, usual_misfit
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
            if isinstance(self._state, Starting) and (keyframe := self._first_keyframe(path)) is not None:
                note = self._relocalise(keyframe, self._state.silent_since, path)
                self._state = Tracking(keyframe)
                if self._left_out:
                    note = f"{note}; {left_out(self._left_out)}"
                    result = replace(result, distrusted=tuple(self._left_out))
                    self._left_out = []
        message = result.message or note
        return replace(result, T_world_camera=path.newest, message=message, corrections=path.corrections)

    def consistency(self, trajectory: Trajectory) -> Consistency | None:
        """Return whether events and depth told the same motion; None: too little was compared."""
        return self._check.result(trajectory)

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
        if is_good and not is_wanted and best.misfit < UNUSUAL * usual_misfit:
            return None
        aligned = self._align(keyframe, newest, None, path.newest, path)
        result = self._judged(aligned, keyframe, path.newest, path)
        if not result.converged:
            return None
        T_now_then = inverse(result.T_world_camera) @ path.newest
        flow = self._aligner.flow(newest.depth.small, T_now_then)
        if is_good:
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
        self._segment_start = index
        self._change.reset()
        self._recent = []

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

    def _first_keyframe(self, path: PathDraft) -> BrightnessKeyframe | None:
        """Return a keyframe with the segment's first image, None until the scene has moved enough."""
        with_depth = [f for f in self._recent if f.depth is not None]
        if len(self._recent) < self._settings.min_frames or not with_depth:
            return None
        frame = self._middle(with_depth)
        assert frame.depth is not None
        T_now_then = inverse(path.newest) @ path.pose(frame.index)
        if self._aligner.flow(frame.depth.small, T_now_then) < self._settings.min_flow:
            return None
        by_surfaces = {f.index: path.pose(f.index) for f in self._recent}
        keyframe = self._solved_first(path)
        flows = self._contradictions(keyframe, path)
        if max(flows) > SMALLEST_FLOW:
            keyframe, flows = self._without_wrong_depth(keyframe, flows, by_surfaces, path)
        self._depth_check.begin(flows)
        return keyframe

    def _middle(self, frames: Sequence[BrightnessFrame]) -> BrightnessFrame:
        """Return the one of some frames that is nearest to the middle of the recent ones."""
        middle = self._recent[len(self._recent) // 2].index
        return min(frames, key=lambda f: abs(f.index - middle))

    def _solved_first(self, path: PathDraft, rounds: int = 2, fixed: int = 0) -> BrightnessKeyframe:
        """Return a keyframe in the middle of the recent frames, image and poses solved for in turn."""
        frame = self._middle([f for f in self._recent if f.depth is not None])
        assert frame.depth is not None
        keyframe = self._new_keyframe(frame, np.zeros_like(frame.depth.small))
        self._solve(keyframe, path, iterations=40, is_robust=False)
        for _ in range(rounds):
            self._solve(keyframe, path)
            self._realign(keyframe, path, fixed)
        self._solve(keyframe, path)
        return keyframe

    def _contradictions(self, keyframe: BrightnessKeyframe, path: PathDraft) -> list[float]:
        """Return the flow in pixels between each recent frame's pose and that by brightness alone."""
        flows = [0.0]  # the keyframe's
        for frame in self._recent:
            if frame.depth is None or frame.index == keyframe.index:
                continue
            found = self._aligned_without_depth(keyframe, frame, path)
            if found is not None:
                T_now_then = inverse(found[0]) @ path.pose(frame.index)
                flows.append(self._aligner.flow(frame.depth.small, T_now_then))
        return flows

    def _without_wrong_depth(
        self,
        keyframe: BrightnessKeyframe,
        flows: list[float],
        by_surfaces: dict[int, np.ndarray],
        path: PathDraft,
    ) -> tuple[BrightnessKeyframe, list[float]]:
        """Leave out the depth of those recent frames without which brightness fits far better.

        Return a keyframe, and the contradictions that are left.
        """
        recent, state = self._recent, self._aligner.random_state
        best = _FirstImage(keyframe, recent, path, flows, self._misfit(keyframe, path), frozenset())
        with_depth = [f.index for f in recent if f.depth is not None]
        for number in range(1, min(len(recent) // 2, len(with_depth) - FEWEST) + 1):
            trials = [
                self._first_image_without(left, by_surfaces, recent, path)
                for left in sets_to_try(with_depth, number, best.left_out)
            ]
            found = min(trials, key=lambda trial: trial.misfit)
            if found.misfit < BETTER * best.misfit:
                best = found
            elif best.left_out:
                break
            if max(best.flows) < SETTLED_FLOW:
                break
        self._recent = best.recent
        if not best.left_out:
            self._aligner.random_state = state  # as if nothing had been tried
            return keyframe, flows
        for frame in best.recent:
            path.replace(frame.index, best.path.pose(frame.index))
        self._left_out = sorted(best.left_out)
        return best.keyframe, best.flows

    def _first_image_without(
        self,
        left: frozenset[int],
        by_surfaces: dict[int, np.ndarray],
        recent: list[BrightnessFrame],
        path: PathDraft,
    ) -> "_FirstImage":
        """Return the first image where some frames' depth is left out."""
        self._recent = [replace(f, depth=None) if f.index in left else f for f in recent]
        known = self._by_depth(by_surfaces)
        trial = PathDraft(path.trajectory)
        trial.newest, trial.corrections = path.newest, dict(path.corrections)
        for frame in recent:
            trial.replace(frame.index, known.at(frame.timestamp))
        is_first_wrong = 0 in left
        keyframe = self._solved_first(trial, ROUNDS, fixed=-1 if is_first_wrong else 0)
        if is_first_wrong:  # its pose is given: all others move
            T = path.pose(0) @ inverse(trial.pose(0))
            for frame in recent:
                trial.replace(frame.index, T @ trial.pose(frame.index))
        flows, misfit = self._contradictions(keyframe, trial), self._misfit(keyframe, trial)
        return _FirstImage(keyframe, self._recent, trial, flows, misfit, left)

    def _by_depth(self, by_surfaces: dict[int, np.ndarray]) -> Trajectory:
        """Return poses of the recent frames with depth, aligned by depth alone to that in the middle."""
        with_depth = [f for f in self._recent if f.depth is not None]
        middle = self._middle(with_depth)
        assert middle.depth is not None
        nothing = np.zeros_like(middle.depth.small)
        reference = self._aligner.with_points(self._new_keyframe(middle, nothing))
        T_world_middle, poses = by_surfaces[middle.index], []
        for frame in with_depth:
            assert frame.depth is not None
            start = inverse(T_world_middle) @ by_surfaces[frame.index]
            if frame is not middle:  # a wrong frame before may have led astray
                found = [self._aligner.align_depth(reference, frame.depth, T) for T in (start, np.eye(4))]
                start, _ = min(found, key=lambda pair: mean_cost(pair[1]))
            poses.append(T_world_middle @ start)
        return Trajectory(np.array([f.timestamp for f in with_depth]), np.array(poses))

    def _misfit(self, keyframe: BrightnessKeyframe, path: PathDraft) -> float:
        """Return the mean misfit of recent frames aligned by brightness alone."""
        misfits = [
            min(self._align(keyframe, f, None, path.pose(f.index), path).misfit, self._settings.max_misfit)
            for f in self._recent
            if f.index != keyframe.index
        ]
        return float(np.mean(misfits))

    def _new_keyframe(self, frame: BrightnessFrame, log_brightness: np.ndarray) -> BrightnessKeyframe:
        assert frame.depth is not None
        next_solution = self._recent[-1].index + self._settings.solve_interval
        return BrightnessKeyframe(
            frame.index, frame.change, frame.depth, frame.depth, log_brightness,
            points=[], depth_points=None, next_solution=next_solution,
        )  # fmt: skip

    def _realign(self, keyframe: BrightnessKeyframe, path: PathDraft, fixed: int = 0) -> None:
        """Align recent frames once more, to a better image than they were tracked with, but a fixed one."""
        for frame in self._recent:
            if frame.index in (fixed, keyframe.index):
                continue
            start = path.pose(frame.index)
            result = self._judged(
                self._align(keyframe, frame, frame.depth, start, path), keyframe, start, path
            )
            if result.converged:
                path.replace(frame.index, result.T_world_camera)

    def _relocalise(self, keyframe: BrightnessKeyframe, silent_since: int, path: PathDraft) -> str:
        """Move the segment to where an older keyframe shows it to be; return what happened."""
        found = self._old_keyframes.relocalised(keyframe, path)
        if found is None:
            return "no place recognised" if len(self._old_keyframes) else "first brightness image"
        T_world_camera, message = found
        correction = T_world_camera @ inverse(path.pose(keyframe.index))
        bridge(path, silent_since - 1, self._segment_start, correction)
        return message

    # --- frame by frame ---

    def _follow(
        self, keyframe: BrightnessKeyframe, frame: BrightnessFrame, guess: np.ndarray, path: PathDraft
    ) -> Attempt:
        """Return the better alignment: from the predicted pose and, where that is in doubt, from the last."""

        def attempt(start: np.ndarray) -> Attempt:
            aligned = self._align(keyframe, frame, frame.depth, start, path)
            result = self._judged(aligned, keyframe, guess, path)
            is_sure = result.converged and aligned.misfit < self._settings.doubtful * self._usual_misfit
            return Attempt(result, is_sure, aligned.overlap, aligned.misfit)

        best = best_attempt(attempt, guess, path.trajectory.pose(-1))
        if best.result.converged:
            usual = self._usual_misfit if np.isfinite(self._usual_misfit) else best.misfit
            self._usual_misfit = 0.8 * usual + 0.2 * best.misfit
        return best

    def _align(
        self,
        keyframe: BrightnessKeyframe,
        frame: BrightnessFrame,
        depth: Depth | None,  # what is aligned beside the image
        start: np.ndarray,  # [4, 4] T_world_camera
        path: PathDraft,
    ) -> Aligned:
        T_keyframe_world = inverse(path.pose(keyframe.index))
        return self._aligner.align(keyframe, keyframe.image_at(frame), depth, T_keyframe_world @ start)

    def _judged(
        self, aligned: Aligned, keyframe: BrightnessKeyframe, guess: np.ndarray, path: PathDraft
    ) -> TrackingResult:
        """Return the pose, or the guess and a reason where it cannot be trusted."""
        problem = aligned.problem(self._config)
        T = guess if problem else path.pose(keyframe.index) @ aligned.T_keyframe_camera
        measurement = None if problem else measured(keyframe.index, aligned.last)
        quality = aligned.quality(self._config)
        return TrackingResult(T, not problem, quality, problem, measurement=measurement)

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
            keyframe = self._new_keyframe(newest, keyframe.image_at(newest))
            self._state = Tracking(keyframe)
        elif newest.index < keyframe.next_solution:
            return ""
        self._solve(keyframe, path)
        keyframe.next_solution = newest.index + max(
            self._settings.solve_interval, newest.index - keyframe.index
        )
        return self._old_keyframes.close_loop(keyframe, path) if is_new else ""

    def _settle(self, keyframe: BrightnessKeyframe, newest: BrightnessFrame, path: PathDraft) -> None:
        """Correct the poses between the last two frames with depth, now that both ends are known."""
        frames = self._since_depth(newest)
        if len(frames) < 3:
            return
        self._solve(keyframe, path)
        by_brightness = [self._aligned_without_depth(keyframe, f, path) for f in frames]
        known = [a for a in by_brightness if a is not None]
        if len(known) == len(frames):
            self._smoother.settle(frames, known, self._recent, path)

    def _since_depth(self, newest: BrightnessFrame) -> list[BrightnessFrame]:
        """Return the frames from the last one with depth up to a new one."""
        for k in range(len(self._recent) - 2, -1, -1):
            if self._recent[k].depth is not None:
                return self._recent[k:]
        return [newest]

    def _aligned_without_depth(
        self, keyframe: BrightnessKeyframe, frame: BrightnessFrame, path: PathDraft
    ) -> tuple[np.ndarray, NormalEquations] | None:
        """Return the pose by brightness alone and how well it is determined, or None."""
        T = path.pose(frame.index)
        aligned = self._align(keyframe, frame, None, T, path)
        if frame.index == keyframe.index:
            return T, aligned.system
        result = self._judged(aligned, keyframe, T, path)
        return (result.T_world_camera, aligned.system) if result.converged else None

    def _solve(
        self, keyframe: BrightnessKeyframe, path: PathDraft, iterations: int = 8, is_robust: bool = True
    ) -> None:
        """Solve for the keyframe's image from recent frames, and choose its pixels to align."""
        others = [f for f in self._recent if f.index != keyframe.index]
        count = min(len(others), self._settings.observations)
        frames = [others[round(k)] for k in np.linspace(0, len(others) - 1, count)]
        T_world_keyframe = path.pose(keyframe.index)
        poses = [inverse(path.pose(f.index)) @ T_world_keyframe for f in frames]
        self._aligner.solve(keyframe, frames, poses, iterations, is_robust)
