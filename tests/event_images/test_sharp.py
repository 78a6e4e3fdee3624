"""Grey images beside events: freed of motion blur, never of held-out frames, and they tell the level."""

from pathlib import Path

import numpy as np
import pytest
from sequences import make_slam, record_tiny_room, settings

from edslam_ti.config import MappingConfig
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError
from edslam_ti.evaluation.images import evaluate_images
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sharp import SharpImages, change_from_mean
from edslam_ti.events import Events
from edslam_ti.frame import Frame, FrameBuilder
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.targets import EventImages
from edslam_ti.trajectory import Trajectory

THRESHOLD = ContrastThreshold(0.1, "data")
HELD_OUT = {2, 7}


def frames_of(sequence: EventDepthSequence) -> list[Frame]:
    builder = FrameBuilder(sequence.camera)
    return [builder.build(sample) for sample in SampledSequence(sequence, 0.0, None, 0.05)]


def test_brightness_over_its_mean_during_the_exposure() -> None:
    # Two pixels: one doubles after a quarter of the exposure, then halves behind it; the other stays.
    events = Events(
        np.zeros(2, np.int16), np.zeros(2, np.int16), np.array([1.0, 5.0]), np.array([1, -1], np.int8)
    )
    step = np.log([2.0, 0.5])
    mean = 0.25 * 1 + 0.75 * 2
    for time, brightness in ((0.5, 1), (3.0, 2), (6.0, 1)):
        change = change_from_mean(events, step, (0.0, 4.0), time, (1, 2))
        np.testing.assert_allclose(change, [[np.log(brightness / mean), 0.0]], atol=1e-12)


def test_without_exposure_the_image_is_brought_to_the_time_of_the_frame() -> None:
    events = Events(np.zeros(1, np.int16), np.zeros(1, np.int16), np.array([1.0]), np.ones(1, np.int8))
    for taken, time, expected in ((0.5, 1.5, 0.1), (1.5, 0.5, -0.1), (0.2, 0.5, 0.0)):
        part = events.between(min(taken, time), max(taken, time))
        change = change_from_mean(part, np.full(len(part), 0.1), (taken, taken), time, (1, 1))
        np.testing.assert_allclose(change, [[expected]], atol=1e-12)


@pytest.mark.slow
def test_events_of_the_exposure_remove_its_motion_blur(tmp_path: Path) -> None:
    motion = {"duration": 0.4, "speed": 5.0}
    blurred = EventReplicaSequence(record_tiny_room(tmp_path / "blurred", exposure=0.08, **motion))
    sharp = EventReplicaSequence(record_tiny_room(tmp_path / "sharp", **motion))
    assert (blurred.exposure, sharp.exposure) == (0.08, 0.0)

    def error(exposure: float | None) -> float:
        images = SharpImages(blurred, THRESHOLD, MappingConfig(exposure=exposure))
        differences = []
        for frame in frames_of(blurred)[:-1]:  # the recording cuts the last exposure off
            truth, image = sharp.image_at(frame.timestamp), images.at(frame)
            assert truth is not None
            assert image is not None
            differences.append(np.log(truth + 0.004) - image.log_brightness)
        return float(np.sqrt(np.mean(np.square(differences))))

    as_they_are, sharpened = error(0.0), error(None)
    assert sharpened < 0.5 * as_they_are  # 0.018 and 0.057 were measured


def test_clipped_pixels_only_bound_brightness(tiny_sequence: EventDepthSequence, tiny_folder: Path) -> None:
    grey = np.full(tiny_sequence.camera.shape, 0.5, np.float32)
    grey[3, 5], grey[4, 6] = 0.0, 1.0

    class Clipped(EventReplicaSequence):
        def image(self, index: int) -> np.ndarray:
            return grey

    sequence = Clipped(tiny_folder)
    image = SharpImages(sequence, THRESHOLD, MappingConfig()).at(frames_of(sequence)[3])
    assert image is not None
    for other in (-6.0, 0.5):  # darker than black, brighter than white
        combined = image.imposed_on(np.full(grey.shape, other, np.float32))
        expected = np.full(grey.shape, np.log(0.504))
        expected[3, 5], expected[4, 6] = min(other, np.log(0.004)), max(other, np.log(1.004))
        np.testing.assert_allclose(combined, expected, atol=1e-5)


def test_sequence_without_images_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    folder = record_tiny_room(tmp_path / "room", duration=0.2)
    for image in (folder / "images").iterdir():
        image.unlink()
    with pytest.raises(DataError, match=r"room: mapping\.frames: expected .* grey images, got .*leave out"):
        SharpImages(EventReplicaSequence(folder), THRESHOLD, MappingConfig())


class Rare(EventReplicaSequence):
    """Every fourth image of a recording."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.image_timestamps = self.image_timestamps[1::4]
        self._image_files = self._image_files[1::4]


def test_between_images_events_carry_on(tiny_folder: Path, tiny_samples: list[Sample]) -> None:
    rare, config = Rare(tiny_folder), MappingConfig(max_views=10)
    images = EventImages(rare.camera, THRESHOLD, config, SharpImages(rare, THRESHOLD, config))
    trajectory = Trajectory()
    for k, frame in enumerate(frames_of(rare)):
        images.add(frame, k)
        T = tiny_samples[k].T_world_camera
        assert T is not None
        trajectory.append(frame.timestamp, T)
    assert images.solve(trajectory, is_thorough=True)
    images.drop_surplus(keep=set())
    assert len(images.frames) == 10
    errors = []
    for k in images.frames:
        truth = tiny_samples[k].image
        assert truth is not None
        errors.append(float(np.sqrt(np.mean((images.log_brightness(k) - np.log(truth + 0.004)) ** 2))))
    assert max(errors) < 0.07  # 0.042 was measured


class Watched(EventReplicaSequence):
    """Notes which images are looked at."""

    def __init__(self, folder: Path) -> None:
        self.used: set[int] = set()
        super().__init__(folder)
        self.used.clear()

    def image(self, index: int) -> np.ndarray:
        self.used.add(index)
        return super().image(index)


def mapped(
    sequence: EventDepthSequence, samples: list[Sample], frames: bool
) -> tuple[GaussianMapper, float, float]:
    """Return a mapper and the PSNR of its held-out views, raw and after EventNeRF's fit."""
    steps = {"iterations": 2, "final_iterations": 15, "frames": frames}
    slam = make_slam(sequence, samples, settings(poses="truth", mapping=steps))
    for k, sample in enumerate(samples):
        slam.process(sample, is_held_out=k in HELD_OUT)
    mapper = slam.mapper
    assert isinstance(mapper, GaussianMapper)
    mapper.finish(slam.trajectory, lambda fraction: True)
    views = [mapper.render(sequence.camera, slam.trajectory.pose(k)).intensity for k in sorted(HELD_OUT)]
    truths = [image for k in sorted(HELD_OUT) if (image := samples[k].image) is not None]
    measured = evaluate_images(views, truths, [np.ones(t.shape, bool) for t in truths])
    assert measured.psnr_db is not None
    assert measured.psnr_corrected_db is not None
    return mapper, measured.psnr_db, measured.psnr_corrected_db


@pytest.mark.slow
def test_images_fix_the_level_and_those_of_held_out_frames_stay_unused(
    tiny_sequence: EventDepthSequence, tiny_folder: Path, tiny_samples: list[Sample]
) -> None:
    watched = Watched(tiny_folder)
    _, raw, corrected = mapped(tiny_sequence, tiny_samples[:10], frames=False)
    _, raw_with, corrected_with = mapped(watched, tiny_samples[:10], frames=True)
    assert raw_with > raw + 3  # 18.1 and 30.8 dB were measured
    assert corrected_with > corrected + 1
    assert raw_with > corrected_with - 1
    held_out = {int(np.abs(watched.image_timestamps - tiny_samples[k].timestamp).argmin()) for k in HELD_OUT}
    assert watched.used
    assert held_out.isdisjoint(watched.used)
