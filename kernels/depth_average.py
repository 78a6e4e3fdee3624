"""Averages a depth image with others that measured the same surfaces from other poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, lanes, vector_instructions, zeros
from edslam_ti.kernels.patch_warp import Patches
from edslam_ti.kernels.runtime import check_shape


@vector_instructions
@ti.kernel
def _average_depth(
    # inputs
    points: lanes(2),  # [blocks, 4] X, Y, Z (metres, 0 = missing) and an unused value
    others: ti.types.ndarray(ndim=1),  # [K H W] metres, 0 = missing
    height: ti.i32,
    width: ti.i32,
    transforms: ti.types.ndarray(ndim=2),  # [K, 12] rows of T_other_camera
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sigma: float,  # metres
    sigma_2: float,  # 1/m
    num_sigmas: float,
    share: float,  # of the depth
    # outputs
    average: lanes(1),  # [blocks] metres
):
    for block in range(points.shape[0]):
        last_column, last_row = float(width - 1), float(height - 1)
        X, Y, Z = points[block, 0], points[block, 1], points[block, 2]
        gate = ti.min(num_sigmas * (sigma + sigma_2 * Z * Z), share * Z)
        total, count = Z, zeros() + 1.0
        for k in range(transforms.shape[0]):
            T = [transforms[k, i] for i in range(12)]
            along = T[8] * X + T[9] * Y + T[10] * Z
            z = along + T[11]
            inv_z = 1.0 / ti.max(z, NEAR)
            x = fx * (T[0] * X + T[1] * Y + T[2] * Z + T[3]) * inv_z + cx
            y = fy * (T[4] * X + T[5] * Y + T[6] * Z + T[7]) * inv_z + cy
            inside = (Z > 0) & (z > NEAR) & (x >= 0) & (x < last_column) & (y >= 0) & (y < last_row)
            x, y = ti.select(inside, x, 0.0), ti.select(inside, y, 0.0)
            column, row = ti.floor(x), ti.floor(y)
            corner = [zeros() for _ in range(4)]
            pixel = row * float(width) + column  # exact below 2^24
            for lane in ti.static(range(LANES)):
                above = k * height * width + ti.cast(pixel[lane], ti.i32)
                place = [above, above + 1, above + width, above + width + 1]
                for i in ti.static(range(4)):
                    corner[i][lane] = others[place[i]]
            right, down = x - column, y - row
            upper = corner[0] + right * (corner[1] - corner[0])
            lower = corner[2] + right * (corner[3] - corner[2])
            # the same surface, measured along this camera's ray
            further = (upper + down * (lower - upper) - z) * Z / ti.select(inside, along, 1.0)
            agrees = inside & (further < gate) & (further > 0.0 - gate)
            total += ti.select(agrees, Z + further, 0.0)
            count += ti.select(agrees, 1.0, 0.0)
        average[block] = total / count


class PixelRays:
    """The rays of a camera's pixels, in lanes."""

    def __init__(self, shape: tuple[int, int], intrinsics: tuple[float, float, float, float]) -> None:
        v, u = np.indices(shape).reshape(2, -1)
        pixels = np.stack([u, v, np.ones_like(u)], -1).astype(np.float32)  # at a depth of 1 m
        self.intrinsics = intrinsics
        self._rays = Patches(pixels, np.zeros(len(u), np.float32)).points(intrinsics)

    def points(self, depth: np.ndarray) -> torch.Tensor:  # [H, W] metres -> [blocks, 4, LANES]
        """Return all pixels of a depth image as points in the camera's frame, like `Patches.points`."""
        points = torch.empty_like(self._rays)
        z = np.zeros((len(points), 1, LANES), points.numpy().dtype)
        z.reshape(-1)[: depth.size] = depth.reshape(-1)
        np.multiply(self._rays.numpy(), z, out=points.numpy())  # torch would wake up other cores
        return points


@dataclass(frozen=True)
class DepthAgreement:
    """How far measurements of one surface may differ."""

    sigma: float  # metres: the noise's standard deviation is sigma + sigma_2 z^2
    sigma_2: float  # 1/m
    num_sigmas: float = 4.0
    share: float = 0.05  # of the depth; an upper limit


def average_depth(
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    others: Sequence[np.ndarray],  # K times [H, W] metres, 0 = missing
    poses: Sequence[np.ndarray],  # K times [4, 4] T_other_camera
    rays: PixelRays,  # of the camera of all these images
    agreement: DepthAgreement,
) -> np.ndarray:  # [H, W] metres, 0 = missing
    """Return a depth image averaged along its rays with the other images where they agree."""
    for other in others:
        check_shape("others", other, depth.shape)
    if len(others) == 0:
        return depth.copy()
    height, width = depth.shape
    points = rays.points(depth)
    dtype = points.numpy().dtype
    average = torch.empty(len(points), LANES, dtype=points.dtype)
    _average_depth(
        points, np.stack(others).astype(dtype, copy=False).reshape(-1), height, width,
        np.array(poses)[:, :3].reshape(-1, 12).astype(dtype), *rays.intrinsics,
        agreement.sigma, agreement.sigma_2, agreement.num_sigmas, agreement.share, average,
    )  # fmt: skip
    return average.numpy().reshape(-1)[: depth.size].reshape(depth.shape)


def compile_kernels() -> None:
    """Compile the averaging kernels, so that the first frames of a sequence do not wait for it."""
    image, rays = np.zeros((1, 1), np.float32), PixelRays((1, 1), (1.0, 1.0, 0.0, 0.0))
    average_depth(image, [image], [np.eye(4)], rays, DepthAgreement(1.0, 1.0))
