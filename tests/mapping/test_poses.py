"""Poses that descend with the map, are aligned to it, and are followed by it."""

from dataclasses import replace

import numpy as np
import torch
from sequences import make_slam, settings

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig, TrackingConfig
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.geometry import se3_exp
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.poses import MapAligner, PoseMemory, PoseRefiner, StepPose
from edslam_ti.trajectory import Trajectory


def path() -> Trajectory:
    """Return three poses 5 cm apart."""
    step = np.array([0.05, 0, 0, 0, 0.1, 0])
    return Trajectory(np.arange(3.0), np.stack([se3_exp(k * step) for k in range(3)]))


def test_pose_refiner_descends_by_its_rate_in_the_camera_frame() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the camera's x is the world's y
    trajectory = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4), T]))
    PoseRefiner(rate=1e-3).step(1, np.array([5.0, 0, 0, 0, 0, 0]), trajectory)
    np.testing.assert_allclose(trajectory.pose(1)[:3, 3], [0, -1e-3, 0], atol=1e-9)
    assert (trajectory.pose(0) == np.eye(4)).all()


def test_first_pose_and_fixed_ones_have_no_gradient() -> None:
    for index, is_free in ((0, True), (1, False)):
        pose = StepPose(path(), index, is_free)
        assert not pose.T_world_camera.requires_grad
        assert pose.gradient is None


def test_gradient_is_that_of_a_twist_in_the_camera_frame() -> None:
    pose = StepPose(path(), 2, is_free=True)
    assert torch.equal(pose.T_world_camera.detach(), torch.from_numpy(path().pose(2)))
    pose.T_world_camera[:3, 3].dot(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)).backward()
    assert pose.gradient is not None
    np.testing.assert_allclose(pose.gradient[:3], path().pose(2)[:3, :3].T @ [1, 2, 3])
    np.testing.assert_allclose(pose.gradient[3:], 0)


def test_corrections_are_those_since_poses_were_remembered() -> None:
    trajectory, memory = path(), PoseMemory()
    assert memory.corrections(trajectory) == {}  # nothing was built on these poses
    memory.remember(trajectory)
    old = trajectory.pose(1)
    trajectory.replace(0, trajectory.pose(0).copy())  # as it was
    trajectory.replace(1, trajectory.pose(2))
    trajectory.replace(1, se3_exp(np.array([0.1, 0, 0, 0, 0, 0.2])) @ old)
    trajectory.append(3.0, np.eye(4))
    corrections = memory.corrections(trajectory)
    assert list(corrections) == [1]
    np.testing.assert_allclose(corrections[1], se3_exp(np.array([0.1, 0, 0, 0, 0, 0.2])), atol=1e-12)
    assert list(memory.corrections(trajectory)) == [1]  # asking changes nothing
    memory.remember(trajectory)
    assert memory.corrections(trajectory) == {}


def test_image_without_texture_or_map_moves_no_pose() -> None:
    camera = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
    aligner = MapAligner(camera, TrackingConfig(), MappingConfig())
    nothing, T = np.zeros(camera.shape, np.float32), np.eye(4)
    assert (aligner.corrected(nothing, nothing, nothing + 2, nothing + 1, T) == T).all()  # no texture
    assert (aligner.corrected(nothing, nothing, nothing, nothing, T) == T).all()  # no map


def test_frames_without_depth_move_half_way_to_the_pose_aligned_to_the_map(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    sparse = [replace(s, depth=s.depth if k % 3 == 0 else None) for k, s in enumerate(tiny_samples)]
    config = settings(poses="truth", mapping={"iterations": 1, "final_iterations": 30})
    slam = make_slam(tiny_sequence, sparse, config)
    for sample in sparse:
        slam.process(sample)
    mapper, trajectory, true = slam.mapper, slam.trajectory, slam.trajectory.poses
    assert isinstance(mapper, GaussianMapper)
    mapper.finish(trajectory, lambda fraction: True)
    shift = se3_exp(np.array([0.004, 0.003, 0, 0, 0, 0]))
    for k in range(1, len(sparse)):
        trajectory.replace(k, true[k] @ shift)
    aligner = MapAligner(tiny_sequence.camera, config.tracking, config.mapping)
    aligner.align(trajectory, mapper.images, mapper.gaussians)
    error = np.linalg.norm(trajectory.poses[:, :3, 3] - true[:, :3, 3], axis=1)
    with_depth = np.arange(len(sparse)) % 3 == 0
    np.testing.assert_allclose(error[with_depth][1:], 0.005, rtol=1e-6)
    assert 0.0015 < np.median(error[~with_depth]) < 0.0035
