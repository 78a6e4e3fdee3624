"""How a sequence is cut into samples, on a sequence that lives in memory."""

import itertools

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence, SampledSequence
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.trajectory import Trajectory


class MemorySequence(EventDepthSequence):
    """One event at time 0, then one per millisecond over a second; depth and images hold their own index."""

    dataset, scene, description = "memory", "test", "in memory"
    camera = Camera(width=4, height=3, fx=4.0, fy=4.0, cx=1.5, cy=1.0)
    contrast_threshold = None

    def __init__(
        self, depth_timestamps: np.ndarray, image_timestamps: np.ndarray, truth: Trajectory | None = None
    ) -> None:
        self.depth_timestamps, self.image_timestamps = depth_timestamps, image_timestamps
        self.truth = truth
        t = np.append(0.0, np.arange(1000) / 1000 + 0.0005)
        zeros = np.zeros(len(t), np.int16)
        self._events = Events(zeros, zeros, t, np.ones(len(t), np.int8))

    def depth(self, index: int) -> np.ndarray:
        return np.full(self.camera.shape, index + 1, np.float32)

    def image(self, index: int) -> np.ndarray:
        return np.full(self.camera.shape, index / 100, np.float32)

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    @property
    def time_range(self) -> tuple[float, float]:
        return float(self._events.t[0]), float(self._events.t[-1])


def sequence(depth_every: float = 0.05, image_every: float = 0.1) -> MemorySequence:
    steps = np.arange(0, 1 + 1e-9, 0.1)
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, 0, 3] = steps
    return MemorySequence(
        np.arange(depth_every, 1 + 1e-9, depth_every),
        np.arange(0, 1 + 1e-9, image_every),
        Trajectory(steps, poses),
    )


def test_every_depth_image_ends_a_sample() -> None:
    samples = SampledSequence(sequence(0.05), start=0.0, duration=None, max_interval=0.1)
    np.testing.assert_allclose(samples.timestamps, sequence(0.05).depth_timestamps)
    assert samples.has_depth.all()
    assert [int(s.depth[0, 0]) for s in samples if s.depth is not None] == list(range(1, 21))


def test_events_of_the_samples_part_the_stream() -> None:
    samples = list(SampledSequence(sequence(0.05), start=0.2, duration=0.5, max_interval=0.02))
    for before, after in itertools.pairwise(samples):
        assert (after.events.t >= before.timestamp).all()
        assert (after.events.t < after.timestamp).all()
    assert sum(len(s.events) for s in samples[1:]) == 500  # one per millisecond


def test_first_sample_has_a_little_history() -> None:
    first = SampledSequence(sequence(), start=0.5, duration=None, max_interval=0.1)[0]
    assert first.timestamp == pytest.approx(0.5)
    assert len(first.events) == 100


def test_long_gaps_are_divided_evenly_by_samples_without_depth() -> None:
    samples = SampledSequence(sequence(depth_every=0.25), start=0.0, duration=None, max_interval=0.1)
    np.testing.assert_allclose(np.diff(samples.timestamps), 0.25 / 3)
    assert samples.has_depth.tolist() == [True, *[False, False, True] * 3]
    assert samples[1].depth is None
    assert samples[3].depth is not None
    assert samples[3].depth[0, 0] == 2


def test_gap_of_exactly_the_longest_interval_is_not_divided() -> None:
    samples = SampledSequence(sequence(depth_every=0.1), start=0.0, duration=None, max_interval=0.1)
    assert len(samples) == 10


def test_start_and_duration_cut_the_sequence() -> None:
    samples = SampledSequence(sequence(0.05), start=0.3, duration=0.2, max_interval=0.1)
    np.testing.assert_allclose(samples.timestamps, [0.3, 0.35, 0.4, 0.45, 0.5])
    assert samples[0].depth is not None
    assert samples[0].depth[0, 0] == 6


def test_depth_far_outside_the_events_is_left_out() -> None:
    late = MemorySequence(np.arange(-1, 3, 0.05).round(2), np.empty(0))
    times = SampledSequence(late, start=-10.0, duration=None, max_interval=0.1).timestamps
    assert times[0] == pytest.approx(0.05)  # not at 0: no events would be behind it
    assert 1 < times[-1] < 1.11


def test_images_and_true_poses_come_with_the_samples_that_have_them() -> None:
    samples = SampledSequence(sequence(0.05, image_every=0.1), start=0.0, duration=None, max_interval=0.1)
    assert samples[1].image is not None
    assert samples[1].image[0, 0] == pytest.approx(0.01)
    assert samples[2].image is None
    pose = samples[2].T_world_camera
    assert pose is not None
    assert pose[0, 3] == pytest.approx(0.15)  # between two true poses, Eq. 9


def test_sequence_without_images_or_truth_is_sampled_all_the_same() -> None:
    bare = MemorySequence(np.arange(0, 1, 0.05), np.empty(0))
    sample = SampledSequence(bare, start=0.0, duration=None, max_interval=0.1)[4]
    assert sample.image is None
    assert sample.T_world_camera is None


@pytest.mark.parametrize(("start", "duration"), [(5.0, None), (0.0, 0.01), (0.97, None), (0.3, 0.02)])
def test_fewer_than_two_depth_images_is_an_error_that_states_the_coverage(
    start: float, duration: float | None
) -> None:
    with pytest.raises(DataError, match=r"at least 2 depth images .* depth covers 0\.050 to 1\.000 s"):
        SampledSequence(sequence(), start=start, duration=duration, max_interval=0.1)


def test_sequence_without_depth_is_an_error() -> None:
    with pytest.raises(DataError, match="depth covers nothing"):
        SampledSequence(MemorySequence(np.empty(0), np.empty(0)), 0.0, None, 0.1)


def test_start_counts_from_the_first_event_or_depth_image() -> None:
    later = MemorySequence(np.arange(20.05, 21, 0.05), np.empty(0))
    events = later._events
    later._events = Events(events.x, events.y, events.t + 20.0, events.polarity)
    samples = SampledSequence(later, start=0.5, duration=0.2, max_interval=0.1)
    np.testing.assert_allclose(samples.timestamps, [20.5, 20.55, 20.6, 20.65, 20.7])


def test_index_beyond_the_end_is_an_error() -> None:
    samples = SampledSequence(sequence(), start=0.0, duration=None, max_interval=0.1)
    with pytest.raises(IndexError):
        samples[len(samples)]
