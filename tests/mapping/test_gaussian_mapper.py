"""The mapper: where Gaussians are added, what they are optimised for, and what is never looked at."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from sequences import make_slam, settings

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.depth_images import beside_steps
from edslam_ti.evaluation.images import depth_l1_cm, evaluate_images
from edslam_ti.geometry import se3_exp
from edslam_ti.mapping.budget import Budget
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.insertion import spaced
from edslam_ti.mapping.rendering import render, render_map
from edslam_ti.mapping.targets import EventImages
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import TruePoses

FEW = {"iterations": 1, "final_iterations": 3}


def mapped(
    sequence: EventDepthSequence,
    samples: list[Sample],
    held_out: set[int] | None = None,
    poses: str = "truth",
    finish: bool = True,
    **mapping: Any,
) -> tuple[Slam, GaussianMapper]:
    """Return a run over the samples, and its mapper."""
    slam = make_slam(sequence, samples, settings(poses=poses, mapping=FEW | mapping))
    for k, sample in enumerate(samples):
        slam.process(sample, is_held_out=k in (held_out or set()))
    assert isinstance(slam.mapper, GaussianMapper)
    if finish:
        slam.mapper.finish(slam.trajectory, lambda fraction: True)
    return slam, slam.mapper


def corrected_psnr(camera: Camera, slam: Slam, samples: list[Sample], indices: list[int]) -> float:
    """Return the PSNR in dB of views after EventNeRF's fit."""
    assert slam.mapper is not None
    views = [slam.mapper.render(camera, slam.trajectory.pose(k)).intensity for k in indices]
    truths = [image for k in indices if (image := samples[k].image) is not None]
    measured = evaluate_images(views, truths, [np.ones(t.shape, bool) for t in truths])
    assert measured.psnr_corrected_db is not None
    return measured.psnr_corrected_db


# --- what it achieves ---


@pytest.mark.slow
def test_mapping_raises_the_psnr_of_held_out_views(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    held_out = {3, 8, 12}
    untouched: dict[str, Any] = {"iterations": 0, "final_iterations": 0}
    camera = tiny_sequence.camera
    slam, _ = mapped(tiny_sequence, tiny_samples, held_out, finish=False, **untouched)
    before = corrected_psnr(camera, slam, tiny_samples, sorted(held_out))
    steps: dict[str, Any] = {"iterations": 8, "final_iterations": 100}
    slam, mapper = mapped(tiny_sequence, tiny_samples, held_out, **steps)
    after = corrected_psnr(camera, slam, tiny_samples, sorted(held_out))
    assert after > before + 5  # 13 dB to 22 dB was measured
    assert after > 18
    assert mapper.loss < 0.5


@pytest.mark.slow
def test_map_is_the_same_twice_to_the_last_bit(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    a, b = (mapped(tiny_sequence, tiny_samples[:6], poses="tracked") for _ in range(2))
    for name, values in a[1].gaussians.raw.items():
        assert (values == b[1].gaussians.raw[name]).all(), name
    assert (a[0].trajectory.poses == b[0].trajectory.poses).all()


# --- what it never looks at ---


def test_depth_of_held_out_frames_is_never_used(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    samples, held_out = tiny_samples[:8], {2, 5}
    poisoned = list(samples)
    for k in held_out:
        depth = samples[k].depth
        assert depth is not None
        poisoned[k] = replace(samples[k], depth=0.5 * depth)
    (_, clean), (_, other) = (mapped(tiny_sequence, s, held_out) for s in (samples, poisoned))
    assert clean.num_gaussians == other.num_gaussians
    for name, values in clean.gaussians.raw.items():
        assert (values == other.gaussians.raw[name]).all(), name


@pytest.mark.slow
def test_images_are_never_used(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    samples = tiny_samples[:6]
    blind = [replace(s, image=None) for s in samples]
    (_, clean), (_, other) = (mapped(tiny_sequence, s, poses="tracked") for s in (samples, blind))
    assert (clean.gaussians.raw["logit_colors"] == other.gaussians.raw["logit_colors"]).all()


def test_images_from_events_exist_at_every_frame_but_held_out_ones(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, mapper = mapped(tiny_sequence, tiny_samples, held_out={3, 8, 12}, finish=False)
    assert mapper.images.frames == [k for k in range(len(tiny_samples)) if k not in (3, 8, 12)]


# --- growing and pruning ---


def test_mapped_pixels_get_no_second_gaussians(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, first = mapped(tiny_sequence, tiny_samples[:1])
    assert tiny_samples[0].depth is not None
    spacing = np.where(beside_steps(tiny_samples[0].depth), 1, 2)
    assert 120 * 80 / 4 < spaced(spacing).sum() == first.num_gaussians
    _, all_of_them = mapped(tiny_sequence, tiny_samples, iterations=0)
    # 14 views of nearly the same walls: what is new is the gaps between small discs, the rim, behind edges.
    assert first.num_gaussians < all_of_them.num_gaussians < 4 * first.num_gaussians


def test_view_of_drawable_gaussians_equals_that_of_the_whole_map(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam, mapper = mapped(tiny_sequence, tiny_samples[:2], iterations=0, finish=False)
    T = slam.trajectory.pose(0) @ se3_exp(np.array([0.1, 0.0, -0.2, 0.1, 0.4, 0.0]))
    with torch.no_grad():
        whole = render(mapper.gaussians.activated(), tiny_sequence.camera, torch.from_numpy(T), 0.5)
    part = render_map(mapper.gaussians, tiny_sequence.camera, T, 0.5)
    assert int((whole.dominant < 0).sum()) > 0  # turned so far that the map ends inside the view
    for name in ("intensity", "depth", "alpha", "visible", "dominant"):
        assert torch.equal(getattr(part, name), getattr(whole, name)), name


def test_map_never_exceeds_its_largest_size(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, mapper = mapped(tiny_sequence, tiny_samples[:6], max_gaussians=1500)
    assert 1000 < mapper.num_gaussians <= 1500


@pytest.mark.slow
def test_small_map_covers_more_of_the_last_view(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    def gaps() -> float:
        slam, mapper = mapped(tiny_sequence, tiny_samples, max_gaussians=3300, final_iterations=30)
        assert mapper.num_gaussians <= 3300  # 2677 are of the first view
        last = mapper.render(tiny_sequence.camera, slam.trajectory.pose(len(tiny_samples) - 1))
        return float((last.alpha < 0.5).mean())

    coarser = gaps()
    monkeypatch.setattr("edslam_ti.mapping.insertion.stride_for_budget", lambda stride, fullness: stride)
    assert coarser < 0.8 * gaps()


def test_map_of_a_few_gaussians_is_refined_like_any_other(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam, mapper = mapped(tiny_sequence, tiny_samples[:6], finish=False, max_gaussians=4, min_opacity=0.0)
    mapper.gaussians.raw["means"].data[1:] += 50.0  # out of sight: a single one is seen
    mapper.finish(slam.trajectory, lambda fraction: True)
    assert mapper.num_gaussians == 4
    assert np.isfinite(mapper.points()[1]).all()


@pytest.mark.slow
def test_map_follows_when_a_revisit_corrects_the_path(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = [T for s in tiny_samples if (T := tiny_sequence.true_pose(s.timestamp)) is not None]
    drift = np.array([2e-3, 0.0, 8e-3, 0.0, 1e-3, 5e-4])  # a frame: 12 cm and a degree in all

    def depth_error(share: float = 1.0) -> float:
        """Return the depth L1 (cm) of a map whose path, drifted, was corrected before its last frame."""
        *before, last = tiny_samples
        poses = {s.timestamp: T @ se3_exp(share * k * drift) for k, (s, T) in enumerate(zip(before, truth))}
        slam = make_slam(tiny_sequence, tiny_samples, settings(poses="truth", mapping=FEW))
        slam.tracker = TruePoses(poses.get)
        for sample in before:
            slam.process(sample)
        for k, T in enumerate(truth[:-1]):
            slam.trajectory.replace(k, T)
        slam.tracker = TruePoses(tiny_sequence.true_pose)
        slam.process(last, is_held_out=True)
        assert isinstance(slam.mapper, GaussianMapper)
        views = [slam.mapper.render(tiny_sequence.camera, T).depth for T in truth]
        error = depth_l1_cm(views, [s.depth for s in tiny_samples if s.depth is not None])
        assert error is not None
        return error

    clean, following = depth_error(share=0.0), depth_error()
    monkeypatch.setattr(GaussianMap, "move_with_frames", lambda self, corrections: None)
    staying = depth_error()
    assert following - clean < 0.5 * (staying - clean)


def test_start_image_is_solved_as_often_when_frames_are_dropped(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = make_slam(tiny_sequence, tiny_samples, settings(poses="truth", mapping=FEW | {"max_views": 10}))
    assert isinstance(slam.mapper, GaussianMapper)
    images, solved_at = slam.mapper.images, []

    def solve(*given: Any) -> bool:
        solved_at.append(len(slam.trajectory))
        return EventImages.solve(images, *given)

    monkeypatch.setattr(images, "solve", solve)
    for sample in tiny_samples:
        slam.process(sample, is_held_out=False)
    assert len(images.frames) == 10
    assert solved_at[-2:] == [5, 10]  # of 14 frames


@pytest.mark.parametrize("last", [4, 9])  # the start image is solved after every fifth frame
@pytest.mark.parametrize("held_out", [set(), {6}, {11}])
def test_a_window_may_begin_where_the_start_image_is_solved(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], last: int, held_out: set[int]
) -> None:
    times = [sample.timestamp for sample in tiny_samples]
    stretch = (times[last] + times[last - 1]) / 2 - times[0]
    _, mapper = mapped(tiny_sequence, tiny_samples[:13], held_out, stretch=stretch)
    assert mapper.images.is_solved
    steps = len(mapper.images.frames) - 2  # from the third frame on
    assert mapper.num_steps == FEW["final_iterations"] + steps


def test_faded_gaussians_are_pruned(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    slam, mapper = mapped(tiny_sequence, tiny_samples[:5], finish=False)
    before = mapper.num_gaussians
    logits = mapper.gaussians.raw["logit_opacities"]
    logits.data[:100] = -10.0
    mapper.finish(slam.trajectory, lambda fraction: True)
    assert before - 150 < mapper.num_gaussians <= before - 100


def test_first_frame_and_distant_frames_are_keyframes(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, mapper = mapped(tiny_sequence, tiny_samples, held_out={7})
    indices = [k.index for k in mapper.keyframes]
    assert indices[0] == 0
    assert 2 <= len(indices) < len(tiny_samples) / 2  # 22 cm at a depth of 1.6 m, one every 8 cm
    assert 7 not in indices


# --- computing time ---


def test_without_budget_every_step_is_taken(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, mapper = mapped(tiny_sequence, tiny_samples[:8], iterations=2, final_iterations=7)
    assert mapper.num_steps >= 7 + 2 * 3
    assert mapper.budget.left() == np.inf
    assert mapper.budget.spent > 0


@pytest.mark.slow
def test_budget_leaves_out_steps_and_is_kept_to(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    tick, ticks = 0.01, itertools.count()  # a clock that every look at it moves on: a busy machine, too
    many = FEW | {"iterations": 50, "final_iterations": 5000}
    slam = make_slam(tiny_sequence, tiny_samples, settings(poses="truth", mapping=many))
    mapper = slam.mapper
    assert isinstance(mapper, GaussianMapper)
    mapper.budget = Budget(6.0, clock=lambda: tick * next(ticks))
    for sample in tiny_samples:
        slam.process(sample)
    mapper.finish(slam.trajectory, lambda fraction: True)
    allowed = 6.0 * (slam.trajectory.timestamps[-1] - slam.trajectory.timestamps[0])
    assert 0.5 * allowed < tick * mapper.num_steps < allowed
    assert mapper.budget.spent < allowed + 2 * tick  # the step in progress
    assert corrected_psnr(tiny_sequence.camera, slam, tiny_samples, [3, 8, 12]) > 15


def test_too_small_a_budget_still_gives_a_map(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    _, mapper = mapped(tiny_sequence, tiny_samples[:8], budget=1e-6, iterations=5, final_iterations=500)
    assert mapper.num_gaussians > 2000
    assert mapper.num_steps == 1  # the first final one finds the time is up
    assert mapper.budget.left() < 0


# --- poses ---


def test_bundle_adjustment_moves_tracked_poses_but_not_the_first(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    steps: dict[str, Any] = {"finish": False, "final_iterations": 20}
    slam, mapper = mapped(tiny_sequence, tiny_samples[:6], poses="tracked", **steps)
    before = slam.trajectory.poses
    mapper.finish(slam.trajectory, lambda fraction: True)
    moved = np.linalg.norm(slam.trajectory.poses[:, :3, 3] - before[:, :3, 3], axis=1)
    assert moved[0] == 0  # the gauge
    assert 0 < moved[1:].max() < 0.001  # at most 20 steps of 20 um a coordinate


def test_true_poses_are_not_adjusted(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    slam, _ = mapped(tiny_sequence, tiny_samples[:6], final_iterations=6)
    truth = np.array([s.T_world_camera for s in tiny_samples[:6]])
    assert (slam.trajectory.poses == truth).all()


def test_finish_stops_when_asked_to(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    slam, mapper = mapped(tiny_sequence, tiny_samples[:5], finish=False, final_iterations=1000)
    told: list[float] = []

    def stop_at_third(fraction: float) -> bool:
        told.append(fraction)
        return len(told) < 3

    mapper.finish(slam.trajectory, stop_at_third)
    assert told == pytest.approx([0.001, 0.002, 0.003])


# --- input that fails ---


def test_run_without_any_depth_makes_no_map_and_no_error(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    zeros = np.zeros(tiny_sequence.camera.shape, np.float32)
    _, mapper = mapped(tiny_sequence, [replace(s, depth=zeros) for s in tiny_samples[:6]])
    assert mapper.num_gaussians == 0
    assert mapper.points()[0].shape == (0, 3)
    view = mapper.render(tiny_sequence.camera, np.eye(4))
    assert (view.alpha == 0).all()


def test_depth_image_of_zeros_and_frames_without_depth_are_passed_over(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    zeros = np.zeros(tiny_sequence.camera.shape, np.float32)
    samples = [replace(s, depth=[s.depth, zeros, None][k % 3]) for k, s in enumerate(tiny_samples[:7])]
    _, mapper = mapped(tiny_sequence, samples)
    assert mapper.num_gaussians >= 120 * 80 / 4
    assert np.isfinite(mapper.loss)
