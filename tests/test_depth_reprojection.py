"""Depth of one camera in another: exact on planes, no holes, nothing from behind a nearer surface."""

import cv2
import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.depth_reprojection import DepthReprojection
from edslam_ti.lenses import Lens

KINECT = Lens(  # a Kinect's lens at a quarter of its size
    Camera(160, 144, 126.1, 126.2, 80.1, 83.7),
    "rational",
    (5.3633, 3.35493, -1.08168e-05, -1.43868e-05, 0.163032, 5.69124, 5.13437, 0.887861),
)
T_CAMERA_DEPTH = np.eye(4)
T_CAMERA_DEPTH[:3] = [[1, 0, 0, 0.0857], [0, 0.9914, 0.131, 0.0039], [0, -0.131, 0.9914, 0.0019]]


def plane(rays: np.ndarray, normal: np.ndarray, distance: float) -> np.ndarray:  # [H, W, 2] -> [H, W] m
    """Return the depth of the plane normal . p = distance, 0 where it is behind the camera."""
    facing = rays @ normal[:2] + normal[2]
    return np.where(facing > 0.05, distance / np.maximum(facing, 0.05), 0).astype(np.float32)


def moved(normal: np.ndarray, distance: float, T: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a plane in the frame that T maps to."""
    turned = T[:3, :3] @ normal
    return turned, distance + float(turned @ T[:3, 3])


@pytest.mark.parametrize("size", [(160, 120), (480, 360)], ids=["coarser", "finer"])
def test_planes_and_their_edges_arrive_where_they_are(size: tuple[int, int]) -> None:
    camera = Camera(*size, 0.53 * size[0], 0.53 * size[0], 0.478 * size[0], 0.49 * size[1])
    T = T_CAMERA_DEPTH.copy()
    T[:3, :3] = np.linalg.svd(T[:3, :3])[0] @ np.linalg.svd(T[:3, :3])[2]
    wall, board = (np.array([0.2, 0.1, 1.0]), 2.6), (np.array([-0.1, 0.0, 1.0]), 1.1)

    def scene(rays: np.ndarray, T_here_depth: np.ndarray) -> np.ndarray:
        """Return the depth of a wall and a board in front of it, which ends at x, y = +-0.25 m."""
        far = plane(rays, *moved(*wall, T_here_depth))
        near = plane(rays, *moved(*board, T_here_depth))
        points = np.concatenate([rays, np.ones((*near.shape, 1))], -1) * near[..., None]
        own = (points - T_here_depth[:3, 3]) @ T_here_depth[:3, :3]
        return np.where(np.abs(own[..., :2]).max(-1) < 0.25, near, far)

    drawn = DepthReprojection(KINECT, camera, T)(scene(KINECT.rays, np.eye(4)))
    truth = scene(camera.rays()[..., :2], T)
    valid = drawn > 0
    error = np.abs(drawn - truth)[valid] / truth[valid]
    assert valid.mean() > 0.5
    assert (error < 0.01).mean() > 0.995  # all but the board's outline, which is known to a pixel
    assert (error < 1e-3).mean() > 0.98
    board_inside = cv2.erode((truth < 1.5).astype(np.uint8), np.ones((11, 11))) > 0
    assert board_inside.sum() > 100
    assert valid[board_inside].all()  # no hole
    # The camera sees past the board's side what the Kinect, 9 cm to the right, does not see.
    hidden = (~valid) & (truth > 1.8)
    assert hidden[size[1] // 2].any()


def test_background_does_not_shine_through_holes_of_a_nearer_surface() -> None:
    camera = Camera(160, 120, 85, 85, 79.5, 59.5)
    depth = np.full(KINECT.pinhole.shape, 3.0, np.float32)
    depth[50:100, 50:110] = 1.0
    depth[70, 104:106] = 0.0  # not measured; behind it is wall that the Kinect sees
    T = np.eye(4)
    T[0, 3] = 0.1
    drawn = DepthReprojection(KINECT, camera, T)(depth)
    rows, columns = np.nonzero(np.abs(drawn - 1) < 0.05)
    box = drawn[rows.min() + 3 : rows.max() - 2, columns.min() + 3 : columns.max() - 2]
    assert not (box > 1.5).any()
    assert 0 < (box == 0).sum() < 20
