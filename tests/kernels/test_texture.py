"""Rays, shading and edges against their twins, on random triangles and textures."""

import numpy as np
import pytest

from edslam_ti.kernels import reference_texture, texture
from edslam_ti.kernels.texture import INVALID, TextureTable, TriangleTable

INTRINSICS = (40.0, 42.0, 15.5, 11.5)
RANDOM = np.random.default_rng(5)


def make_textures() -> TextureTable:
    """Return two textures of three levels, the second one tiled, and a light map of one level."""
    sizes = [[(16, 12), (8, 6), (4, 3)], [(8, 16), (4, 8), (2, 4)], [(5, 4)]]
    levels, offset = np.zeros((3, 3, 3), np.int32), 0
    for k, own in enumerate(sizes):
        for level, (width, height) in enumerate(own):
            levels[k, level] = offset, width, height
            offset += width * height
    texels = RANDOM.uniform(0.1, 1, offset).astype(np.float32)
    return TextureTable(texels, levels, np.array([3, 3, 1], np.int32), np.array([0, 1, 0], np.int32))


def make_triangles(count: int = 12) -> TriangleTable:
    values = np.empty((count, 24), np.float32)
    values[:, :6] = RANDOM.uniform(-6, 20, (count, 6))  # also beyond the borders
    values[:, 6:12] = RANDOM.normal(0, 12, (count, 6)) * 10 ** RANDOM.uniform(-1, 1, (count, 1))
    normals = RANDOM.normal(size=(count, 3))
    values[:, 12:15] = normals / np.linalg.norm(normals, axis=1)[:, None]
    values[:, 15:18] = RANDOM.uniform(0.4, 1, (count, 3))
    values[:, 18:24] = RANDOM.uniform(0, 4, (count, 6))
    indices = np.stack(
        [np.arange(count) % 3 - 1, np.where(np.arange(count) % 2, 2, -1), np.arange(count) // 2], -1
    )
    return TriangleTable(values, indices.astype(np.int32))


def test_rays_match_the_twin() -> None:
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(RANDOM.normal(size=(3, 3)))[0]
    T[:3, 3] = RANDOM.normal(size=3)
    pixels = RANDOM.integers(0, 32 * 24, 20).astype(np.int32)
    offsets = RANDOM.uniform(-0.5, 0.5, (4, 2)).astype(np.float32)
    rays = texture.pixel_rays(T, INTRINSICS, 32, pixels, offsets)
    expected = reference_texture.pixel_rays(T, INTRINSICS, 32, pixels, offsets)
    np.testing.assert_allclose(rays, expected, atol=1e-5)


def test_shading_matches_the_twin() -> None:
    count, triangles, textures = 400, make_triangles(), make_textures()
    rays = RANDOM.normal(size=(count, 6)).astype(np.float32)
    distance = RANDOM.uniform(0.5, 4, count).astype(np.float32)
    primitive = RANDOM.integers(0, len(triangles.values), count).astype(np.uint32)
    primitive[::9] = INVALID
    weights = RANDOM.dirichlet([1, 1, 1], count)[:, 1:].astype(np.float32)
    steps = RANDOM.normal(0, 0.02, (2, 3)).astype(np.float32)
    arguments = (rays, distance, primitive, weights, steps, triangles, textures, 0.3)
    grey, surface = texture.shade(*arguments)
    expected, expected_surface = reference_texture.shade(*arguments)
    np.testing.assert_array_equal(surface, expected_surface)
    assert (grey[::9] == np.float32(0.3)).all()
    assert np.ptp(expected) > 0.5
    # A level or a number of look-ups that rounding changes is another average.
    assert (np.abs(grey - expected) > 1e-3).mean() < 0.01


def test_edges_match_the_twin() -> None:
    grey = RANDOM.uniform(0, 1, (12, 17)).astype(np.float32)
    surface = RANDOM.integers(0, 3, (12, 17)).astype(np.int32)
    edges = texture.mark_edges(grey, surface, 0.4)
    np.testing.assert_array_equal(edges, reference_texture.mark_edges(grey, surface, 0.4))
    assert 0.1 < edges.mean() < 0.98


def test_means_of_samples_replace_their_pixels() -> None:
    grey = np.zeros(6, np.float32)
    samples = RANDOM.uniform(0, 1, (2, 4)).astype(np.float32)
    texture.write_sample_means(samples, np.array([4, 1], np.int32), grey)
    np.testing.assert_allclose(grey[[4, 1]], samples.mean(1), rtol=1e-6)
    assert not grey[[0, 2, 3, 5]].any()


def test_tables_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="surface: expected shape"):
        texture.mark_edges(np.zeros((3, 4), np.float32), np.zeros((4, 3), np.int32), 0.1)
