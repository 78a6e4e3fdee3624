"""Depth images: reduced without mixing surfaces, holes filled, edges found."""

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.depth_images import (
    beside_edges,
    beside_steps,
    block_depth,
    block_means,
    downscaled,
    downscaled_depth,
    is_smooth,
    measured_means,
    with_gaps_filled,
    with_holes_filled,
    without_depth_edges,
)


def test_steps_are_found_on_both_sides_and_not_on_a_slanted_plane() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    plane = (-2.0 / (camera.rays() @ np.array([0.8, 0.0, -0.6]))).astype(np.float32)  # 1.7 to 10 m away
    assert not beside_steps(plane).any()
    step = np.full(camera.shape, 2.0, np.float32)
    step[20:, 30:] = 2.1
    expected = np.zeros(camera.shape, bool)
    expected[20:, 29:31] = expected[19:21, 30:] = True
    assert (beside_steps(step) == expected).all()


def test_large_holes_are_filled_behind_their_surroundings_and_narrow_ones_stay() -> None:
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, 40:] = 3.0
    depth[10:40, 30:60] = 0  # a window
    depth[50, :] = 0  # a line that the sensor missed
    filled = with_holes_filled(depth)
    assert filled[10:40, 30:60] == pytest.approx(1.25 * 3.0)
    assert (filled[50] == 0).all()
    measured = depth > 0
    assert (filled[measured] == depth[measured]).all()
    assert (with_holes_filled(np.zeros_like(depth)) == 0).all()  # nothing to go by


def test_both_sides_of_a_depth_step_are_left_out() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 1.5
    depth[2, 1] = 0
    kept = without_depth_edges(depth)
    expected = depth.copy()
    expected[:, 3:5] = 0
    assert np.array_equal(kept[[0, 5]], expected[[0, 5]])
    assert np.array_equal(kept[:, 5:], depth[:, 5:])
    slanted = np.tile(np.linspace(1.0, 1.3, 8, dtype=np.float32), (6, 1))  # 4 % a pixel
    assert np.array_equal(without_depth_edges(slanted), slanted)


def test_block_means_cut_odd_edges() -> None:
    image = np.arange(15, dtype=np.float32).reshape(3, 5)
    np.testing.assert_array_equal(block_means(image, 2), [[3.0, 5.0]])
    assert block_means(image, 1) is image


def mixed_blocks() -> np.ndarray:
    """Return blocks of 2 x 2 depths: a plane, a hole, an edge, and a slant of 4 %."""
    depth = np.full((2, 8), 2.0, np.float32)
    depth[0, 2] = 0
    depth[1, 5] = 2.2
    depth[0, 6] = 2.08
    return depth


def test_depth_is_reduced_only_where_a_block_lies_on_one_surface() -> None:
    for reduced in (downscaled_depth(mixed_blocks()), block_depth(mixed_blocks(), 2)):
        np.testing.assert_allclose(reduced, [[2.0, 0.0, 0.0, 2.02]], rtol=1e-6)
    assert block_depth(mixed_blocks(), 1)[0, 2] == 0


def test_images_are_halved_to_the_means_of_blocks() -> None:
    image = np.random.default_rng(0).random((6, 9)).astype(np.float32)
    np.testing.assert_allclose(downscaled(image), block_means(image, 2), rtol=1e-6)
    assert downscaled(image).dtype == np.float32


def test_slants_are_smooth_but_steps_and_holes_are_not() -> None:
    before, depth, after = np.array([[1.9, 2.0, 0.0, 2.0], [2.0] * 4, [2.1, 2.1, 2.0, 2.01]])
    assert is_smooth(before, depth, after).tolist() == [True, False, False, True]


def test_edges_are_the_pixels_on_both_sides_of_a_step() -> None:
    depth = np.array([[2.0, 2.0, 2.1, 2.1, 0.0]])
    assert beside_edges(depth, 0.04).tolist() == [[False, True, True, True, True]]
    assert beside_edges(depth, 0.06).tolist() == [[False, False, False, True, True]]


def room(camera: Camera) -> np.ndarray:
    """Return depth of a slanted wall with a box before it and a window in it."""
    depth = (-2.0 / (camera.rays() @ np.array([0.6, 0.2, -0.77]))).astype(np.float32)
    depth[30:60, 20:50] = 1.2
    depth[60:100, 90:140] = 0
    return depth


ROWS, COLUMNS = np.mgrid[:120, :160]
PATTERNS = {
    "every second row": ROWS % 2 == 0,
    "every eighth row": ROWS % 8 == 0,
    "every fourth column": COLUMNS % 4 == 0,
    "grid": (ROWS % 4 == 0) & (COLUMNS % 4 == 0),
    "irregular rows": np.isin(
        ROWS, [3, 5, 11, 18, 21, 27, 34, 38, 45, 51, 58, 62, 69, 75, 80, 86, 93, 99, 110]
    ),
    "random half": np.random.default_rng(0).random(ROWS.shape) < 0.5,
    "random fifth": np.random.default_rng(1).random(ROWS.shape) < 0.2,
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_gaps_of_sparse_depth_are_filled_on_surfaces_and_nowhere_else(pattern: str) -> None:
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    true, is_measured = room(camera), PATTERNS[pattern]
    depth = np.where(is_measured, true, np.float32(0))
    filled = with_gaps_filled(depth)
    assert filled.dtype == np.float32
    assert (filled[is_measured] == depth[is_measured])[depth[is_measured] > 0].all()
    is_filled = filled > 0
    # Planes are linear in inverse depth; beside an outline a pixel may be on either side.
    on_wall = is_filled & (true > 0)
    assert (np.abs(filled - true)[on_wall] < 1e-4).mean() > 0.98
    assert not (is_filled & (filled > 1.25) & (filled < 0.9 * true)).any()  # nothing hangs in the air
    assert is_filled[true > 0].mean() > 0.75
    assert not is_filled[70:90, 102:128].any()  # the window


def test_dense_depth_is_not_touched() -> None:
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    depth = room(camera)
    depth[np.random.default_rng(0).random(depth.shape) < 0.02] = 0  # as sensors lose single pixels
    assert with_gaps_filled(depth) is depth
    nothing = np.zeros_like(depth)
    assert with_gaps_filled(nothing) is nothing


@pytest.mark.parametrize("number", [1, 2, 40])
def test_a_few_pixels_alone_are_not_joined(number: int) -> None:
    depth = np.zeros((60, 80), np.float32)
    chosen = np.random.default_rng(0).choice(depth.size, number, replace=False)
    depth.ravel()[chosen] = np.linspace(1, 5, number)
    filled = with_gaps_filled(depth)
    assert (filled > 0).sum() < 60 + number
    assert (filled[depth > 0] == depth[depth > 0]).all()


def test_means_of_partly_measured_blocks_stay_on_their_surface() -> None:
    depth = np.full((4, 8), 2.0, np.float32)
    depth[0] = 0  # a line that the sensor missed
    depth[:2, 2:4] = 0  # nothing in a block
    depth[3, 5] = 3.0  # two surfaces in a block
    depth[2, 6] = 2.02
    expected = np.array([[2, 0, 2, 2], [2, 2, 0, 2.005]])
    np.testing.assert_allclose(measured_means(depth, 2), expected, rtol=1e-6)
    np.testing.assert_array_equal(measured_means(depth, 1), depth)
