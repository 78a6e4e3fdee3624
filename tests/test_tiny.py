"""Read this first: the whole of ED-SLAM on a tiny room, from events to a trajectory and a map, in seconds.

The room is 3 m wide and simulated; its camera has 120x80 pixels and moves 22 cm in 0.7 s. Each test is
one step of the data flow, in order, and builds on nothing but the recording.
"""

from pathlib import Path

import numpy as np
import torch
from sequences import ate_cm, make_slam, settings, tracked

from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.events import Events
from edslam_ti.frame import FrameBuilder
from edslam_ti.kernels.time_surface import count_events
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.rendering import render
from edslam_ti.tracking.surfaces import SurfaceFrameBuilder
from edslam_ti.trajectory import Trajectory, read_tum, write_tum


def summed_polarity(chunks: list[Events], shape: tuple[int, int]) -> np.ndarray:  # [H, W] float32
    counts, last = np.zeros((*shape, 2), np.int32), np.zeros(shape, np.int8)
    for events in chunks:
        count_events(events.x, events.y, events.polarity, counts, last)
    return (counts[..., 1] - counts[..., 0]).astype(np.float32)


def test_events_are_changes_of_log_brightness(tiny_samples: list[Sample]) -> None:
    before, after = tiny_samples[4], tiny_samples[5]
    events = after.events  # those between the two
    assert before.image is not None
    assert after.image is not None
    sums = summed_polarity([events], before.image.shape)
    change = np.log(after.image + 1 / 255) - np.log(before.image + 1 / 255)
    error = np.abs(0.1 * sums - change)  # C = 0.1 of log brightness per event
    # Up to one threshold is pending at each end, and images are rounded to 8 bits.
    assert np.mean(error < 0.2) > 0.99


def test_time_surface_is_bright_where_events_are_fresh(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    sample = tiny_samples[0]
    camera = tiny_sequence.camera
    builder = SurfaceFrameBuilder(camera, TimeSurfaceConfig(decay=0.03, blur=0))
    surface = builder.build(FrameBuilder(camera).build(sample)).level(0).surface
    x, y, t = sample.events.x[-1], sample.events.y[-1], sample.events.t[-1]
    np.testing.assert_allclose(surface[y, x], np.exp((t - sample.timestamp) / 0.03), rtol=1e-5)  # Eq. 1
    never = np.ones(surface.shape, bool)
    never[sample.events.y, sample.events.x] = False
    assert (surface[never] == 0).all()


def test_a_motion_of_one_centimetre_is_recovered(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    first, later = tiny_samples[0], next(s for s in tiny_samples if moved(tiny_samples[0], s) > 0.01)
    slam = tracked(tiny_sequence, [first, later])  # no prediction yet: starts at the first pose
    assert slam.results[-1].converged
    assert later.T_world_camera is not None
    error = slam.trajectory.pose(-1)[:3, 3] - later.T_world_camera[:3, 3]
    assert np.linalg.norm(error) < 0.001  # 1 mm, 0.04 pixels at the mean depth of 1.6 m


def moved(a: Sample, b: Sample) -> float:
    """Return the distance between two true positions in metres."""
    assert a.T_world_camera is not None
    assert b.T_world_camera is not None
    return float(np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3]))


def test_gaussians_from_one_depth_image_render_it_back(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    # Large enough to overlap; the default's gaps are filled by later frames.
    slam = make_slam(tiny_sequence, tiny_samples, settings(mapping={"initial_size": 0.6}))
    slam.process(tiny_samples[0])
    assert isinstance(slam.mapper, GaussianMapper)
    assert 120 * 80 / 4 < slam.mapper.num_gaussians < 120 * 80 / 3  # one per 2x2 pixels, more at outlines
    view = slam.mapper.render(tiny_sequence.camera, slam.trajectory.pose(0))
    assert tiny_samples[0].depth is not None
    assert np.mean(view.alpha > 0.8) > 0.95
    # Edges mix near and far; half of the pixels are on smooth surfaces and within a centimetre.
    assert np.median(np.abs(view.depth - tiny_samples[0].depth)) < 0.01


def test_mapping_makes_the_event_loss_fall(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    config = settings(poses="truth", mapping={"iterations": 0, "final_iterations": 60})
    slam = make_slam(tiny_sequence, tiny_samples, config)
    for sample in tiny_samples[:8]:
        slam.process(sample)
    mapper = slam.mapper
    assert isinstance(mapper, GaussianMapper)
    sums = summed_polarity([s.events for s in tiny_samples[1:8]], tiny_sequence.camera.shape)
    measured = torch.from_numpy(0.1 * sums)  # Eq. 11

    @torch.no_grad()
    def loss() -> float:
        gaussians = mapper.gaussians.activated()
        views = [
            render(gaussians, tiny_sequence.camera, torch.from_numpy(slam.trajectory.pose(k)), background=0.5)
            for k in (0, 7)
        ]
        first, last = (torch.log(view.intensity + 1 / 255) for view in views)
        predicted = last - first  # Eq. 10
        # Eq. 12, squared, as a share of the measured square
        return float((predicted - measured).square().mean() / measured.square().mean())

    before = loss()
    mapper.finish(slam.trajectory, progress=lambda fraction: True)
    assert loss() < 0.5 * before  # 1 would be a map of one brightness


def test_the_trajectory_is_written_and_within_millimetres_of_the_truth(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], tmp_path: Path
) -> None:
    slam = tracked(tiny_sequence, tiny_samples)
    assert all(result.converged for result in slam.results)
    assert ate_cm(slam, tiny_sequence) < 0.2  # 2 mm over 22 cm; about 1 mm was measured
    write_tum(slam.trajectory, tmp_path / "trajectory_tum.txt")
    written: Trajectory = read_tum(tmp_path / "trajectory_tum.txt")
    np.testing.assert_allclose(written.poses, slam.trajectory.poses, atol=1e-8)  # nine digits
