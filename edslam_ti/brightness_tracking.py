"""Tracking against log-brightness images made of events; time surfaces until there is one.

A keyframe's image comes from events alone (brightness_image.py). Adding the change measured since then
gives the image at any later time, so that tracking is direct alignment of images and depth, as with a
camera: unbiased where time surfaces (Eq. 5) lag behind their edges, and possible between depth images.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from torch import Tensor

from edslam_ti.brightness_image import (
    BrightnessChange,
    Observation,
    compile_kernels,
    solve_log_brightness_image,
)
from edslam_ti.camera import Camera
from edslam_ti.config import TrackingConfig
from edslam_ti.frame import Frame, downscaled, downscaled_depth
from edslam_ti.geometry import exp_matrix, is_near, log_vector, orthonormalized, rigid_inverse
from edslam_ti.motion_prior import MeasuredPose, MotionPrior
from edslam_ti.pose_graph import Revisit, corrections, spread
from edslam_ti.tracking import (
    MAX_CONDITION,
    MIN_PIXELS,
    BidirectionalPatchTracker,
    TrackingResult,
    best_attempt,
    levenberg_marquardt,
)
from edslam_ti.trajectory import Trajectory
from kernels import depth_average
from kernels.depth_average import DepthAgreement, PixelRays, average_depth
from kernels.patch_warp import Alignment, Direction, NormalEquations, Patches, ResidualModel

IMAGE_WIDTH = 192  # pixels, roughly
WINDOW = 12  # frames a keyframe's image is solved from
OBSERVATIONS = 5  # of them that its equations are taken from
COARSE_STEPS = 6  # Levenberg-Marquardt steps a level; twice as many without depth
SMALL_GAIN = 0.01  # relative decrease of the cost: near enough for the next, finer level
MIN_FRAMES = 5  # before the first image is solved
MIN_FLOW = 1.5  # pixels of brightness images that the scene must have moved before the first image is solved
STRONG_GRADIENT = 0.02  # log brightness per pixel; such pixels are aligned first
SMOOTHED_FROM = 2  # frames before those that are smoothed, which tell the velocity there
MIN_SOLVE_FRAMES = 3  # between two solutions for one keyframe
SILENT_SHARE = 0.02  # fewer events than this share of the usual number: the camera or the stream stopped
SLOWING_SHARE = 0.2  # fewer than this in the frame before: the camera was coming to rest
SILENT_FLOW = 0.3  # pixels a frame: a camera this fast does not stop within one frame
MAX_MISFIT = 0.25  # log brightness, median: beyond, the image is not that of the keyframe's surfaces
MAX_MISFITS = 4  # such frames in a row after which the image is given up
REVISIT_OVERLAP = 0.6  # share of an old keyframe's pixels that must be in view again
REVISIT_MISFIT = 0.12  # log brightness, median
NO_DRIFT = (0.003, 0.2)  # metres, degrees: smaller corrections are the alignment's own error
MAX_DRIFT = (0.3, 15.0)  # metres, degrees: larger ones are not believed
COASTED = (0.02, 2.0)  # metres, degrees: depth alone has done no better than a guess
MAX_REVISITS = 3  # old keyframes compared with a new one
MAX_RECOGNISED = 20  # old keyframes searched after a gap
MIN_MATCHES = 15  # features that must agree for a keyframe to be recognised


@dataclass(frozen=True)
class _Depth:
    """A depth image, as measured and at the size of brightness images; metres, 0 = missing."""

    full: np.ndarray  # [H, W]
    small: np.ndarray  # [h, w]


@dataclass(frozen=True)
class _Moment:
    """What was measured up to one frame, at the size of brightness images."""

    index: int  # of the frame in the trajectory
    timestamp: float  # seconds
    change: np.ndarray  # [h, w] log brightness since the stretch of events began
    depth: _Depth | None


@dataclass
class _Keyframe:
    """A frame with depth, and the log-brightness image solved for it."""

    index: int  # of the frame in the trajectory
    change: np.ndarray  # [h, w] as in `_Moment`
    measured: _Depth  # at its time
    depth: _Depth  # averaged with that of neighbouring frames
    log_brightness: np.ndarray  # [h, w]
    points: list[Tensor]  # pixels to align, at full and at half size; see `Patches.points`
    depth_points: Tensor | None  # pixels of the full depth image to align
    next_solution: int  # index of the frame at which the image is solved for again
    is_new_place: bool = True  # no older keyframe shows much the same

    def image_at(self, moment: _Moment) -> np.ndarray:  # [h, w]
        """Return the log brightness at another time of the same stretch of events."""
        return self.log_brightness + (moment.change - self.change)

    def reduced(self) -> "_Keyframe":
        """Return what places are recognised by: a twentieth of the memory."""
        small = _Depth(self.depth.small, self.depth.small)
        nothing = np.zeros((0, 0), np.float32)
        return replace(self, change=nothing, measured=small, depth=small, points=[], depth_points=None)


@dataclass(frozen=True)
class _Aligned:
    T_world_camera: np.ndarray  # [4, 4]
    system: NormalEquations  # at full size
    misfit: float  # median absolute difference of log brightness

    @property
    def overlap(self) -> float:
        """Share of the keyframe's pixels in view."""
        return self.system.num_surface / max(self.system.num_usable, 1)


class BrightnessTracker:
    """Aligns each frame to the current keyframe's log-brightness image and depth.

    Until the first image is solved for, and while events are missing, time surfaces and depth are
    aligned instead. Poses of recent frames are refined when a better image is known; where an older
    keyframe comes into view again, the drift since then is taken back.
    """

    def __init__(self, camera: Camera, contrast_threshold: float, config: TrackingConfig, seed: int) -> None:
        self._config = config
        # Images are halved until they are about 192 pixels wide: the noise of events averages out.
        self._level = max(0, round(math.log2(camera.width / IMAGE_WIDTH)))
        self._camera = camera
        self._rays = PixelRays(camera.shape, camera.intrinsics)
        self._cameras = [camera.downscaled(2 ** (self._level + k)) for k in range(2)]
        self._contrast_threshold = contrast_threshold
        self._random = np.random.default_rng(seed + 1)
        self._num_pixels = config.num_patches * config.patch_size**2 // 4
        self._surface_tracker = BidirectionalPatchTracker(config, seed)
        self._model = ResidualModel(
            max_depth_difference=config.max_depth_difference,
            surface_sigma=config.brightness_sigma,
            depth_weight=config.depth_weight,
            depth_sigma=config.depth_sigma,
            depth_sigma_2=config.depth_sigma_2,
            huber_threshold=config.huber_threshold,
        )
        self._brightness_only = replace(self._model, depth_weight=0.0)
        self._depth_only = replace(self._model, surface_sigma=1e4)  # in effect infinite
        self._change = BrightnessChange(camera.shape)
        self._stretch_start = 0  # first frame of the stretch of uninterrupted events
        self._moments: list[_Moment] = []  # the last frames of the stretch
        self._keyframe: _Keyframe | None = None  # None: no image yet
        self._old_keyframes: list[_Keyframe] = []
        self._revisits: list[Revisit] = []
        self._is_silent, self._silent_since = False, 0  # events are missing; first such frame
        self._usual_events, self._last_count = 0.0, 0
        self._num_misfits = 0
        self._motion = MotionPrior()
        self._settled: list[MeasuredPose] = []  # between the last two frames with depth, and these
        self._path = _Path(Trajectory())
        compile_kernels()
        depth_average.compile_kernels()

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
            result, overlap = self._follow(moment, guess)
            self._path.newest = result.T_world_camera
            note = note or self._keep_up(moment, result.converged, overlap)
        message = result.message or note
        return TrackingResult(self._path.newest, result.converged, result.quality, message)

    # --- what is measured ---

    def _take_in(self, frame: Frame, index: int) -> _Moment:
        self._change.add(frame.events)
        change = self._change.log_brightness(self._contrast_threshold)
        for _ in range(self._level):
            change = downscaled(change)
        depth = None if frame.depth is None else _Depth(frame.depth, frame.level(self._level).depth)
        moment = _Moment(index, frame.timestamp, change, depth)
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
        flow = self._flow(self._keyframe.depth.small, self._path.pose(len(self._path.trajectory) - 1), guess)
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

    def _coast(self, moment: _Moment, guess: np.ndarray) -> TrackingResult:
        """Align depth alone to the last keyframe's."""
        if moment.depth is None or not moment.depth.small.any():
            return TrackingResult(guess, False, 0.0, "too few events, and no depth to align instead")
        old, T, depth = self._with_points(self._old_keyframes[-1]), guess, moment.depth.small
        for level, image in ((1, downscaled_depth(depth)), (0, depth)):
            linearise = self._linearised(
                old, old.points[level], self._depth_only, [np.zeros_like(image), image], self._cameras[level]
            )
            T, system = levenberg_marquardt(linearise, T, COARSE_STEPS)
        if system.num_depth < MIN_PIXELS:
            return TrackingResult(guess, False, 0.0, "too few events, and depth does not overlap")
        return TrackingResult(orthonormalized(T), True, 0.5 * system.num_depth / system.num_usable)

    # --- the first image of a stretch ---

    def _begin(self) -> bool:
        """Solve for the first keyframe's image, once the scene has moved enough; return whether."""
        with_depth = [m for m in self._moments if m.depth is not None]
        if len(self._moments) < MIN_FRAMES or not with_depth:
            return False
        middle = self._moments[len(self._moments) // 2].index
        moment = min(with_depth, key=lambda m: abs(m.index - middle))
        assert moment.depth is not None
        if self._flow(moment.depth.small, self._path.pose(moment.index), self._path.newest) < MIN_FLOW:
            return False
        self._keyframe = self._new_keyframe(moment, np.zeros_like(moment.depth.small))
        self._solve(iterations=40, is_robust=False)
        for _ in range(2):  # image and poses in turn
            self._solve()
            self._realign(self._moments)
        self._solve()
        return True

    def _new_keyframe(self, moment: _Moment, log_brightness: np.ndarray) -> _Keyframe:
        assert moment.depth is not None
        return _Keyframe(
            moment.index, moment.change, moment.depth, moment.depth, log_brightness,
            points=[], depth_points=None, next_solution=self._moments[-1].index + MIN_SOLVE_FRAMES,
        )  # fmt: skip

    def _flow(self, depth: np.ndarray, T_world_a: np.ndarray, T_world_b: np.ndarray) -> float:
        """Return the median distance in pixels by which what is seen from a moves until b."""
        x, y, _, u, v = self._warped(depth, rigid_inverse(T_world_b) @ T_world_a)
        return float(np.median(np.hypot(x - u, y - v))) if len(x) else 0.0

    def _warped(self, depth: np.ndarray, T_b_a: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return where every fourth pixel of a depth image is seen from b: x, y, z, u, v."""
        fx, fy, cx, cy = self._cameras[0].intrinsics
        v, u = 2 * np.stack(np.nonzero(depth[::2, ::2]))
        z = depth[v, u]
        x, y, z = T_b_a[:3, :3] @ np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z]) + T_b_a[:3, 3:]
        front = z > 0.05
        x, y, z, u, v = (a[front] for a in (x, y, z, u, v))
        return fx * x / z + cx, fy * y / z + cy, z, u, v

    # --- frame by frame ---

    def _follow(self, moment: _Moment, guess: np.ndarray) -> tuple[TrackingResult, float]:
        """Return the frame's pose and the share of the keyframe in view."""
        keyframe = self._keyframe
        assert keyframe is not None
        image = keyframe.image_at(moment)

        def attempt(start: np.ndarray) -> tuple[TrackingResult, float]:
            aligned = self._align(keyframe, image, moment.depth, start)
            return self._judged(aligned, guess), aligned.overlap

        return best_attempt(attempt, guess, self._path.pose(-1))

    def _judged(self, aligned: _Aligned, guess: np.ndarray) -> TrackingResult:
        """Return the pose, or the guess and a reason where it cannot be trusted."""
        system, overlap = aligned.system, aligned.overlap
        quality = min(1.0, overlap) * max(0.0, 1 - aligned.misfit / MAX_MISFIT)
        eigenvalues = np.linalg.eigvalsh(system.H)
        message = ""
        if system.num_surface < MIN_PIXELS:
            message = f"only {system.num_surface} pixels of the keyframe in view"
        elif overlap < self._config.min_inliers:
            message = f"only {overlap:.0%} of the keyframe in view"
        elif eigenvalues[0] <= eigenvalues[-1] / MAX_CONDITION:
            message = "motion not fully observed (ill-conditioned)"
        elif aligned.misfit > MAX_MISFIT:
            message = f"brightness differs by {aligned.misfit:.2f} (median, log)"
        if message:
            return TrackingResult(guess, False, quality, message)
        return TrackingResult(aligned.T_world_camera, True, quality)

    def _keep_up(self, moment: _Moment, is_good: bool, overlap: float) -> str:
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

    def _settle(self, moment: _Moment) -> None:
        """Correct the poses between the last two frames with depth.

        They hang on brightness alone. What brightness alone gets wrong shows at both ends, where depth
        tells the pose; in between it changes little by little. And velocity changes little.
        """
        frames = self._since_depth(moment)
        if len(frames) < 3:
            return
        self._solve()
        aligned = [a for m in frames if (a := self._aligned_without_depth(m)) is not None]
        if len(aligned) < len(frames):
            return
        known = [self._path.pose(m.index) for m in (frames[0], frames[-1])]
        start, end = (
            log_vector(rigid_inverse(aligned[k].T_world_camera) @ T) for k, T in zip((0, -1), known)
        )
        self._learn_motion([(start, aligned[0]), (end, aligned[-1])])
        measured = [MeasuredPose(frames[0].index, frames[0].timestamp, known[0], None)]
        for m, a in zip(frames[1:-1], aligned[1:-1]):
            share = (m.timestamp - frames[0].timestamp) / (moment.timestamp - frames[0].timestamp)
            T = a.T_world_camera @ exp_matrix((1 - share) * start + share * end)
            # Errors of neighbouring frames are alike: together they count as one.
            information = a.system.H / (self._motion.error * (len(frames) - 2))
            measured.append(MeasuredPose(m.index, m.timestamp, T, information))
        measured.append(MeasuredPose(moment.index, moment.timestamp, known[1], None))
        self._smooth(measured)

    def _since_depth(self, moment: _Moment) -> list[_Moment]:
        """Return the frames from the last one with depth up to a new one."""
        for k in range(len(self._moments) - 2, -1, -1):
            if self._moments[k].depth is not None:
                return self._moments[k:]
        return [moment]

    def _aligned_without_depth(self, moment: _Moment) -> _Aligned | None:
        keyframe, T = self._keyframe, self._path.pose(moment.index)
        assert keyframe is not None
        aligned = self._align(keyframe, keyframe.image_at(moment), None, T)
        if moment.index == keyframe.index:
            return replace(aligned, T_world_camera=T)
        return aligned if self._judged(aligned, T).converged else None

    def _learn_motion(self, errors: list[tuple[np.ndarray, _Aligned]]) -> None:
        """Learn from the errors of brightness alone, and from the poses of frames with depth."""
        for twist, aligned in errors:
            if twist.any():  # the keyframe has no error towards itself
                self._motion.learn_error(twist, aligned.system.H)
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

    def _solve(self, iterations: int = 12, is_robust: bool = True) -> None:
        """Solve for the keyframe's image from the last frames, and choose its pixels to align."""
        keyframe = self._keyframe
        assert keyframe is not None
        keyframe.depth = self._fused_depth(keyframe)
        T_world_keyframe = self._path.pose(keyframe.index)
        observations = [
            Observation(
                rigid_inverse(self._path.pose(m.index)) @ T_world_keyframe,
                m.change - keyframe.change,
                None if m.depth is None else m.depth.small,
            )
            for m in self._spread(keyframe)
        ]
        image = solve_log_brightness_image(
            keyframe.depth.small, self._cameras[0], observations, keyframe.log_brightness,
            iterations=iterations, is_robust=is_robust,
        )  # fmt: skip
        keyframe.log_brightness = image
        keyframe.points = self._points(keyframe)
        keyframe.depth_points = self._rays.points(keyframe.depth.full)

    def _fused_depth(self, keyframe: _Keyframe) -> _Depth:
        """Return the keyframe's depth averaged with that of recent frames where they agree."""
        T_world_keyframe = self._path.pose(keyframe.index)
        others = [(m.index, m.depth.full) for m in self._spread(keyframe) if m.depth is not None]
        small = full = average_depth(
            keyframe.measured.full,
            [depth for _, depth in others],
            [rigid_inverse(self._path.pose(index)) @ T_world_keyframe for index, _ in others],
            self._rays,
            DepthAgreement(self._model.depth_sigma, self._model.depth_sigma_2),
        )
        for _ in range(self._level):
            small = downscaled_depth(small)
        return _Depth(full, small)

    def _spread(self, keyframe: _Keyframe) -> list[_Moment]:
        """Return recent frames, spread in time, that the keyframe's image is solved from."""
        others = [m for m in self._moments if m.index != keyframe.index]
        count = min(len(others), OBSERVATIONS)
        return [others[round(k)] for k in np.linspace(0, len(others) - 1, count)]

    def _points(self, keyframe: _Keyframe) -> list[Tensor]:
        """Return pixels to align, at full and at half size."""
        image, depth = keyframe.log_brightness, keyframe.depth.small
        return [self._chosen(image, depth, 0), self._chosen(downscaled(image), downscaled_depth(depth), 1)]

    def _chosen(self, image: np.ndarray, depth: np.ndarray, level: int) -> Tensor:  # [blocks, 4, LANES]
        """Return random pixels with depth, those with a strong gradient first."""
        down, right = np.gradient(image)
        v, u = np.nonzero(depth)
        order = self._random.permutation(len(v))
        is_strong = np.hypot(down, right)[v, u][order] > STRONG_GRADIENT
        order = np.concatenate([order[is_strong], order[~is_strong]])[: self._num_pixels >> level]
        v, u = v[order], u[order]
        pixels = np.stack([u, v, 1 / depth[v, u]], -1).astype(np.float32)
        return Patches(pixels, image[v, u]).points(self._cameras[level].intrinsics)

    def _align(
        self,
        keyframe: _Keyframe,
        image: np.ndarray,  # [h, w] log brightness
        depth: _Depth | None,
        start: np.ndarray,  # [4, 4] T_world_camera
    ) -> _Aligned:
        """Align an image, and its depth where there is any, to a keyframe, coarse to fine."""
        small = np.zeros_like(image) if depth is None else depth.small
        steps = COARSE_STEPS if depth is not None else 2 * COARSE_STEPS
        T = start
        for level, view in ((1, [downscaled(image), downscaled_depth(small)]), (0, [image, small])):
            linearise = self._linearised(
                keyframe, keyframe.points[level], self._model, view, self._cameras[level]
            )
            T, system = levenberg_marquardt(linearise, T, steps, SMALL_GAIN)
        if depth is not None and keyframe.depth_points is not None and self._model.depth_weight > 0:
            # Reduced depth is blurred at edges: the last step uses it as it was measured.
            brightness = self._linearised(
                keyframe, keyframe.points[0], self._brightness_only, [image, small], self._cameras[0]
            )
            geometry = self._linearised(
                keyframe,
                keyframe.depth_points,
                self._depth_only,
                [np.zeros_like(depth.full), depth.full],
                self._camera,
            )
            both = brightness(T) + geometry(T)
            T = T @ exp_matrix(-np.linalg.solve(both.H, both.g))  # Gauss-Newton: the minimum is near
        T = orthonormalized(T)
        difference = self._difference(keyframe, image, T)
        misfit = float(np.median(np.abs(difference))) if len(difference) else np.inf
        return _Aligned(T, system, misfit)

    def _linearised(
        self,
        keyframe: _Keyframe,
        points: Tensor,
        model: ResidualModel,
        view: list[np.ndarray],  # log brightness and depth
        camera: Camera,  # of the view
    ) -> Callable[[np.ndarray], NormalEquations]:
        """Return the normal equations of alignment to a keyframe as a function of T_world_camera."""
        alignment = Alignment([Direction(points, 0, model)], cv2.merge(view)[None], camera.intrinsics)
        T_world_keyframe = self._path.pose(keyframe.index)

        def linearise(T_world_camera: np.ndarray) -> NormalEquations:
            # T exp(xi) moves T_camera_keyframe to exp(-xi) T_camera_keyframe
            (system,) = alignment.linearise([rigid_inverse(T_world_camera) @ T_world_keyframe])
            return system.transformed(-np.eye(6))

        return linearise

    def _difference(self, keyframe: _Keyframe, image: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
        """Return an image less a keyframe's, at pixels of the keyframe in view (nearest neighbours)."""
        T = rigid_inverse(T_world_camera) @ self._path.pose(keyframe.index)
        x, y, _, u, v = self._warped(keyframe.depth.small, T)
        column, row = np.rint(x).astype(int), np.rint(y).astype(int)
        height, width = image.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return image[row[inside], column[inside]] - keyframe.log_brightness[v[inside], u[inside]]

    def _realign(self, moments: list[_Moment]) -> None:
        """Align recent frames once more, to a better image than they were tracked with."""
        keyframe = self._keyframe
        assert keyframe is not None
        for moment in moments:
            if moment.index in (0, keyframe.index):
                continue
            start = self._path.pose(moment.index)
            aligned = self._align(keyframe, keyframe.image_at(moment), moment.depth, start)
            if self._judged(aligned, start).converged:
                self._path.replace(moment.index, aligned.T_world_camera)

    # --- places seen before ---

    def _revisit(self) -> str:
        """Take back the drift since an older keyframe that is in view again; return what happened."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_now = self._path.pose(keyframe.index)
        old_enough = [k for k in self._old_keyframes if keyframe.index - k.index >= 2 * WINDOW]
        shares = [self._share_in_view(k, T_now) for k in old_enough]
        in_view = [k for k, share in zip(old_enough, shares) if share >= REVISIT_OVERLAP]
        for old in in_view[:MAX_REVISITS]:  # the oldest has drifted least
            T = self._compared(old, keyframe, T_now)
            if T is None:
                continue
            keyframe.is_new_place = max(shares) < self._config.min_overlap
            drift = rigid_inverse(T_now) @ T
            if not is_near(drift, *MAX_DRIFT):
                continue
            T_old_new = rigid_inverse(self._path.pose(old.index)) @ T
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
            for start in (self._recognised(old, keyframe), T_now):
                T = None if start is None else self._compared(old, keyframe, start)
                if T is not None:
                    self._bridge(T)
                    return f"relocalised by the place of frame {old.index}"
        return "no place recognised" if newest_first else "first brightness image"

    def _with_points(self, old: _Keyframe) -> _Keyframe:
        return replace(old, points=self._points(old))

    def _share_in_view(self, old: _Keyframe, T_world_camera: np.ndarray) -> float:
        camera = self._cameras[0]
        x, y, _, _, _ = self._warped(
            old.depth.small, rigid_inverse(T_world_camera) @ self._path.pose(old.index)
        )
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        return float(inside.sum() / max(np.count_nonzero(old.depth.small[::2, ::2]), 1))

    def _compared(self, old: _Keyframe, new: _Keyframe, start: np.ndarray) -> np.ndarray | None:
        """Return the new keyframe's pose by alignment to an older one, or None where they do not match."""
        old, T = self._with_points(old), start
        for _ in range(2):  # images are known up to an offset
            difference = self._difference(old, new.log_brightness, T)
            if len(difference) < MIN_PIXELS // 4:
                return None
            image = new.log_brightness - np.float32(np.median(difference))
            aligned = self._align(old, image, new.depth, T)
            T = aligned.T_world_camera
        is_same = self._judged(aligned, start).converged and aligned.misfit < REVISIT_MISFIT
        return T if is_same and aligned.overlap > REVISIT_OVERLAP / 2 else None

    def _recognised(self, old: _Keyframe, new: _Keyframe) -> np.ndarray | None:  # [4, 4]
        """Return the new keyframe's pose by features matched with an older one (SIFT, PnP), or None."""
        detector = cv2.SIFT.create(nfeatures=500, contrastThreshold=0.02)
        found = [detector.detectAndCompute(_as_picture(k.log_brightness), None) for k in (old, new)]
        (old_points, old_features), (new_points, new_features) = found
        if old_features is None or new_features is None or min(len(old_points), len(new_points)) < 2:
            return None
        pairs = cv2.BFMatcher().knnMatch(old_features, new_features, k=2)
        matches = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
        at_old = np.array([old_points[m.queryIdx].pt for m in matches]).reshape(-1, 2)
        at_new = np.array([new_points[m.trainIdx].pt for m in matches]).reshape(-1, 2)
        u, v = np.rint(at_old).astype(int).T
        z = old.depth.small[v, u].astype(float)
        known = z > 0
        if known.sum() < MIN_MATCHES:
            return None
        fx, fy, cx, cy = self._cameras[0].intrinsics
        points = np.stack([(at_old[:, 0] - cx) / fx * z, (at_old[:, 1] - cy) / fy * z, z], -1)
        cv2.setRNGSeed(0)
        is_solved, rotation, translation, inliers = cv2.solvePnPRansac(
            points[known], at_new[known], self._cameras[0].matrix, None, reprojectionError=2.0
        )
        if not is_solved or inliers is None or len(inliers) < MIN_MATCHES:
            return None
        T_new_old = np.eye(4)
        T_new_old[:3, :3], T_new_old[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        return self._path.pose(old.index) @ rigid_inverse(T_new_old)

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
        correction = T_world_camera @ rigid_inverse(self._path.pose(keyframe.index))
        for index in range(last, len(self._path)):
            self._path.replace(index, correction @ self._path.pose(index))
        if is_near(correction, *COASTED) or first < 1:
            twist = log_vector(correction)
            for index in range(first + 1, last):
                share = (index - first) / (last - first)
                self._path.replace(index, exp_matrix(share * twist) @ self._path.pose(index))
            return
        start, n = self._path.pose(first), last - first
        across = log_vector(rigid_inverse(start) @ self._path.pose(last))
        before = n * log_vector(rigid_inverse(self._path.pose(first - 1)) @ start)
        after = n * log_vector(rigid_inverse(self._path.pose(last)) @ self._path.pose(last + 1))
        for index in range(first + 1, last):
            u = (index - first) / n
            twist = u * (1 - u) ** 2 * before + u**2 * (3 - 2 * u) * across - u**2 * (1 - u) * after
            self._path.replace(index, start @ exp_matrix(twist))


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


def _as_picture(log_brightness: np.ndarray) -> np.ndarray:  # [h, w] uint8
    low, high = np.percentile(log_brightness, (1, 99))
    return np.clip(255 * (log_brightness - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)
