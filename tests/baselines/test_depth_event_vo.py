"""The potential field of a time surface, alignment to it, and the tracker and map made of them."""

import numpy as np
import pytest
import torch
from sequences import make_slam, position_errors, settings, without_events

from edslam_ti.baselines.depth_event_vo import PotentialField, aligned, linearised
from edslam_ti.camera import Camera
from edslam_ti.config import DepthEventVoConfig
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.geometry import inverse, se3_exp, se3_log

CAMERA = Camera(120, 80, 70.0, 70.0, 59.5, 39.5)
CONFIG = DepthEventVoConfig(iterations=30)


def bumpy_scene() -> tuple[torch.Tensor, torch.Tensor]:
    """Return points [N, 3] at several depths, and a time surface [H, W] that is 1 where they are seen."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(10, 110, 150), rng.uniform(10, 70, 150)
    points = CAMERA.back_project_pixels(u, v, rng.uniform(1.5, 4.0, 150))
    y, x = np.mgrid[0:80, 0:120]
    distance = np.min((x[..., None] - u) ** 2 + (y[..., None] - v) ** 2, axis=-1)
    return torch.from_numpy(points).float(), torch.from_numpy(np.exp(-distance / 8)).float()


def test_gradient_is_that_of_the_cost() -> None:
    points, surface = bumpy_scene()
    field = PotentialField.of(surface, CAMERA)
    # Where potential is linear between pixels its slope is exact, so a plane shows errors of signs.
    y, x = torch.meshgrid(torch.arange(80.0), torch.arange(120.0), indexing="ij")
    plane = PotentialField.of(1 - (0.1 + 0.002 * x + 0.003 * y), CAMERA)
    T = se3_exp(torch.tensor([0.01, -0.02, 0.03, 0.01, 0.02, -0.01], dtype=torch.float64))
    system = linearised(plane, points, T, huber_threshold=0.2)
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-3
        after, before = (linearised(plane, points, T @ se3_exp(s), 0.2).cost for s in (step, -step))
        numerical = (after - before) / 2e-3 * len(points)
        assert float(system.g[k]) == pytest.approx(numerical, rel=0.02, abs=0.05)
    assert linearised(field, points, torch.eye(4, dtype=torch.float64), 0.2).support > 0.99


def test_points_fall_to_the_bottom_of_the_field() -> None:
    points, surface = bumpy_scene()
    field = PotentialField.of(surface, CAMERA)
    start = se3_exp(torch.tensor([0.02, -0.02, 0.02, 0.008, -0.008, 0.01], dtype=torch.float64))
    T, system = aligned(field, points, start, CONFIG)
    error = se3_log(T).abs()
    assert float(error[:3].max()) < 0.008  # metres, from 0.02: a third of a pixel at the nearest point
    assert float(error[3:].max()) < 0.004  # from 0.01
    assert system.support > 0.95


def test_points_out_of_view_have_the_highest_potential() -> None:
    points, surface = bumpy_scene()
    field = PotentialField.of(surface, CAMERA)
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    system = linearised(field, points, behind, 0.2)
    assert (system.num_inside, system.support) == (0, 0.0)
    assert not system.H.any()


def test_tracks_the_tiny_room_and_maps_its_edges(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam = make_slam(tiny_sequence, tiny_samples, settings("depth_event_vo"))
    for k, sample in enumerate(tiny_samples):
        slam.process(sample, is_held_out=k == 4)
    assert sum(not r.converged for r in slam.results) <= 2  # edges are few in so small an image
    assert position_errors(slam, tiny_sequence).max() < 0.05  # metres, of 0.3 m of path
    pose, depth = tiny_samples[6].T_world_camera, tiny_samples[6].depth
    assert pose is not None
    assert depth is not None
    assert slam.mapper is not None
    view = slam.mapper.render(tiny_sequence.camera, pose)
    is_drawn = view.alpha > 0
    assert 0.02 < is_drawn.mean() < 0.9  # semi-dense
    assert np.median(np.abs(view.depth - depth)[is_drawn]) < 0.05  # metres
    points, _ = slam.mapper.points()
    assert slam.mapper.metrics()["num_points"] == len(points) > 500
    voxels = np.unique(np.floor(points.astype(np.float64) / 0.01), axis=0)
    assert len(voxels) == len(points)


def test_lost_without_events_and_said_to_be(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    config = settings("depth_event_vo", mapping={"enabled": False})
    slam = make_slam(tiny_sequence, tiny_samples, config)
    for k, sample in enumerate(tiny_samples[:8]):
        slam.process(without_events(sample) if k in (4, 5, 6) else sample)
    lost = [k for k, r in enumerate(slam.results) if not r.converged]
    assert {5, 6} <= set(lost) <= {4, 5, 6, 7}
    assert "of the points lie on edges" in slam.results[6].message
    motion = inverse(slam.results[5].T_world_camera) @ slam.results[6].T_world_camera
    assert np.isfinite(motion).all()
