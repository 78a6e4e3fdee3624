"""Sums of events, and the solves for brightness, depth and pose by the change between renders."""

import numpy as np
import pytest
import torch
from sequences import make_slam, settings

from edslam_ti.camera import Camera
from edslam_ti.config import MappingConfig
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import ConfigError
from edslam_ti.evaluation.images import evaluate_images
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sums import EventSums
from edslam_ti.events import Events
from edslam_ti.frame import Frame
from edslam_ti.geometry import inverse, se3_exp, se3_log
from edslam_ti.mapping.brightness_solve import Pair, solve_brightness
from edslam_ti.mapping.change_loss import PathPoses, Reduction
from edslam_ti.mapping.depth_solve import SeenFrom, solve_depth
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.pose_solve import solve_pose
from edslam_ti.mapping.rendering import RenderOutput, render_map
from edslam_ti.methods import METHODS
from edslam_ti.trajectory import Trajectory

CAMERA = Camera(96, 64, 60.0, 60.0, 47.5, 31.5)
EPSILON = 0.004
FULL = Reduction.of(CAMERA, 0)
# All look slightly up: seen straight on, the wall's Gaussians would change their order between views.
POSES = [se3_exp(np.array([0.04 * k, 0.02 * (k % 3), 0.0, 0.05, 0.01 + 0.01 * k, 0.0])) for k in range(8)]


def textured_wall(distance: float = 2.0) -> GaussianMap:
    """Return a wall of Gaussians 5 cm apart, with stripes and blotches of several sizes."""
    x, y = (
        a.reshape(-1)
        for a in torch.meshgrid(torch.arange(-2, 2.6, 0.05), torch.arange(-1.4, 1.5, 0.05), indexing="ij")
    )
    n = len(x)
    means = torch.stack([x, y, torch.full((n,), 2.0)], 1)
    colors = 0.5 + 0.2 * torch.sin(5 * x) * torch.cos(4 * y) + 0.15 * torch.sign(torch.sin(13 * x + 3 * y))
    gaussians = GaussianMap(MappingConfig())
    factor = distance / 2.0
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    gaussians.add(factor * means, quats, torch.full((n, 3), 0.03 * factor), 0.95, colors[:, None])
    return gaussians


def views_of(gaussians: GaussianMap) -> list[RenderOutput]:
    return [render_map(gaussians, CAMERA, T, 0.5) for T in POSES]


def changes(views: list[RenderOutput]) -> list[Pair]:
    logs = [(view.intensity + EPSILON).log() for view in views]
    gaps = [(k, k + gap) for gap in (1, 2, 4) for k in range(len(views) - gap)]
    return [Pair(a, b, logs[b] - logs[a]) for a, b in gaps]


def frame_of(events: Events, start: float, end: float, is_held_out: bool = False) -> Frame:
    return Frame(end, start, events, CAMERA, None, None, is_held_out)


def random_events(count: int, start: float, end: float, seed: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, CAMERA.width, count).astype(np.int16),
        rng.integers(0, CAMERA.height, count).astype(np.int16),
        np.sort(rng.uniform(start, end, count)),
        (2 * rng.integers(0, 2, count) - 1).astype(np.int8),
    )


def test_change_between_knots_is_the_sum_of_the_events_between() -> None:
    sums = EventSums(CAMERA.shape, 0.12, 0.08, knots_per_frame=4)
    parts = [random_events(20_000, 0.1 * k, 0.1 * (k + 1), k) for k in range(3)]
    for k, events in enumerate(parts):
        sums.add(frame_of(events, 0.1 * k, 0.1 * (k + 1), is_held_out=k == 1), k)
    start, end = sums.knots(0)[1], sums.knots(2)[2]
    events = Events.concatenate(parts).between(start.time, end.time)
    expected = np.zeros(CAMERA.shape)
    np.add.at(expected, (events.y, events.x), np.where(events.polarity > 0, 0.12, -0.08))
    np.testing.assert_allclose(sums.change(start, end).numpy(), expected, atol=1e-5)
    assert end.num_events - start.num_events == len(events)
    assert len(sums.knots(1)) == 3  # the held-out frame's own moment is not known to the map
    assert sums.knots(2)[-1].time == pytest.approx(0.3)


def test_sums_wrap_around_without_harm() -> None:
    sums = EventSums(CAMERA.shape, 0.1, 0.1, knots_per_frame=1)
    y, x = (np.tile(a.ravel(), 99).astype(np.int16) for a in np.mgrid[0:9, 0:9])  # no pixel stands out
    for k in range(9):
        events = Events(x, y, np.linspace(k, k + 0.9, len(x)), np.ones(len(x), np.int8))
        sums.add(frame_of(events, float(k), float(k + 1)), k)
    before, last = sums.knots(4)[-1], sums.knots(8)[-1]
    assert int(last.sums[1, 1]) != 9 * 99 * 50  # more than 16 bits hold
    assert float(sums.change(before, last)[1, 1]) == pytest.approx(4 * 9.9, abs=1e-3)


def test_brightness_is_solved_from_changes_alone() -> None:
    gaussians = textured_wall()
    truth = gaussians.activated().colors.detach().clone()
    pairs, before = changes(views_of(gaussians)), [v.intensity for v in views_of(gaussians)]
    gaussians.set_colors(torch.full_like(truth, 0.4))
    for _ in range(3):
        assert solve_brightness(gaussians, views_of(gaussians), pairs, EPSILON, 0.93, 100)
    after = [v.intensity for v in views_of(gaussians)]
    logs = torch.stack([b.log() - a.log() for a, b in zip(before, after)])
    assert float((logs - logs.median()).abs().median()) < 0.05  # up to one factor
    shown = torch.stack(after).flatten().sort().values
    assert float(shown[int(0.99 * len(shown))]) == pytest.approx(0.93, abs=0.05)


def test_depth_is_solved_from_changes_alone() -> None:
    pairs = changes(views_of(textured_wall()))
    wrong = textured_wall(distance=2.4)
    errors = []
    for cell in (0.3, 0.3, 0.3, 0.2, 0.2, 0.2):
        errors.append(float((wrong.raw["means"][:, 2].detach() - 2.0).abs().median()))
        seen = [
            SeenFrom(view, torch.from_numpy(inverse(T)).float()) for view, T in zip(views_of(wrong), POSES)
        ]
        solve_depth(wrong, seen, pairs, FULL, EPSILON, cell, 60)
    error = float((wrong.raw["means"][:, 2].detach() - 2.0).abs().median())
    assert errors[0] == pytest.approx(0.4, abs=0.01)
    assert error < 0.2  # metres


def test_pose_is_solved_from_the_change_since_an_earlier_moment() -> None:
    gaussians = textured_wall()
    logs = [(render_map(gaussians, CAMERA, T, 0.5).intensity + EPSILON).log() for T in (POSES[0], POSES[2])]
    change = logs[1] - logs[0]
    levels = (Reduction.of(CAMERA, 1), FULL)
    solved = solve_pose(gaussians, POSES[0], logs[0] + change, change, levels, 0.5, EPSILON, 10)
    corners = np.array([[x, y, 2.0, 1.0] for x in (-0.6, 0.8) for y in (-0.4, 0.5)])
    poses = (solved.T_world_camera, POSES[2], POSES[0])
    found, true, start = (CAMERA.project((corners @ inverse(T).T)[:, :3])[:2] for T in poses)
    assert np.abs(np.subtract(found, true)).max() < 0.3  # pixels; a plane hardly tells turn from shift
    assert np.abs(np.subtract(start, true)).max() > 2
    assert solved.explained > 0.95
    nothing = GaussianMap(MappingConfig())
    assert solve_pose(nothing, POSES[0], logs[0], change, levels, 0.5, EPSILON, 3).explained == 0.0


def test_poses_between_key_poses_are_differentiable_in_both() -> None:
    trajectory = Trajectory(np.array([0.0, 1.0, 2.0]), np.array(POSES[:3]))
    path = PathPoses(trajectory, (0.5, 1.25), range(3))
    np.testing.assert_allclose(path.T_world_camera.detach().numpy()[1], trajectory.at(1.25), atol=1e-12)
    path.T_world_camera[:, :3, 3].sum().backward()
    gradients = path.gradients()
    assert set(gradients) == {1, 2}  # the first frame's pose defines the world
    twist, step = np.array([0.0, 0, 0, 0, 1, 0]), 1e-6
    moved = Trajectory(trajectory.timestamps, trajectory.poses)
    moved.replace(2, trajectory.pose(2) @ se3_exp(step * twist))
    numerical = (moved.at(1.25)[:3, 3].sum() - trajectory.at(1.25)[:3, 3].sum()) / step
    assert gradients[2] @ twist == pytest.approx(numerical, abs=1e-4)


def psnr_of(method: str, sequence: EventDepthSequence, samples: list[Sample], **differences: object) -> float:
    slam = make_slam(sequence, samples, settings(method, **differences))
    held_out = range(2, len(samples), 5)
    for k, sample in enumerate(samples):
        slam.process(sample, is_held_out=k in held_out)
    mapper = slam.mapper
    assert mapper is not None
    mapper.finish(slam.trajectory, lambda share: True)
    views = [mapper.render(sequence.camera, slam.trajectory.pose(k)).intensity for k in held_out]
    images = [image for k in held_out if (image := samples[k].image) is not None]
    found = evaluate_images(views, images, [None] * len(views)).psnr_corrected_db_all
    return found


@pytest.mark.slow
def test_events_alone_make_a_map(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    assert psnr_of("event_3dgs", tiny_sequence, tiny_samples, mapping={"final_iterations": 200}) > 17


@pytest.mark.slow
def test_the_papers_mapper_makes_a_map(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    few = {"iterations": 1, "final_iterations": 80}
    assert psnr_of("ed_slam_paper", tiny_sequence, tiny_samples, mapping=few) > 21


@pytest.mark.slow
def test_poses_are_found_from_events_alone(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    config = settings("inc_event_gs", mapping={"final_iterations": 0, "iterations": 1})
    slam = make_slam(tiny_sequence, tiny_samples[:10], config)
    for sample in tiny_samples[:10]:
        slam.process(sample)
    estimate = inverse(slam.trajectory.pose(0)) @ slam.trajectory.pose(5)
    first, sixth = tiny_samples[0].T_world_camera, tiny_samples[5].T_world_camera
    assert first is not None
    assert sixth is not None
    error = se3_log(inverse(estimate) @ inverse(first) @ sixth)
    assert np.linalg.norm(error[3:]) < 0.05  # radians
    assert sum(r.converged for r in slam.results) >= 8


def test_what_a_method_needs_is_said(tiny_sequence: EventDepthSequence) -> None:
    contrast = ContrastThreshold(0.1, "data")
    config = settings("event_3dgs", poses="tracked")
    with pytest.raises(ConfigError, match="event_3dgs maps with known poses"):
        METHODS["event_3dgs"].build(tiny_sequence, contrast, config)
    config = settings("inc_event_gs", mapping={"enabled": False})
    with pytest.raises(ConfigError, match="inc_event_gs tracks by its map"):
        METHODS["inc_event_gs"].build(tiny_sequence, contrast, config)
