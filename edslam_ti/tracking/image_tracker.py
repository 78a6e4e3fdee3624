"""Tracking against log-brightness images made of events; time surfaces until there is one.

A keyframe's image comes from events alone (brightness_image.py). Adding the change measured since then
gives the image at any later time, so that tracking is direct alignment of images and depth, as with a
camera: unbiased where time surfaces (Eq. 5) lag behind their edges, and possible between depth images.
"""

import numpy as np

from edslam_ti.alignment import MIN_PIXELS
from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig, TrackingConfig
from edslam_ti.event_images.change import BrightnessChange
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, is_near, se3_exp, se3_log
from edslam_ti.kernels.patch_warp import NormalEquations
from edslam_ti.tracking.keyframes import Aligned, BrightnessKeyframe, Depth, KeyframeAligner, Moment
from edslam_ti.tracking.motion_prior import MeasuredPose, MotionPrior
from edslam_ti.tracking.patch_tracker import BidirectionalPatchTracker
from edslam_ti.tracking.place_recognition import recognised
from edslam_ti.tracking.pose_graph import Revisit, corrections, spread
from edslam_ti.tracking.tracker import Attempt, TrackingResult, best_attempt
from edslam_ti.trajectory import Trajectory

WINDOW = 12  # frames a keyframe's image is solved from
OBSERVATIONS = 5  # of them that its equations are taken from
MIN_FRAMES = 5  # before the first image is solved
MIN_FLOW = 1.5  # pixels of brightness images that the scene must have moved before the first image is solved
SMOOTHED_FROM = 2  # frames before those that are smoothed, which tell the velocity there
MIN_SOLVE_FRAMES = 3  # between two solutions for one keyframe
SILENT_SHARE = 0.02  # fewer events than this share of the usual number: the camera or the stream stopped
SLOWING_SHARE = 0.2  # fewer than this in the frame before: the camera was coming to rest
SILENT_FLOW = 0.3  # pixels a frame: a camera this fast does not stop within one frame
DOUBTFUL = 1.25  # times the usual misfit: the camera may have stopped where it was expected to go on
MAX_MISFITS = 4  # such frames in a row after which the image is given up
REVISIT_OVERLAP = 0.6  # share of an old keyframe's pixels that must be in view again
REVISIT_MISFIT = 0.12  # log brightness, median
NO_DRIFT = (0.003, 0.2)  # metres, degrees: smaller corrections are the alignment's own error
MAX_DRIFT = (0.3, 15.0)  # metres, degrees: larger ones are not believed
COASTED = (0.02, 2.0)  # metres, degrees: depth alone has done no better than a guess
MAX_REVISITS = 3  # old keyframes compared with a new one
MAX_RECOGNISED = 20  # old keyframes searched after a gap


class BrightnessTracker:
    """Aligns each frame to the current keyframe's log-brightness image and depth.

    Until the first image is solved for, and while events are missing, time surfaces and depth are
    aligned instead. Poses of recent frames are refined when a better image is known; where an older
    keyframe comes into view again, the drift since then is taken back.
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastThreshold,
        surface_config: TimeSurfaceConfig,
        config: TrackingConfig,
        seed: int,
    ) -> None:
        self._config = config
        self._aligner = KeyframeAligner(camera, config, seed)
        self._surface_tracker = BidirectionalPatchTracker(camera, surface_config, config, seed)
        self._change = BrightnessChange(camera.shape, *contrast.by_polarity)
        self._stretch_start = 0  # first frame of the stretch of uninterrupted events
        self._moments: list[Moment] = []  # the last frames of the stretch
        self._keyframe: BrightnessKeyframe | None = None  # None: no image yet
        self._old_keyframes: list[BrightnessKeyframe] = []
        self._revisits: list[Revisit] = []
        self._is_silent, self._silent_since = False, 0  # events are missing; first such frame
        self._usual_events, self._last_count = 0.0, 0
        self._num_misfits = 0
        self._usual_misfit = np.inf  # log brightness; until the first image is aligned, any is usual
        self._motion = MotionPrior()
        self._settled: list[MeasuredPose] = []  # between the last two frames with depth, and these
        self._path = _Path(Trajectory())

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; earlier poses on the trajectory may be corrected."""
        self._path = _Path(trajectory)
        note = "" if len(trajectory) == 0 else self._noticed_gap(frame, guess)
        moment = self._take_in(frame, len(trajectory))
        if self._keyframe is None:
            if self._is_silent:
                result = self._coast(moment, guess)
                if frame.depth is not None and len(frame.events) >= SILENT_SHARE * self._usual_events:
                    # Surfaces from before the gap are no reference: the pose may have drifted.
                    self._surface_tracker.refer_to(frame)
                    self._is_silent = False
            else:
                result = self._surface_tracker.track(frame, guess, trajectory)
            self._path.newest = result.T_world_camera
            if not self._is_silent and self._begin():
                note = self._relocalise()
        else:
            best = self._follow(moment, guess)
            result = best.result
            self._path.newest = result.T_world_camera
            note = note or self._keep_up(moment, result.converged, best.overlap)
        message = result.message or note
        return TrackingResult(self._path.newest, result.converged, result.quality, message)

    # --- what is measured ---

    def _take_in(self, frame: Frame, index: int) -> Moment:
        self._change.add(frame.event_counts)
        moment = self._aligner.moment(index, frame, self._change.log_brightness())
        self._moments = [*self._moments, moment][-WINDOW:]
        return moment

    def _noticed_gap(self, frame: Frame, guess: np.ndarray) -> str:
        """Start anew where events are missing although the camera moves; return what happened."""
        count, before, usual = len(frame.events), self._last_count, self._usual_events
        self._last_count = count
        if count >= SILENT_SHARE * usual:
            self._usual_events = count if usual == 0 else 0.9 * usual + 0.1 * count
            return ""
        if self._keyframe is None:
            self._begin_stretch(len(self._path.trajectory))
            return ""
        T_now_before = inverse(guess) @ self._path.pose(len(self._path.trajectory) - 1)
        flow = self._aligner.flow(self._keyframe.depth.small, T_now_before)
        if flow < SILENT_FLOW or before < SLOWING_SHARE * usual:
            return ""  # the camera has stopped: its image stays as it is
        self._give_up_image()
        return "events are missing: depth alone is aligned"

    def _give_up_image(self) -> None:
        assert self._keyframe is not None
        self._old_keyframes.append(self._keyframe.reduced())
        self._keyframe = None
        self._is_silent, self._silent_since = True, len(self._path.trajectory)
        self._begin_stretch(len(self._path.trajectory))

    def _begin_stretch(self, index: int) -> None:
        self._stretch_start = index
        self._change.reset()
        self._moments = []
        self._num_misfits = 0

    def _coast(self, moment: Moment, guess: np.ndarray) -> TrackingResult:
        """Align depth alone to the last keyframe's."""
        if moment.depth is None or not moment.depth.small.any():
            return TrackingResult(guess, False, 0.0, "too few events, and no depth to align instead")
        old = self._aligner.with_points(self._old_keyframes[-1])
        T_world_old = self._path.pose(old.index)
        T, system = self._aligner.align_depth(old, moment.depth, inverse(T_world_old) @ guess)
        if system.num_depth < MIN_PIXELS:
            return TrackingResult(guess, False, 0.0, "too few events, and depth does not overlap")
        return TrackingResult(T_world_old @ T, True, 0.5 * system.num_depth / system.num_usable)

    # --- the first image of a stretch ---

    def _begin(self) -> bool:
        """Solve for the first keyframe's image, once the scene has moved enough; return whether."""
        with_depth = [m for m in self._moments if m.depth is not None]
        if len(self._moments) < MIN_FRAMES or not with_depth:
            return False
        middle = self._moments[len(self._moments) // 2].index
        moment = min(with_depth, key=lambda m: abs(m.index - middle))
        assert moment.depth is not None
        T_now_then = inverse(self._path.newest) @ self._path.pose(moment.index)
        if self._aligner.flow(moment.depth.small, T_now_then) < MIN_FLOW:
            return False
        self._keyframe = self._new_keyframe(moment, np.zeros_like(moment.depth.small))
        self._solve(iterations=40, is_robust=False)
        for _ in range(2):  # image and poses in turn
            self._solve()
            self._realign(self._moments)
        self._solve()
        return True

    def _new_keyframe(self, moment: Moment, log_brightness: np.ndarray) -> BrightnessKeyframe:
        assert moment.depth is not None
        return BrightnessKeyframe(
            moment.index, moment.change, moment.depth, moment.depth, log_brightness,
            points=[], depth_points=None, next_solution=self._moments[-1].index + MIN_SOLVE_FRAMES,
        )  # fmt: skip

    # --- frame by frame ---

    def _follow(self, moment: Moment, guess: np.ndarray) -> Attempt:
        """Return the better alignment: from the predicted pose and, where that is in doubt, from the last."""

        def attempt(start: np.ndarray) -> Attempt:
            aligned = self._align(moment, moment.depth, start)
            result = self._judged(aligned, guess)
            is_sure = result.converged and aligned.misfit < DOUBTFUL * self._usual_misfit
            return Attempt(result, is_sure, aligned.overlap, aligned.misfit)

        best = best_attempt(attempt, guess, self._path.pose(-1))
        if best.result.converged:
            usual = self._usual_misfit if np.isfinite(self._usual_misfit) else best.misfit
            self._usual_misfit = 0.8 * usual + 0.2 * best.misfit
        return best

    def _align(self, moment: Moment, depth: Depth | None, start: np.ndarray) -> Aligned:
        """Align a moment to the keyframe, with this depth; `start` is a T_world_camera."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_keyframe_world = inverse(self._path.pose(keyframe.index))
        return self._aligner.align(keyframe, keyframe.image_at(moment), depth, T_keyframe_world @ start)

    def _judged(self, aligned: Aligned, guess: np.ndarray) -> TrackingResult:
        """Return the pose, or the guess and a reason where it cannot be trusted."""
        assert self._keyframe is not None
        problem = aligned.problem(self._config.min_inliers)
        T = guess if problem else self._path.pose(self._keyframe.index) @ aligned.T_keyframe_camera
        return TrackingResult(T, not problem, aligned.quality, problem)

    def _keep_up(self, moment: Moment, is_good: bool, overlap: float) -> str:
        """Change the keyframe when too little of it is in view, improve its image now and then."""
        keyframe = self._keyframe
        assert keyframe is not None
        self._num_misfits = 0 if is_good else self._num_misfits + 1
        if self._num_misfits > MAX_MISFITS:
            self._give_up_image()
            return "brightness image given up"
        if not is_good:
            return ""
        if moment.depth is not None:
            self._settle(moment)
        is_new = moment.depth is not None and overlap < self._config.min_overlap
        if is_new:
            if keyframe.is_new_place:
                self._old_keyframes.append(keyframe.reduced())
            keyframe = self._keyframe = self._new_keyframe(moment, keyframe.image_at(moment))
        elif moment.index < keyframe.next_solution:
            return ""
        self._solve()
        keyframe.next_solution = moment.index + max(MIN_SOLVE_FRAMES, moment.index - keyframe.index)
        return self._revisit() if is_new else ""

    def _settle(self, moment: Moment) -> None:
        """Correct the poses between the last two frames with depth.

        They hang on brightness alone. What brightness alone gets wrong shows at both ends, where depth
        tells the pose; in between it changes little by little. And velocity changes little.
        """
        frames = self._since_depth(moment)
        if len(frames) < 3:
            return
        self._solve()
        by_brightness = [a for m in frames if (a := self._aligned_without_depth(m)) is not None]
        if len(by_brightness) < len(frames):
            return
        poses, systems = zip(*by_brightness)
        known = [self._path.pose(m.index) for m in (frames[0], frames[-1])]
        start, end = (se3_log(inverse(poses[k]) @ T) for k, T in zip((0, -1), known))
        self._learn_motion([(start, systems[0].H), (end, systems[-1].H)])
        measured = [MeasuredPose(frames[0].index, frames[0].timestamp, known[0], None)]
        for m, T, system in zip(frames[1:-1], poses[1:-1], systems[1:-1]):
            share = (m.timestamp - frames[0].timestamp) / (moment.timestamp - frames[0].timestamp)
            corrected = T @ se3_exp((1 - share) * start + share * end)
            # Errors of neighbouring frames are alike: together they count as one.
            information = system.H / (self._motion.error * (len(frames) - 2))
            measured.append(MeasuredPose(m.index, m.timestamp, corrected, information))
        measured.append(MeasuredPose(moment.index, moment.timestamp, known[1], None))
        self._smooth(measured)

    def _since_depth(self, moment: Moment) -> list[Moment]:
        """Return the frames from the last one with depth up to a new one."""
        for k in range(len(self._moments) - 2, -1, -1):
            if self._moments[k].depth is not None:
                return self._moments[k:]
        return [moment]

    def _aligned_without_depth(self, moment: Moment) -> tuple[np.ndarray, NormalEquations] | None:
        """Return the pose by brightness alone and how well it is determined, or None."""
        keyframe, T = self._keyframe, self._path.pose(moment.index)
        assert keyframe is not None
        aligned = self._align(moment, None, T)
        if moment.index == keyframe.index:
            return T, aligned.system
        result = self._judged(aligned, T)
        return (result.T_world_camera, aligned.system) if result.converged else None

    def _learn_motion(self, errors: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Learn from the errors of brightness alone, and from the poses of frames with depth."""
        for twist, information in errors:
            if twist.any():  # the keyframe has no error towards itself
                self._motion.learn_error(twist, information)
        with_depth = [m for m in self._moments if m.depth is not None]
        timestamps = np.array([m.timestamp for m in with_depth])
        self._motion.learn_motion(timestamps, [self._path.pose(m.index) for m in with_depth])

    def _smooth(self, measured: list[MeasuredPose]) -> None:
        """Smooth poses between two frames with depth, and once more those between the two before."""
        if self._motion.is_known:
            follows = len(self._settled) > 0 and np.array_equal(
                self._settled[-1].T_world_camera, measured[0].T_world_camera
            )
            poses = [*(self._settled[:-1] if follows else []), *measured]
            before = [m for m in self._moments if m.index < poses[0].index][-SMOOTHED_FROM:]
            exact = [MeasuredPose(m.index, m.timestamp, self._path.pose(m.index), None) for m in before]
            for m, T in zip(poses, self._motion.smoothed([*exact, *poses])[len(exact) :]):
                self._path.replace(m.index, T)
        else:
            for m in measured:
                self._path.replace(m.index, m.T_world_camera)
        self._settled = measured

    def _solve(self, iterations: int = 8, is_robust: bool = True) -> None:
        """Solve for the keyframe's image from the last frames, and choose its pixels to align."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_world_keyframe, moments = self._path.pose(keyframe.index), self._spread(keyframe)
        poses = [inverse(self._path.pose(m.index)) @ T_world_keyframe for m in moments]
        self._aligner.solve(keyframe, moments, poses, iterations, is_robust)

    def _spread(self, keyframe: BrightnessKeyframe) -> list[Moment]:
        """Return recent frames, spread in time, that the keyframe's image is solved from."""
        others = [m for m in self._moments if m.index != keyframe.index]
        count = min(len(others), OBSERVATIONS)
        return [others[round(k)] for k in np.linspace(0, len(others) - 1, count)]

    def _realign(self, moments: list[Moment]) -> None:
        """Align recent frames once more, to a better image than they were tracked with."""
        keyframe = self._keyframe
        assert keyframe is not None
        for moment in moments:
            if moment.index in (0, keyframe.index):
                continue
            start = self._path.pose(moment.index)
            aligned = self._align(moment, moment.depth, start)
            result = self._judged(aligned, start)
            if result.converged:
                self._path.replace(moment.index, result.T_world_camera)

    # --- places seen before ---

    def _revisit(self) -> str:
        """Take back the drift since an older keyframe that is in view again; return what happened."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_now = self._path.pose(keyframe.index)
        old_enough = [k for k in self._old_keyframes if keyframe.index - k.index >= 2 * WINDOW]
        shares = [
            self._aligner.share_in_view(k, inverse(self._path.pose(k.index)) @ T_now) for k in old_enough
        ]
        in_view = [k for k, share in zip(old_enough, shares) if share >= REVISIT_OVERLAP]
        for old in in_view[:MAX_REVISITS]:  # the oldest has drifted least
            T = self._compared(old, keyframe, T_now)
            if T is None:
                continue
            keyframe.is_new_place = max(shares) < self._config.min_overlap
            drift = inverse(T_now) @ T
            if not is_near(drift, *MAX_DRIFT):
                continue
            T_old_new = inverse(self._path.pose(old.index)) @ T
            self._revisits.append(Revisit(old.index, keyframe.index, T_old_new))
            if not is_near(drift, *NO_DRIFT):
                self._correct()
                return f"place of frame {old.index} seen again"
            return ""
        return ""

    def _relocalise(self) -> str:
        """Find the first keyframe of a stretch among the older ones; return what happened."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_now = self._path.pose(keyframe.index)
        newest_first = self._old_keyframes[::-1]
        for old in newest_first[:MAX_RECOGNISED]:
            T_old_new = recognised(old, keyframe, self._aligner.camera)
            by_features = None if T_old_new is None else self._path.pose(old.index) @ T_old_new
            for start in (by_features, T_now):
                T = None if start is None else self._compared(old, keyframe, start)
                if T is not None:
                    self._bridge(T)
                    return f"relocalised by the place of frame {old.index}"
        return "no place recognised" if newest_first else "first brightness image"

    def _compared(
        self, old: BrightnessKeyframe, new: BrightnessKeyframe, start: np.ndarray
    ) -> np.ndarray | None:
        """Return the new keyframe's pose by alignment to an older one, or None where they do not match."""
        old, T_world_old = self._aligner.with_points(old), self._path.pose(old.index)
        T = inverse(T_world_old) @ start
        for _ in range(2):  # images are known up to an offset
            difference = self._aligner.difference(old, new.log_brightness, T)
            if len(difference) < MIN_PIXELS // 4:
                return None
            image = new.log_brightness - np.float32(np.median(difference))
            aligned = self._aligner.align(old, image, new.depth, T)
            T = aligned.T_keyframe_camera
        is_same = not aligned.problem(self._config.min_inliers) and aligned.misfit < REVISIT_MISFIT
        return T_world_old @ T if is_same and aligned.overlap > REVISIT_OVERLAP / 2 else None

    def _correct(self) -> None:
        """Move all frames so that keyframes agree with their neighbours and with all revisits."""
        keyframe = self._keyframe
        assert keyframe is not None
        seen = {k for revisit in self._revisits for k in (revisit.old, revisit.new)}
        nodes = sorted(seen | {k.index for k in self._old_keyframes} | {keyframe.index})
        moved = corrections(nodes, [self._path.pose(k) for k in nodes], self._revisits)
        for index in range(nodes[0] + 1, len(self._path)):
            self._path.replace(index, spread(index, nodes, moved) @ self._path.pose(index))

    def _bridge(self, T_world_camera: np.ndarray) -> None:
        """Move a stretch so that its keyframe is at the given pose, and the gap before it in between.

        Depth alone has carried the camera through the gap. Where the end shows that it did not, as along
        a plain wall, the poses inside become a cubic between the ends and their velocities.
        """
        keyframe = self._keyframe
        assert keyframe is not None
        first, last = self._silent_since - 1, self._stretch_start  # the last frame before, the first after
        correction = T_world_camera @ inverse(self._path.pose(keyframe.index))
        for index in range(last, len(self._path)):
            self._path.replace(index, correction @ self._path.pose(index))
        if is_near(correction, *COASTED) or first < 1:
            twist = se3_log(correction)
            for index in range(first + 1, last):
                share = (index - first) / (last - first)
                self._path.replace(index, se3_exp(share * twist) @ self._path.pose(index))
            return
        start, n = self._path.pose(first), last - first
        across = se3_log(inverse(start) @ self._path.pose(last))
        before = n * se3_log(inverse(self._path.pose(first - 1)) @ start)
        after = n * se3_log(inverse(self._path.pose(last)) @ self._path.pose(last + 1))
        for index in range(first + 1, last):
            u = (index - first) / n
            twist = u * (1 - u) ** 2 * before + u**2 * (3 - 2 * u) * across - u**2 * (1 - u) * after
            self._path.replace(index, start @ se3_exp(twist))


class _Path:
    """The trajectory and the newest frame's pose, which is not on it yet."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.newest = np.eye(4)

    def __len__(self) -> int:
        return len(self.trajectory) + 1

    def pose(self, index: int) -> np.ndarray:  # [4, 4]
        """Return a frame's pose; -1 is the last on the trajectory."""
        return self.newest if index == len(self.trajectory) else self.trajectory.pose(index)

    def replace(self, index: int, T_world_camera: np.ndarray) -> None:
        """Overwrite a frame's pose."""
        if index == len(self.trajectory):
            self.newest = T_world_camera
        else:
            self.trajectory.replace(index, T_world_camera)
