"""Images from events in a tiny room: close to what a camera would have seen, over several windows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sequences import record_tiny_room

from edslam_ti.config import MappingConfig
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.events import Events
from edslam_ti.frame import FrameBuilder
from edslam_ti.mapping.targets import EventImages, FrameSampler, evenly
from edslam_ti.trajectory import Trajectory

HELD_OUT = {4, 9}


def images_of(
    sequence: EventDepthSequence,
    samples: list[Sample],
    contrast: ContrastThreshold | None = None,
    **settings: float,
) -> tuple[EventImages, Trajectory]:
    """Return the images of a run with true poses, solved every five frames and at the end."""
    if contrast is None:
        assert sequence.contrast_threshold is not None
        contrast = ContrastThreshold(sequence.contrast_threshold, "data")
    images = EventImages(sequence.camera, contrast, MappingConfig(**settings))
    builder, trajectory = FrameBuilder(sequence.camera), Trajectory()
    for k, sample in enumerate(samples):
        assert sample.T_world_camera is not None
        trajectory.append(sample.timestamp, sample.T_world_camera)
        images.add(builder.build(sample, is_held_out=k in HELD_OUT), k)
        if k % 5 == 4:
            images.solve(trajectory)
    images.solve(trajectory, is_thorough=True)
    return images, trajectory


def errors(images: EventImages, samples: list[Sample]) -> np.ndarray:  # [F] log brightness
    """Return the rms error of every image, after one shift for all."""
    differences = []
    for k in images.frames:
        image = samples[k].image
        assert image is not None
        differences.append(images.log_brightness(k) - np.log(image + 1 / 255))
    shift = np.mean(differences)
    return np.array([float(np.sqrt(((d - shift) ** 2).mean())) for d in differences])


@pytest.mark.parametrize("stretch", [3.0, 0.25])
def test_images_are_close_to_the_truth_in_one_window_or_several(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], stretch: float
) -> None:
    images, _ = images_of(tiny_sequence, tiny_samples, stretch=stretch)
    assert HELD_OUT.isdisjoint(images.frames)
    spread = np.std([np.log(s.image + 1 / 255) for s in tiny_samples if s.image is not None])
    assert spread > 0.4
    assert errors(images, tiny_samples).max() < 0.3  # of which a blurred start is the larger part
    assert np.median(errors(images, tiny_samples)) < 0.26


def test_details_of_the_start_image_are_learned_from_renders(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    images, _ = images_of(tiny_sequence, tiny_samples)
    before = errors(images, tiny_samples)
    for _ in range(20):
        for k in images.frames:
            image = tiny_samples[k].image
            assert image is not None
            images.learn_detail_from_render(
                k, (np.log(image + 1 / 255) - images.log_brightness(k)).astype(np.float32)
            )
    assert (errors(images, tiny_samples) < before).all()


def test_brightest_percent_is_put_to_white(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    images, _ = images_of(tiny_sequence, tiny_samples)
    before = images.log_brightness(3)
    shift = images.set_white_level(0.9)
    np.testing.assert_allclose(images.log_brightness(3), before + shift, atol=1e-5)
    assert images.set_white_level(0.9) == pytest.approx(0, abs=1e-5)


def test_number_of_frames_is_bounded_and_keyframes_go_last(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    images, _ = images_of(tiny_sequence, tiny_samples, max_views=10)
    images.drop_surplus(keep={1, 3})
    assert len(images.frames) <= 10
    assert {1, 3, len(tiny_samples) - 1} <= set(images.frames)


@pytest.mark.slow
def test_unequal_thresholds_count_as_what_they_are(tmp_path: Path) -> None:
    folder = record_tiny_room(tmp_path / "room", contrast_threshold=0.2, negative_contrast_threshold=0.26)
    sequence = EventReplicaSequence(folder)
    samples = list(SampledSequence(sequence, start=0.0, duration=None, max_interval=0.1))
    unequal, equal = ContrastThreshold(0.23, "images", 0.2, 0.26), ContrastThreshold(0.23, "images")
    of_unequal, of_equal = (
        np.median(errors(images_of(sequence, samples, contrast)[0], samples)) for contrast in (unequal, equal)
    )
    assert of_unequal < 0.6 * of_equal  # 0.19 and 0.40 were measured


def test_noisy_pixels_are_found_and_replaced_by_their_neighbours(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    clean, _ = images_of(tiny_sequence, tiny_samples)
    assert not clean.noisy_pixels.mask.any()
    noisy = []
    for sample in tiny_samples:
        x, y = np.repeat(np.array([[30, 40], [77, 12]], np.int16), 40, axis=0).T
        ones = np.ones(len(x), np.int8)
        noise = Events(x.copy(), y.copy(), np.full(len(x), sample.timestamp), ones)
        noisy.append(replace(sample, events=Events.concatenate([sample.events, noise])))
    images, _ = images_of(tiny_sequence, noisy)
    assert np.argwhere(images.noisy_pixels.mask).tolist() == [[12, 77], [40, 30]]
    assert errors(images, tiny_samples).max() < 1.1 * errors(clean, tiny_samples).max() + 0.02


def test_half_of_the_recent_draws_are_of_the_newest_frames() -> None:
    sampler, frames = FrameSampler(np.random.default_rng(0), num_recent=5), list(range(0, 200, 2))
    drawn = np.array([sampler.recent(frames) for _ in range(2000)])
    assert set(drawn) <= set(frames)
    assert np.mean(drawn >= 190) == pytest.approx(0.5 + 0.5 * 5 / 100, abs=0.04)


def test_every_frame_is_drawn_once_before_any_repeats() -> None:
    sampler, frames = FrameSampler(np.random.default_rng(0), num_recent=5), [3, 5, 8, 9]
    for _ in range(3):
        assert sorted(sampler.any(frames) for _ in frames) == frames


def test_frames_are_evenly_spaced_and_include_the_last() -> None:
    assert evenly([1, 2, 3], 3) == [1, 2, 3]
    assert evenly(list(range(11)), 3) == [0, 5, 10]
