"""Rendering on a GPU: one thread per Gaussian for projection, then one per pixel for compositing.

The functions are those of the CPU path (kernels.projection, kernels.compositing), applied to scalars instead
of vectors. A thread traverses its tile's whole list, and adds to the slots of gradients atomically, so sums
may differ in their last bits from run to run. torch sorts and computes prefix sums on the device. The number
of (Gaussian, tile) pairs is read back once per view, to allocate their lists.
"""

import torch
from torch import Tensor

from edslam_ti.kernels.compositing import draw, draw_backward
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES
from edslam_ti.kernels.projection import (
    BLOCK,
    COLOR,
    EXTENT,
    FEATURES,
    HALF_K_XX,
    HALF_K_YY,
    K_XY,
    MEAN,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    NEAR,
    NOT_DRAWN,
    OPACITY,
    QUAT,
    SCALE,
    Projection,
    differentiate,
    ellipses,
    first_and_last,
    gradient_size,
    is_near_image,
    record_size,
    unpack_tiles,
)
from edslam_ti.kernels.runtime import plain
from edslam_ti.kernels.tile_lists import TileLists

TILE = 16  # pixels


@ti.kernel
def _project(
    # inputs
    gaussians: ti.types.ndarray(ndim=2),  # [COLOR + C, N]
    poses: ti.types.ndarray(ndim=3),  # [V, 4, 4] T_camera_world
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    low_pass: float,  # px^2
    # outputs
    record: ti.types.ndarray(ndim=2),  # [V N, record_size(C)], without blocks
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [V N] sorts as the depth, NOT_DRAWN where culled
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [V N]
    num_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [V N]
    C: ti.template(),
):
    for g in range(record.shape[0]):
        v, i = g // gaussians.shape[1], g % gaussians.shape[1]
        mean_x, mean_y, z, cov_xx, cov_xy, cov_yy = ellipses(gaussians, i, poses, v, fx, fy, cx, cy, low_pass)
        extent = ti.log(gaussians[OPACITY, i] / MIN_ALPHA)
        det = cov_xx * cov_yy - cov_xy * cov_xy
        num_tiles[g] = 0
        depth_bits[g] = NOT_DRAWN
        is_near = is_near_image(mean_x, mean_y, width, height)
        if (z > NEAR) & is_near & (extent > 0.0) & (det > 0.0):
            half_width, half_height = ti.sqrt(2.0 * extent * cov_xx), ti.sqrt(2.0 * extent * cov_yy)
            left, right = first_and_last(mean_x - half_width, mean_x + half_width, width)
            top, bottom = first_and_last(mean_y - half_height, mean_y + half_height, height)
            if (left <= right) & (top <= bottom):
                record[g, MEAN_X], record[g, MEAN_Y] = mean_x, mean_y
                record[g, HALF_K_XX], record[g, K_XY] = 0.5 * cov_yy / det, -cov_xy / det
                record[g, HALF_K_YY], record[g, EXTENT] = 0.5 * cov_xx / det, extent
                record[g, FEATURES] = z
                for k in ti.static(range(C)):
                    record[g, FEATURES + 1 + k] = gaussians[COLOR + k, i]
                l, r = ti.cast(left, ti.i32) // tile, ti.cast(right, ti.i32) // tile
                t, b = ti.cast(top, ti.i32) // tile, ti.cast(bottom, ti.i32) // tile
                packed_tiles[g] = l << 24 | r << 16 | t << 8 | b
                num_tiles[g] = (r - l + 1) * (b - t + 1)
                depth_bits[g] = ti.bit_cast(ti.cast(z, ti.f32), ti.i32)  # positive floats sort as integers


@ti.kernel
def _name_slots(
    # inputs
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [V N]
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [V N]
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [V N + 1]
    count: ti.i32,  # Gaussians of a view
    columns: ti.i32,  # of tiles
    tiles: ti.i32,  # of a view
    # outputs
    keys: ti.types.ndarray(ti.i64, ndim=1),  # [P] tile, and then depth
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [P]
):
    for g in range(depth_bits.shape[0]):
        s, past = first_slot[g], first_slot[g + 1]
        if past > s:
            left, right, top, bottom = unpack_tiles(packed_tiles[g])
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    t = g // count * tiles + row * columns + column
                    keys[s] = (ti.cast(t, ti.i64) << 32) | ti.cast(depth_bits[g], ti.i64)
                    gaussian[s] = g
                    s += 1


@ti.func
def position(i, tile, columns):
    """Pixel x, y and tile of index i in images that are stored by blocks of tiles."""
    across = tile // BLOCK
    t, block, lane = i // (tile * tile), i % (tile * tile) // LANES, i % LANES
    x = t % columns * tile + block % across * BLOCK + lane % BLOCK
    y = t // columns * tile + block // across * BLOCK + lane // BLOCK
    return x, y, t


@ti.kernel
def _draw(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, record_size(C)]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    # outputs, all by blocks
    values: ti.types.ndarray(ndim=2),  # [1 + C, pixels] depth and colours
    transmittance: ti.types.ndarray(ndim=1),  # [pixels]
    last: ti.types.ndarray(ti.i32, ndim=1),  # [pixels] last one of the tile's list that was drawn, -1: none
    front: ti.types.ndarray(ti.i32, ndim=1),  # [pixels] Gaussian at which T falls below 0.5, -1: none
    visible: ti.types.ndarray(ti.u8, ndim=1),  # [N] zeros in, 1 where drawn at T > 0.5
    C: ti.template(),
):
    for i in range(transmittance.shape[0]):
        x, y, t = position(i, tile, (width + tile - 1) // tile)
        first = tile_start[t]
        draw(
            record, pairs, first, tile_start[t + 1] - first, pairs, 0, 0,
            x, y, (x < width) & (y < height), i,
            values, transmittance, last, front, visible, C, False,
        )  # fmt: skip


@ti.kernel
def _draw_backward(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, record_size(C)]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot
    width: ti.i32,
    tile: ti.i32,
    transmittance: ti.types.ndarray(ndim=1),  # [pixels] final T of the forward pass
    last: ti.types.ndarray(ti.i32, ndim=1),  # [pixels]
    grad_values: ti.types.ndarray(ndim=2),  # [1 + C, pixels]
    grad_alpha: ti.types.ndarray(ndim=1),  # [pixels]
    # outputs
    slot_grad: ti.types.ndarray(ndim=2),  # [P, gradient_size(C)], zeros in
    C: ti.template(),
):
    for i in range(transmittance.shape[0]):
        x, y, t = position(i, tile, (width + tile - 1) // tile)
        first = tile_start[t]
        draw_backward(
            record, pairs, first, tile_start[t + 1] - first, pairs, 0, 0, x, y, i,
            transmittance, last, grad_values, grad_alpha, slot_grad, C, False,
        )  # fmt: skip


@ti.kernel
def _project_backward(
    # inputs
    gaussians: ti.types.ndarray(ndim=2),  # [COLOR + C, N]
    poses: ti.types.ndarray(ndim=3),  # [V, 4, 4]
    fx: float,
    fy: float,
    low_pass: float,
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [V N + 1]
    slot_grad: ti.types.ndarray(ndim=2),  # [P, gradient_size(C)]
    # scratch
    gradient_2d: ti.types.ndarray(ndim=2),  # [gradient_size(C) + 1, V N]
    # outputs
    gradient: ti.types.ndarray(ndim=2),  # [COLOR + C, N]
    pose_parts: ti.types.ndarray(ndim=3),  # [V, N, 12] rows of [dR | dt], zeros in, to be summed
    C: ti.template(),
):
    for g in range(gradient_2d.shape[1]):
        for k in ti.static(range(gradient_size(C))):
            total = 0.0
            for s in range(first_slot[g], first_slot[g + 1]):
                total += slot_grad[s, k]
            gradient_2d[k, g] = total
        gradient_2d[ti.static(gradient_size(C)), g] = ti.select(first_slot[g + 1] > first_slot[g], 1.0, 0.0)
    for i in range(gaussians.shape[1]):
        differentiate(gaussians, i, poses, fx, fy, low_pass, gradient_2d, gradient, pose_parts, i, C)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, poses: Tensor,
    intrinsics: tuple[float, float, float, float], size: tuple[int, int], tile: int, low_pass: float,
) -> Projection:  # fmt: skip
    """Do the same as `kernels.projection.project`, except for the blocks that a Gaussian touches."""
    channels, count, device = colors.shape[1], len(means), means.device
    tables = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities[:, None],
        "colors": colors,
    }
    gaussians = torch.cat([plain(name, table).T for name, table in tables.items()]).contiguous()
    n = len(poses) * count
    record = gaussians.new_empty(n, record_size(channels))
    depth_bits, packed_tiles, num_tiles = torch.empty(3, n, dtype=torch.int32, device=device)
    _project(
        gaussians, poses, *intrinsics, *size, tile, low_pass,
        record, depth_bits, packed_tiles, num_tiles, channels,
    )  # fmt: skip
    first_slot = torch.zeros(n + 1, dtype=torch.int32, device=device)
    torch.cumsum(num_tiles, 0, dtype=torch.int32, out=first_slot[1:])
    return Projection(
        count, gaussians, poses, intrinsics, low_pass, record, depth_bits, packed_tiles, first_slot
    )


def list_pairs(projection: Projection, size: tuple[int, int], tile: int) -> TileLists:
    """Do the same as `kernels.tile_lists.list_pairs`."""
    columns, rows = (-(-pixels // tile) for pixels in size)
    num_pairs, device = int(projection.first_slot[-1]), projection.record.device
    keys = torch.empty(num_pairs, dtype=torch.int64, device=device)
    gaussian = torch.empty(num_pairs, dtype=torch.int32, device=device)
    _name_slots(
        projection.depth_bits, projection.packed_tiles, projection.first_slot,
        max(projection.padded, 1), columns, columns * rows, keys, gaussian,
    )  # fmt: skip
    keys, slots = torch.sort(keys, stable=True)
    lists = torch.arange(len(projection.poses) * columns * rows + 1, device=device)
    start = torch.searchsorted(keys, lists << 32).int()
    pairs = torch.stack([gaussian[slots], slots.int()], 1)
    return TileLists(tile, start, pairs, 0)


def draw_lists(
    projection: Projection, lists: TileLists, size: tuple[int, int], values: Tensor, transmittance: Tensor,
    last: Tensor, front: Tensor, visible: Tensor,
) -> None:  # fmt: skip
    """Composite all pixels; the images are stored by blocks."""
    _draw(
        projection.record, lists.start, lists.pairs, *size, lists.tile,
        values.view(len(values), -1), transmittance.view(-1), last.view(-1), front.view(-1), visible,
        projection.channels,
    )  # fmt: skip


def draw_lists_backward(
    projection: Projection, lists: TileLists, width: int, transmittance: Tensor, last: Tensor,
    grad_values: Tensor, grad_alpha: Tensor,
) -> Tensor:  # fmt: skip
    """Return the gradients of the records by slot, [P, gradient_size(C)]."""
    slot_grad = torch.zeros_like(lists.new_slots(projection))
    _draw_backward(
        projection.record, lists.start, lists.pairs, width, lists.tile,
        transmittance.view(-1), last.view(-1), grad_values.view(len(grad_values), -1), grad_alpha.view(-1),
        slot_grad, projection.channels,
    )  # fmt: skip
    return slot_grad


def project_backward(projection: Projection, slot_grad: Tensor) -> tuple[list[Tensor], Tensor]:
    """Do the same as `kernels.projection.project_backward`."""
    gaussians, poses = projection.gaussians, projection.poses
    gradient = torch.empty_like(gaussians)
    parts = gaussians.new_zeros(len(poses), projection.count, 12)
    gradient_2d = gaussians.new_empty(slot_grad.shape[1] + 1, len(projection.record))
    fx, fy, _, _ = projection.intrinsics
    _project_backward(
        gaussians, poses, fx, fy, projection.low_pass, projection.first_slot, slot_grad,
        gradient_2d, gradient, parts, projection.channels,
    )  # fmt: skip
    grad_poses = torch.zeros_like(poses)
    grad_poses[:, :3] = parts.sum(1, dtype=torch.float64).view(-1, 3, 4).to(poses.dtype)
    rows = gradient.split(
        [QUAT - MEAN, SCALE - QUAT, OPACITY - SCALE, COLOR - OPACITY, len(gradient) - COLOR]
    )
    means, quats, scales, opacities, colors = (part.T.contiguous() for part in rows)
    return [means, quats, scales, opacities[:, 0], colors], grad_poses
