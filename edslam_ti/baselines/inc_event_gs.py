"""IncEventGS (Huang et al. 2025): a map and poses from events alone, re-implemented from the paper.

Bootstrap    Gaussians at random depth, and poses, are optimised together over the first chunks.
Tracking     the pose at the end of each new chunk is that with which the map explains the chunk's events best
             (Eq. 10 to 12 of ED-SLAM's paper, which are theirs), by Adam on a twist; Eq. 9 in between.
Mapping      Gaussians are added where nothing is drawn; sliding bundle adjustment over the last chunks, and a
             global one at the end.

The scale is unknown: compare trajectories after Sim(3) alignment. What differs from the authors' version is
in docs/methods/inc_event_gs.md.
"""

import itertools

import numpy as np
import torch
from torch import Tensor

from edslam_ti.camera import Camera
from edslam_ti.config import Config, IncEventGsConfig
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.frame import Frame
from edslam_ti.geometry import interpolate, orthonormalized, se3_exp
from edslam_ti.mapping.change_loss import Reduction, change_loss
from edslam_ti.mapping.event_only_mapper import EventOnlyMapper
from edslam_ti.mapping.rendering import drawable
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

LAST_RATE = 0.1  # the tracker's learning rate falls to this share
BOOTSTRAP_RATE = 1e-3  # metres and radians a step: of poses that are not known at all
START_FLOW = 3.0  # px of the coarsest images in a frame; the first guess of a motion is a multiple of it
SOLVE_IN_BOOTSTRAP = 40  # steps between two solves of brightness


class IncEventMapper(EventOnlyMapper):
    """Bootstraps, then adds Gaussians and adjusts the last poses with the map (Mapper)."""

    def __init__(self, camera: Camera, contrast: ContrastThreshold, config: Config) -> None:
        super().__init__(camera, contrast, config)
        self._inc = config.inc_event_gs
        self._is_given_poses = config.poses == "truth"
        self.has_map = self._is_given_poses
        self.explained = 0.0  # share of the change that the bootstrap explained
        self._received = 0  # frames whose events are in the sums

    def receive(self, frame: Frame, index: int) -> None:
        """Take in a frame's events; the second time nothing happens."""
        if index >= self._received:
            self._sums.add(frame, index)
            self._received = index + 1

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Bootstrap when there are enough chunks; then fill, and adjust every few chunks."""
        self.budget.start(frame.timestamp)
        index = self._num_frames
        self._num_frames += 1
        self.receive(frame, index)
        if not self.has_map:
            if self._num_frames >= self._inc.bootstrap_frames:
                self._bootstrap(trajectory)
        else:
            self._fill(trajectory.pose(-1), index)
            self._drop_surplus()
            if self._num_frames % self._inc.adjust_every == 0:
                self._adjust(trajectory)
        self.budget.stop()

    def _adjust(self, trajectory: Trajectory) -> None:
        """Sliding bundle adjustment: the map, and the poses of the last frames."""
        first = len(trajectory) - self._inc.window
        free = None if self._is_given_poses else range(max(first, 1), len(trajectory))
        recent = [k for k in self._sums.frames if k >= first]
        for _ in range(self._config.iterations * self._inc.adjust_every):
            window = self.window(recent[int(self._random.integers(len(recent)))])
            if window is not None:
                self.step(*window, trajectory, free, self._coarsest)
        if self._settings.solve_views and self._num_frames % self._settings.solve_every == 0:
            self.solve_brightness(trajectory, recent)

    def _begin_final(self, trajectory: Trajectory) -> None:
        self.solve_brightness(trajectory, self._sums.frames)  # depth is known by now

    def _poses_are_free(self, done: float) -> bool:
        return self._adjusts_poses

    # --- bootstrap ---

    def _bootstrap(self, trajectory: Trajectory) -> None:
        """Find map and poses of the last frames together; `explained` says how well."""
        frames = self._sums.frames[-self._inc.bootstrap_frames :]
        everyone = torch.zeros(len(self.gaussians), dtype=torch.bool)
        self.gaussians.keep(everyone)  # of an attempt before, which failed
        self._fill(trajectory.pose(frames[0]), frames[0])
        self._guess_motion(frames, trajectory)
        free = range(frames[0] + 1, frames[-1] + 1)
        rate, unexplained = self._refiner.rate, 1.0
        for k in range(self._inc.bootstrap_steps):
            done = k / self._inc.bootstrap_steps
            self._refiner.rate = BOOTSTRAP_RATE * (1 - 0.9 * done)
            if k % SOLVE_IN_BOOTSTRAP == 0:
                self.solve_brightness(trajectory, frames)
            window = self.window(frames[1 + int(self._random.integers(len(frames) - 1))])
            if window is not None and window[0].time >= trajectory.timestamp(frames[0]):
                error = self.step(*window, trajectory, free, self._level(done))
                unexplained = 0.9 * unexplained + 0.1 * error
        self._refiner.rate = rate
        self.explained = 1 - unexplained
        self.has_map = self.explained >= self._inc.min_explained

    def _guess_motion(self, frames: list[int], trajectory: Trajectory) -> None:
        """Start from the constant rotation whose best brightness explains most, of a grid of them.

        Brightness is solved for each. A rotation moves the image as any motion of the camera does to first
        order; the steps that follow make a motion of it.
        """
        step = START_FLOW * 2**self._coarsest / self._camera.fx  # radians a frame
        best, centre = np.inf, np.zeros(2)
        for size in (step, step / 2, step / 4, step / 8):
            reach = (-2, -1, 0, 1, 2) if size == step else (-1, 0, 1)
            tried = [centre + size * np.array(d) for d in itertools.product(reach, reach)]
            for rotation in tried:
                error = self._error_of(rotation, frames, trajectory)
                if error < best:
                    best, centre = error, rotation
        self._rotate(centre, frames, trajectory)

    def _error_of(self, rotation: np.ndarray, frames: list[int], trajectory: Trajectory) -> float:
        """Return the share of the change that a rotation (x, y; radians a frame) leaves unexplained."""
        self._rotate(rotation, frames, trajectory)
        self.gaussians.set_colors(torch.full((len(self.gaussians), 1), self._config.background))
        self.solve_brightness(trajectory, frames)
        return self.unexplained(trajectory, frames)

    def _rotate(self, rotation: np.ndarray, frames: list[int], trajectory: Trajectory) -> None:
        """Set the frames' poses to a constant rotation about x and y from the first one's."""
        T, twist = trajectory.pose(frames[0]), np.array([0, 0, 0, *rotation, 0])
        for k in frames[1:]:
            trajectory.replace(k, T @ se3_exp((k - frames[0]) * twist))

    # --- for the tracker ---

    def explain(
        self, index: int, end: float, T_newest: Tensor, trajectory: Trajectory, level: int
    ) -> tuple[Tensor, float] | None:
        """Return Eq. 12 of a random window that ends in the newest chunk, and the share that it leaves.

        Differentiable in `T_newest` [4, 4], the pose at `end` (seconds); the map stays as it is.
        """
        window = self.window(index)
        if window is None:
            return None
        start, T_last = trajectory.timestamp(-1), torch.from_numpy(trajectory.pose(-1))
        poses = []
        for knot in window:
            if knot.time <= start:
                poses.append(torch.from_numpy(trajectory.at(knot.time)))
            else:
                poses.append(interpolate(T_last, T_newest, (knot.time - start) / (end - start)))
        T, reduction = torch.stack(poses), Reduction.of(self._camera, level)
        chosen = torch.cat([drawable(self.gaussians, reduction.camera, pose) for pose in T]).unique()
        if len(chosen) == 0:
            return None
        change = self._sums.change(*window)
        with torch.no_grad():
            active = self.gaussians.activated(chosen)
        comparison = change_loss(
            active, T, change, reduction, self._config.background, self._config.log_epsilon
        )
        energy = float(reduction.reduced(change).square().mean())
        return comparison.loss.sqrt(), float(comparison.loss.detach()) / max(energy, 1e-12)

    @property
    def coarsest(self) -> int:
        """The level at which alignment begins."""
        return self._coarsest


class IncEventTracker:
    """Finds the pose at the end of each chunk by the event loss of the mapper's map (Tracker)."""

    def __init__(self, mapper: IncEventMapper, config: IncEventGsConfig) -> None:
        self._mapper = mapper
        self._config = config

    def track(self, frame: Frame, guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; until there is a map, the last pose, which the bootstrap corrects."""
        index = len(trajectory)
        self._mapper.receive(frame, index)
        if index == 0:
            return TrackingResult(guess, True, 1.0)
        if not self._mapper.has_map:
            last, number = trajectory.pose(-1), self._config.bootstrap_frames
            if index < number:
                return TrackingResult(last, True, 0.0)
            explained = self._mapper.explained
            return TrackingResult(last, False, 0.0, f"no map yet: it explains {explained:.0%} of the events")
        pose, unexplained = self._aligned(index, frame.timestamp, guess, trajectory)
        quality = max(0.0, 1 - unexplained)
        if quality < self._config.min_explained:
            return TrackingResult(guess, False, quality, f"the map explains only {quality:.0%} of the events")
        return TrackingResult(pose, True, quality)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: there is no depth to compare."""

    def _aligned(
        self, index: int, end: float, guess: np.ndarray, trajectory: Trajectory
    ) -> tuple[np.ndarray, float]:
        """Return the pose after all steps, and the running mean of the share of events not explained."""
        total = self._config.tracking_steps
        T_guess = torch.from_numpy(guess)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        adam = torch.optim.Adam([twist], lr=self._config.tracking_rate)
        unexplained = 1.0
        for k in range(total):
            adam.param_groups[0]["lr"] = self._config.tracking_rate * LAST_RATE ** (k / total)
            level = self._mapper.coarsest if k < total // 2 else max(self._mapper.coarsest - 1, 0)
            found = self._mapper.explain(index, end, T_guess @ se3_exp(twist), trajectory, level)
            if found is None:
                continue
            loss, share = found
            adam.zero_grad()
            loss.backward()
            adam.step()
            unexplained = share if unexplained == 1.0 else 0.8 * unexplained + 0.2 * share
        pose = (T_guess @ se3_exp(twist.detach())).numpy()
        return orthonormalized(pose), unexplained
