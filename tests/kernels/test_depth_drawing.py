"""Depth drawn into another camera, against its twin."""

import numpy as np
import pytest

from edslam_ti.kernels import depth_drawing, reference_depth


@pytest.mark.parametrize("focal", [9.0, 30.0], ids=["coarser", "finer"])
def test_drawn_depth_matches_the_twin(focal: float) -> None:
    random = np.random.default_rng(2)
    height, width = 9, 11
    v, u = np.mgrid[0:height, 0:width]
    rays = np.stack([(u - 5.2) / 14, (v - 4.1) / 14], -1).astype(np.float32)
    rays[0, 0] = np.nan
    depth = (2 + 0.02 * u + 0.03 * v).astype(np.float32)
    depth[3:6, 4:7] = 1.2
    depth[random.random(depth.shape) < 0.08] = 0
    T = np.eye(4)
    T[:3, 3] = 0.11, -0.04, 0.02
    angle = 0.1
    T[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    arguments = (depth, rays, T, (focal, focal, 7.3, 6.2), (13, 15), 0.05, 0.04)
    drawn, expected = depth_drawing.draw_depth(*arguments), reference_depth.draw_depth(*arguments)
    assert (expected > 0).sum() > 10
    assert (drawn > 0).sum() == (expected > 0).sum()
    np.testing.assert_allclose(drawn, expected, atol=1e-4)
