"""IncEventGS (Huang et al. 2025): a map and poses from events alone, re-implemented from the paper.

Bootstrap    Gaussians at random depth, their brightness, and poses are found in turn over the first chunks.
Tracking     the pose at the end of each new chunk is that with which the map explains the chunk's events best
             (Eq. 10 to 12 of ED-SLAM's paper, which are theirs), by Gauss-Newton steps.
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
from edslam_ti.geometry import se3_exp
from edslam_ti.mapping.change_loss import Reduction
from edslam_ti.mapping.event_only_mapper import EventOnlyMapper
from edslam_ti.mapping.pose_solve import SolvedPose, solve_pose
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

BOOTSTRAP_RATE = 1e-3  # metres and radians a step: of poses that are not known at all
START_FLOW = 1.5  # px of the coarsest images in a frame; motions of a few times this are tried first
CELLS = (*(0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.2, 0.2), *(0.15, 0.15, 0.15, 0.15))  # radians; see depth_solve.py
LAST_CELL = 0.1  # radians, of cells that sliding bundle adjustment moves
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
        self.solve_brightness(trajectory, recent)
        self.solve_depth(trajectory, recent, self._coarsest, LAST_CELL)
        if not self._is_given_poses:
            self._align(recent, trajectory)
            self.solve_brightness(trajectory, recent)
        for _ in range(self._config.iterations * self._inc.adjust_every):
            window = self.window(recent[int(self._random.integers(len(recent)))])
            if window is not None:
                self.step(*window, trajectory, free, self._coarsest)

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
        for cell in CELLS:
            self.solve_brightness(trajectory, frames)
            self.explained = self._align(frames, trajectory)
            self.solve_depth(trajectory, frames, self._coarsest, cell)
            self._fill(trajectory.pose(frames[-1]), frames[-1])
        self._refine(frames, trajectory)
        self.has_map = self.explained >= self._inc.min_explained

    def _align(self, frames: list[int], trajectory: Trajectory) -> float:
        """Align every frame but the first to the map; return the mean share of the change explained."""
        first = self._sums.knots(frames[0])[-1]
        image = (self._view(trajectory.at(first.time)).intensity + self._config.log_epsilon).log()
        shares = []
        for k in frames[1:]:
            knots = self._sums.knots(k)
            if len(knots) == self._settings.knots_per_frame:  # the last one is at the frame: not held out
                change = self._sums.change(first, knots[-1])
                solved = self.solve_pose(trajectory.pose(k), image + change, change)
                trajectory.replace(k, solved.T_world_camera)
                shares.append(solved.explained)
        return float(np.mean(shares)) if shares else 0.0

    def _refine(self, frames: list[int], trajectory: Trajectory) -> None:
        """Take steps on map and poses together."""
        rate, self._refiner.rate = self._refiner.rate, BOOTSTRAP_RATE
        for k in range(self._inc.bootstrap_steps):
            done = k / self._inc.bootstrap_steps
            if k % SOLVE_IN_BOOTSTRAP == 0:
                self.solve_brightness(trajectory, frames)
            window = self.window(frames[1 + int(self._random.integers(len(frames) - 1))])
            if window is not None and window[0].time >= trajectory.timestamp(frames[0]):
                self.step(*window, trajectory, range(frames[0] + 1, frames[-1] + 1), self._level(done))
        self._refiner.rate = rate

    def solve_pose(self, start: np.ndarray, image: Tensor, change: Tensor) -> SolvedPose:
        """Return the pose at which the map looks like an image [H, W], of which `change` is measured."""
        levels = tuple(Reduction.of(self._camera, k) for k in (self._coarsest, max(self._coarsest - 1, 0)))
        background, epsilon = self._config.background, self._config.log_epsilon
        return solve_pose(
            self.gaussians, start, image, change, levels, background, epsilon, self._inc.tracking_steps
        )

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

    def track(self, guess: np.ndarray, trajectory: Trajectory) -> SolvedPose:
        """Return the pose at the newest knot, whose events the mapper has received."""
        knots = [knot for k in self._sums.frames[-3:] for knot in self._sums.knots(k)]
        earlier = [knot for knot in knots if knot.time <= trajectory.timestamp(-1)]
        start = earlier[-1] if earlier else knots[0]
        image = (self._view(trajectory.at(start.time)).intensity + self._config.log_epsilon).log()
        change = self._sums.change(start, knots[-1])
        return self.solve_pose(guess, image + change, change)


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
        solved = self._mapper.track(guess, trajectory)
        quality = min(max(0.0, solved.explained), 1.0)
        if quality < self._config.min_explained:
            return TrackingResult(guess, False, quality, f"the map explains only {quality:.0%} of the events")
        return TrackingResult(solved.T_world_camera, True, quality)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: there is no depth to compare."""
