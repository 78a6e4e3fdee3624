"""Samples become frames; surfaces have a memory, and a pyramid mixes no surfaces of depth."""

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import TimeSurfaceConfig
from edslam_ti.datasets import Sample
from edslam_ti.events import Events
from edslam_ti.frame import Frame, FrameBuilder
from edslam_ti.tracking.surfaces import SurfaceFrame, SurfaceFrameBuilder

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
SHARP = TimeSurfaceConfig(decay=0.1, blur=0)


def one_event(x: int, y: int, t: float) -> Events:
    return Events(np.array([x], np.int16), np.array([y], np.int16), np.array([t]), np.array([1], np.int8))


def frame(timestamp: float, events: Events, depth: np.ndarray | None = None) -> Frame:
    return Frame(timestamp, 0.0, events, CAMERA, depth, None)


def test_surface_remembers_events_of_earlier_frames_until_it_is_reset() -> None:
    builder = SurfaceFrameBuilder(CAMERA, SHARP)
    builder.build(frame(0.05, one_event(2, 1, 0.04)))
    later = builder.build(frame(0.15, one_event(5, 3, 0.12))).level(0).surface
    np.testing.assert_allclose(later[1, 2], np.exp(-1.1), rtol=1e-5)
    np.testing.assert_allclose(later[3, 5], np.exp(-0.3), rtol=1e-5)
    assert np.count_nonzero(later) == 2
    builder.reset()
    assert not builder.build(frame(0.2, Events.empty())).level(0).surface.any()


def test_chunk_starts_where_the_previous_one_ended() -> None:
    builder = FrameBuilder(CAMERA)
    first = builder.build(Sample(0.05, Events.empty(), depth=None))
    second = builder.build(Sample(0.15, Events.empty(), depth=None), is_held_out=True)
    assert (first.previous_timestamp, second.previous_timestamp) == (0.05, 0.05)
    assert (first.is_held_out, second.is_held_out) == (False, True)


def test_blur_spreads_an_event_and_keeps_its_sum() -> None:
    builder = SurfaceFrameBuilder(CAMERA, TimeSurfaceConfig(decay=0.1, blur=0.6))
    blurred = builder.build(frame(0.05, one_event(4, 3, 0.05 - 1e-9))).level(0).surface
    assert 0 < blurred[3, 5] < blurred[3, 4] < 1
    np.testing.assert_allclose(blurred.sum(), 1.0, rtol=0.01)  # borders reflect a little of it


def test_pyramid_halves_the_image_and_its_camera() -> None:
    surface = np.random.default_rng(0).random(CAMERA.shape, np.float32)
    level = SurfaceFrame(frame(0.1, Events.empty()), surface).level(1)
    assert (level.camera.width, level.camera.height, level.camera.fx) == (4, 3, 5.0)
    np.testing.assert_allclose(level.surface[1, 2], surface[2:4, 4:6].mean(), rtol=1e-6)
    assert (level.depth == 0).all()  # no depth image: missing everywhere


def test_pyramid_leaves_out_depth_across_an_edge_or_a_hole() -> None:
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    depth[0, 0] = 0  # a hole
    depth[2, 2] = 2.2  # 10 % farther: an edge
    depth[4, 4] = 2.04  # 2 %: the same surface
    surface = np.zeros(CAMERA.shape, np.float32)
    reduced = SurfaceFrame(frame(0.1, Events.empty(), depth), surface).level(1).depth
    assert (reduced[0, 0], reduced[1, 1]) == (0, 0)
    np.testing.assert_allclose([reduced[2, 2], reduced[0, 1]], [2.01, 2.0], rtol=1e-6)


def test_events_are_counted_by_pixel_with_the_first_and_the_last_polarity() -> None:
    x, y = np.array([2, 2, 2, 5], np.int16), np.array([1, 1, 1, 3], np.int16)
    counts = frame(0.1, Events(x, y, np.arange(4.0), np.array([1, -1, -1, 1], np.int8))).event_counts
    assert counts.numbers.sum() == 4
    assert counts.numbers[1, 2].tolist() == [2, 1]
    assert counts.numbers[3, 5].tolist() == [0, 1]
    assert (counts.first[1, 2], counts.last[1, 2]) == (1, -1)
    assert (np.count_nonzero(counts.first), np.count_nonzero(counts.last)) == (2, 2)


def test_events_of_a_frame_are_counted_once() -> None:
    one = frame(0.1, one_event(2, 1, 0.05))
    assert one.event_counts is one.event_counts
