"""The baseline of Open3D's odometry and TSDF volume, on an exact scene and on real Kinect frames."""

import importlib.util
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from edslam_ti.baselines.kiss import KissIcpTracker
from edslam_ti.baselines.open3d_rgbd import OdometryTracker, RgbdOdometryTracker, TsdfMapper
from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.frame import Frame
from edslam_ti.geometry import se3_exp
from edslam_ti.trajectory import Trajectory

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)


class RgbdSequence(EventDepthSequence):
    """Only what the baseline asks of a sequence."""

    dataset = scene = description = "rgbd"
    contrast_threshold = truth = None

    def __init__(self, depth_timestamps: np.ndarray, image_timestamps: np.ndarray, camera: Camera = CAMERA):
        self.camera = camera
        self.depth_timestamps, self.image_timestamps = depth_timestamps, image_timestamps

    def depth(self, index: int) -> np.ndarray:
        raise NotImplementedError

    image = depth

    def events(self, start: float, end: float) -> Events:
        return Events.empty()

    @property
    def time_range(self) -> tuple[float, float]:
        return 0.0, 1.0


def frame(
    timestamp: float, depth: np.ndarray | None, image: np.ndarray | None, held_out: bool = False
) -> Frame:
    camera = CAMERA if depth is None else Camera(depth.shape[1], depth.shape[0], 1.0, 1.0, 0.0, 0.0)
    return Frame(timestamp, timestamp - 0.05, Events.empty(), camera, depth, image, held_out)


def corner_view(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and a smooth texture of three perpendicular walls, seen from a pose."""
    directions = CAMERA.rays() @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    depth = np.full(CAMERA.shape, np.inf)
    for axis, wall in ((0, 1.0), (1, 0.8), (2, 2.5)):
        distance = (wall - origin[axis]) / directions[..., axis]
        depth = np.where((distance > 0) & (distance < depth), distance, depth)
    x, y, z = np.moveaxis(origin + depth[..., None] * directions, -1, 0)
    texture = 0.5 + 0.2 * np.sin(9 * x + 2 * z) + 0.2 * np.sin(8 * y - 3 * z)
    return depth.astype(np.float32), texture.astype(np.float32)


def straight_path(count: int) -> np.ndarray:  # [count, 4, 4]
    twist = torch.tensor([0.012, -0.006, 0.01, 0.002, 0.008, -0.003], dtype=torch.float64)
    return torch.stack([se3_exp(k * twist) for k in range(count)]).numpy()


def run(tracker: RgbdOdometryTracker, truth: np.ndarray) -> tuple[Trajectory, TsdfMapper]:
    trajectory, mapper = Trajectory(), TsdfMapper(CAMERA)
    for k, T in enumerate(truth):
        now = frame(0.05 * k, *corner_view(T))
        guess = trajectory.at(now.timestamp) if k else truth[0]
        result = tracker.track(now, guess, trajectory)
        assert result.converged, (k, result.message)
        trajectory.append(now.timestamp, result.T_world_camera)
        mapper.update(now, trajectory)
    return trajectory, mapper


@pytest.fixture(scope="module")
def corner_run() -> tuple[Trajectory, TsdfMapper]:
    times = 0.05 * np.arange(12)
    return run(RgbdOdometryTracker(RgbdSequence(times, times)), straight_path(12))


def test_motion_in_front_of_textured_walls_is_recovered(corner_run) -> None:
    trajectory, _ = corner_run
    truth = straight_path(12)
    error = np.linalg.norm(trajectory.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    path = np.linalg.norm(truth[-1, :3, 3])
    assert path > 0.15
    # A pixel is 2 cm wide at the far wall, and partners are whole pixels; 0.3 cm rms is usual.
    assert error.max() < 0.01


def test_render_of_the_volume_shows_the_walls(corner_run) -> None:
    trajectory, mapper = corner_run
    depth, image = corner_view(straight_path(12)[6])
    view = mapper.render(CAMERA, trajectory.pose(6))
    seen = view.alpha > 0
    assert seen.mean() > 0.9
    assert np.median(np.abs(view.depth - depth)[seen]) < 0.01
    assert np.median(np.abs(view.intensity - image)[seen]) < 0.05


def test_points_lie_on_the_walls(corner_run) -> None:
    points, brightness = corner_run[1].points()
    assert len(points) == len(brightness) > 1000
    distance = np.abs(points - [1.0, 0.8, 2.5]).min(1)
    assert np.median(distance) < 0.01
    assert corner_run[1].num_gaussians == 0


def test_frame_without_depth_or_image_is_predicted_and_says_so() -> None:
    times = 0.05 * np.arange(3)
    tracker = RgbdOdometryTracker(RgbdSequence(times, times))
    guess = straight_path(2)[1]
    depth, image = corner_view(np.eye(4))
    for now, missing in ((frame(0.0, None, image), "depth image"), (frame(0.0, depth, None), "no image")):
        result = tracker.track(now, guess, Trajectory())
        assert not result.converged
        assert missing in result.message
        np.testing.assert_array_equal(result.T_world_camera, guess)


def test_frame_that_shows_nothing_is_lost_at_the_guess() -> None:
    times = 0.05 * np.arange(3)
    tracker = RgbdOdometryTracker(RgbdSequence(times, times))
    tracker.track(frame(0.0, *corner_view(np.eye(4))), np.eye(4), Trajectory())
    guess = straight_path(2)[1]
    blind = frame(0.05, np.zeros(CAMERA.shape, np.float32), np.zeros(CAMERA.shape, np.float32))
    result = tracker.track(blind, guess, Trajectory())
    assert not result.converged
    assert result.quality == 0
    np.testing.assert_allclose(result.T_world_camera, guess, atol=1e-12)


def test_depth_alone_is_followed_without_images() -> None:
    truth = straight_path(12)
    tracker, trajectory = OdometryTracker(CAMERA, "PointToPlane"), Trajectory()
    for k, T in enumerate(truth):
        now = frame(0.05 * k, corner_view(T)[0], None)
        result = tracker.track(now, trajectory.at(now.timestamp) if k else truth[0], trajectory)
        assert result.converged, (k, result.message)
        trajectory.append(now.timestamp, result.T_world_camera)
    error = np.linalg.norm(trajectory.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert error.max() < 0.003  # of 17 cm
    lost = tracker.track(frame(0.6, None, None), truth[3], trajectory)
    assert not lost.converged
    np.testing.assert_array_equal(lost.T_world_camera, truth[3])


def test_kiss_icp_follows_depth_or_says_that_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("kiss_icp") is not None:
        truth = straight_path(6)
        tracker, trajectory = KissIcpTracker(CAMERA), Trajectory()
        for k, T in enumerate(truth):
            result = tracker.track(frame(0.05 * k, corner_view(T)[0], None), truth[0], trajectory)
            trajectory.append(0.05 * k, result.T_world_camera)
        # Points on three bare walls slide along them: 4 cm of 8.5 cm, where one pixel is 1 to 2 cm.
        assert np.linalg.norm(trajectory.poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.05
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    with pytest.raises(ModuleNotFoundError, match="not installed: method kiss_icp needs pip install"):
        KissIcpTracker(CAMERA)


def test_held_out_frames_are_not_fused() -> None:
    mapper, trajectory = TsdfMapper(CAMERA), Trajectory(np.zeros(1), np.eye(4)[None])
    mapper.update(frame(0.0, *corner_view(np.eye(4)), held_out=True), trajectory)
    assert len(mapper.points()[0]) == 0
    mapper.update(frame(0.0, *corner_view(np.eye(4))), trajectory)
    assert len(mapper.points()[0]) > 0


@pytest.mark.parametrize("image_times", [np.empty(0), 0.025 + 0.05 * np.arange(5)])
def test_sequence_without_images_at_its_depth_is_an_error(image_times: np.ndarray) -> None:
    with pytest.raises(DataError, match="open3d_rgbd needs images"):
        RgbdOdometryTracker(RgbdSequence(0.05 * np.arange(5), image_times))


@pytest.mark.slow
def test_real_kinect_motion_is_followed(shared_data: Path) -> None:
    folder = shared_data / "red_kitchen" / "frames"
    if not folder.is_dir():
        pytest.skip(f"real RGB-D recording not found at {folder}")
    camera = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0).downscaled(4)
    times = np.arange(60) / 30
    tracker, trajectory = RgbdOdometryTracker(RgbdSequence(times, times, camera)), Trajectory()
    truth = []
    for k in range(60):
        depth = cv2.imread(str(folder / f"frame-{k:06d}.depth.png"), -1)[2::4, 2::4].astype(np.float32) / 1000
        depth[depth > 10] = 0  # 65.535 m marks missing depth
        colour = cv2.imread(str(folder / f"frame-{k:06d}.color.jpg"), 0)
        assert colour is not None
        grey = cv2.resize(colour, (160, 120), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        truth.append(np.loadtxt(folder / f"frame-{k:06d}.pose.txt"))
        now = frame(times[k], depth, grey)
        guess = trajectory.at(now.timestamp) if k else truth[0]
        result = tracker.track(now, guess, trajectory)
        assert result.converged
        trajectory.append(now.timestamp, result.T_world_camera)
    error = np.linalg.norm(trajectory.poses[:, :3, 3] - np.array(truth)[:, :3, 3], axis=1)
    # The recording's own poses are good to a centimetre or two; 0.46 m of motion.
    assert error.max() < 0.06
