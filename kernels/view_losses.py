"""Losses of a map's views against measurements of events and depth, with all gradients in one pass.

Each block of pixels is composited, compared and differentiated while its list is still in the cache. No
images are written, alpha is computed once, and the backward pass needs no division and no exp. One
projection, one sort and one launch serve all views.

    two views, Eq. 10-12:  L = s sum (log((I_end + eps) / (I_start + eps)) - measured)^2
    one view:              L = s_e sum (log(I + eps) - target)^2 + s_d sum_{measured > 0} |D - A measured|

with I = sum_i c_i alpha_i T_i + T_end background, D = sum_i d_i alpha_i T_i, A = 1 - T_end (Eq. 8), so that
D - A measured = sum_i (d_i - measured) alpha_i T_i: transparency is no depth error.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.kernels.compositing import (
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    clear,
    fill_slots,
    lane_columns,
    lane_rows,
    list_blocks,
    log_255_alpha,
)
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, exp, lanes, log, sums, sums_of, vector_instructions, zeros
from edslam_ti.kernels.projection import (
    BLOCK,
    FEATURES,
    LOW_PASS,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    by_sums,
    project,
    project_backward,
)
from edslam_ti.kernels.rasterization import (
    TILE,
    Workspace,
    check_gaussians,
    check_tile,
    from_blocks,
    rasterize,
    to_blocks,
)
from edslam_ti.kernels.runtime import CHUNK, check_shape, is_gpu, plain
from edslam_ti.kernels.tile_lists import list_pairs

ALPHA, WEIGHT = 0, 1  # the two numbers kept for every record that a block draws


@ti.func
def composite(
    record: ti.template(), items: ti.template(), space, block, number, x, y, is_inside, kept: ti.template()
):
    """T_end, intensity and depth of a block; keeps alpha and weight of each record that it draws."""
    T = ti.select(is_inside, 1.0, 0.0)
    intensity, depth = T * 0.0, T * 0.0
    for n in range(number):
        at = space * items.shape[2] + items[space, block, n]
        inside = log_255_alpha(record, at, x - record[at, MEAN_X], y - record[at, MEAN_Y])
        raw = MIN_ALPHA * exp(inside)
        is_drawn = (inside >= 0.0) & (T > MIN_TRANSMITTANCE)
        alpha = ti.select(is_drawn, ti.select(raw < MAX_ALPHA, raw, MAX_ALPHA), 0.0)
        weight = alpha * T
        depth += weight * record[at, FEATURES]
        intensity += weight * record[at, FEATURES + 1]
        T = T - weight
        kept[space, n, ALPHA], kept[space, n, WEIGHT] = alpha, weight
    return T, intensity, depth


@ti.func
def differentiate_block(
    record: ti.template(), items: ti.template(), space, block, number, x, y, kept: ti.template(),
    grad_intensity, grad_depth, target_depth, background,
    near_grad: ti.template(),
):  # fmt: skip
    """Add to the gradients of the records; see `kernels.rasterization.draw_backward`."""
    behind = background * grad_intensity
    for from_end in range(number):
        n = number - 1 - from_end
        at = space * items.shape[2] + items[space, block, n]
        alpha, weight = kept[space, n, ALPHA], kept[space, n, WEIGHT]
        q = record[at, FEATURES + 1] * grad_intensity - behind
        q += (record[at, FEATURES] - target_depth) * grad_depth
        behind += alpha * q
        v = ti.select(alpha < MAX_ALPHA, weight * q, 0.0)  # min() has no gradient where it clips
        dx, dy = x - record[at, MEAN_X], y - record[at, MEAN_Y]
        v_x, v_y = v * dx, v * dy
        total = sums_of(
            v, v_x, v_y, v_x * dx, v_x * dy, v_y * dy, weight * grad_depth, weight * grad_intensity
        )
        near_grad[at, 0] = near_grad[at, 0] + total


@vector_instructions
@ti.kernel
def _compare_views(
    # inputs
    records: sums(2),  # [V * padded, record_size / SUMS]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [V * tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    background: float,
    epsilon: float,
    target: lanes(1),  # [blocks] log brightness, or its change between two views
    target_depth: lanes(1),  # [blocks] metres, 0 = missing
    scale: float,  # s, s_e
    depth_scale: float,  # s_d
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    # scratch by worker and view; the first two are the same memory
    near: sums(2),  # [workers * V * longest, record_size / SUMS]
    near_record: ti.types.ndarray(ndim=2),  # [workers * V * longest, record_size]
    near_grad: sums(2),  # [workers * V * longest, 1]
    number: ti.types.ndarray(ti.i32, ndim=2),  # [workers * V, blocks of a tile]
    items: ti.types.ndarray(ti.i32, ndim=3),  # [workers * V, blocks of a tile, longest]
    kept: lanes(3),  # [workers * V, longest, 2]
    brightness: lanes(1),  # [workers * V]
    # outputs
    difference: lanes(1),  # [blocks] rendered minus target
    tile_losses: ti.types.ndarray(ndim=2),  # [tiles, 2] sums of squares, and of depth errors
    slot_grad: sums(2),  # [P, 1]
    V: ti.i32,
):
    columns, across, tiles = (width + tile - 1) // tile, tile // BLOCK, tile_losses.shape[0]
    longest = items.shape[2]
    for chunk in range(number.shape[0] // V * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            t = ti.atomic_add(next_tile[0], 1)
            while t < tiles:
                column, row = t % columns * across, t // columns * across
                for v in range(V):
                    first, past = tile_start[v * tiles + t], tile_start[v * tiles + t + 1]
                    list_blocks(
                        records, pairs, first, past, column, row, across, w * V + v,
                        near, near_record, number, items, 1,
                    )  # fmt: skip
                    clear(near_grad, (w * V + v) * longest, past - first, 1)
                squares, errors = 0.0, 0.0
                for block in range(across * across):
                    x = (column + block % across) * BLOCK + lane_columns()
                    y = (row + block // across) * BLOCK + lane_rows()
                    is_inside = (x < width) & (y < height)
                    i, space = t * across * across + block, w * V
                    depth_error = zeros()
                    for v in range(V):
                        T, intensity, depth = composite(
                            near_record, items, space + v, block, number[space + v, block], x, y, is_inside,
                            kept,
                        )  # fmt: skip
                        brightness[space + v] = intensity + T * background + epsilon
                        depth_error = depth - (1.0 - T) * target_depth[i]
                    ratio = brightness[space + V - 1]
                    if V == 2:
                        ratio = ratio / brightness[space]
                    r = ti.select(is_inside, log(ratio) - target[i], 0.0)
                    difference[i] = r
                    squares += (r * r).sum()
                    sign = ti.select(depth_error > 0.0, 1.0, -1.0)
                    sign = ti.select(is_inside & (target_depth[i] > 0.0), sign, 0.0)
                    errors += (depth_error * sign).sum()
                    for v in range(V):
                        slope = ti.select(v == V - 1, 2.0 * scale, -2.0 * scale) * r
                        differentiate_block(
                            near_record, items, space + v, block, number[space + v, block], x, y, kept,
                            slope / brightness[space + v], depth_scale * sign, target_depth[i], background,
                            near_grad,
                        )  # fmt: skip
                tile_losses[t, 0], tile_losses[t, 1] = squares, errors
                for v in range(V):
                    first, past = tile_start[v * tiles + t], tile_start[v * tiles + t + 1]
                    fill_slots(near_grad, (w * V + v) * longest, pairs, first, past, slot_grad, 1)
                t = ti.atomic_add(next_tile[0], 1)


@dataclass(frozen=True)
class Comparison:
    """Differences of a map's views from the measurements; only `loss` is differentiable."""

    loss: Tensor  # scalar
    difference: Tensor  # [H, W] log brightness, or its change, minus the target


class _CompareViews(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, means, quats, scales, opacities, colors, poses, intrinsics, size, target, target_depth,
        weights, background, epsilon, low_pass, tile,
    ):  # fmt: skip
        num_views = len(poses)
        projection = project(
            means, quats, scales, opacities, colors, plain("poses", poses), intrinsics, size, tile, low_pass
        )
        lists = list_pairs(projection, size, tile)
        space = Workspace.of(projection, lists, num_views)
        tiles = (len(lists.start) - 1) // num_views
        record = projection.record
        targets = to_blocks(torch.stack([plain("target", target), plain("depth", target_depth)]), tile)
        difference = torch.empty_like(targets[0])
        losses = record.new_empty(tiles, 2)
        slot_grad = lists.new_slots(projection)
        _compare_views(
            by_sums(record), lists.start, lists.pairs, *size, tile, background, epsilon,
            targets[0], targets[1], *weights, torch.zeros(1, dtype=torch.int32),
            by_sums(space.near), space.near, by_sums(space.near_grad), space.number, space.items,
            record.new_empty(len(space.items), space.items.shape[2], 2, LANES),
            record.new_empty(len(space.items), LANES),
            difference, losses, by_sums(slot_grad), num_views,
        )  # fmt: skip
        ctx.gradients, ctx.grad_poses = project_backward(projection, slot_grad)
        squares, errors = losses.sum(0, dtype=torch.float64).tolist()
        outputs = (
            means.new_tensor(weights[0] * squares + weights[1] * errors),
            from_blocks(difference[None], size, tile)[0],
        )
        ctx.mark_non_differentiable(outputs[1])
        return outputs

    @staticmethod
    def backward(ctx, grad_loss, _difference):
        factor = float(grad_loss)
        if factor != 1:
            ctx.gradients = [gradient * factor for gradient in ctx.gradients]
        return *ctx.gradients, ctx.grad_poses * factor, *[None] * 9


def compare_change(
    means: Tensor,  # [N, 3] metres, world frame
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] metres
    opacities: Tensor,  # [N] in (0, 1)
    colors: Tensor,  # [N, 1] brightness
    T_camera_world: Tensor,  # [2, 4, 4] at the start and at the end
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],  # (width, height)
    measured: Tensor,  # [H, W] change of log brightness, Eq. 11
    background: float,  # brightness behind everything
    epsilon: float,
    scale: float,  # of the sum of squares
    low_pass: float = LOW_PASS,
    tile: int = TILE,
    pixelwise: bool | None = None,  # render a pixel per thread and compare in torch; None: on a GPU
) -> Comparison:
    """Return `scale` times the squared error of the brightness change between two views, Eq. 10-12."""
    check_shape("T_camera_world", T_camera_world, (2, 4, 4))
    return _compare(
        means, quats, scales, opacities, colors, T_camera_world, intrinsics, size,
        measured, torch.zeros_like(measured), (scale, 0.0), background, epsilon, low_pass, tile, pixelwise,
    )  # fmt: skip


def compare_view(
    means: Tensor,  # [N, 3] metres, world frame
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] metres
    opacities: Tensor,  # [N] in (0, 1)
    colors: Tensor,  # [N, 1] brightness
    T_camera_world: Tensor,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],  # (width, height)
    log_brightness: Tensor,  # [H, W] target
    depth: Tensor,  # [H, W] target, metres, 0 = missing
    background: float,  # brightness behind everything
    epsilon: float,
    scale: float,  # of the sum of squares
    depth_scale: float,  # of the sum of absolute depth errors, each weighted by alpha
    low_pass: float = LOW_PASS,
    tile: int = TILE,
    pixelwise: bool | None = None,  # render a pixel per thread and compare in torch; None: on a GPU
) -> Comparison:
    """Return the loss of a view against a target: squared brightness error and absolute depth error."""
    check_shape("T_camera_world", T_camera_world, (4, 4))
    return _compare(
        means, quats, scales, opacities, colors, T_camera_world[None], intrinsics, size,
        log_brightness, depth, (scale, depth_scale), background, epsilon, low_pass, tile, pixelwise,
    )  # fmt: skip


def _compare(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, poses: Tensor,
    intrinsics: tuple[float, float, float, float], size: tuple[int, int],
    target: Tensor, target_depth: Tensor, weights: tuple[float, float],
    background: float, epsilon: float, low_pass: float, tile: int, pixelwise: bool | None,
) -> Comparison:  # fmt: skip
    check_gaussians(means, quats, scales, opacities, colors)
    check_shape("colors", colors, (len(means), 1))
    check_shape("target", target, (size[1], size[0]))
    check_shape("depth", target_depth, (size[1], size[0]))
    check_tile(tile, size)
    if is_gpu() if pixelwise is None else pixelwise:
        return _compare_rendered(
            (means, quats, scales, opacities, colors), poses, intrinsics, size,
            target, target_depth, weights, background, epsilon, low_pass,
        )  # fmt: skip
    outputs = _CompareViews.apply(
        means, quats, scales, opacities, colors, poses, tuple(intrinsics), tuple(size),
        target, target_depth, weights, background, epsilon, low_pass, tile,
    )  # fmt: skip
    return Comparison(*outputs)


def _compare_rendered(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor], poses: Tensor,
    intrinsics: tuple[float, float, float, float], size: tuple[int, int],
    target: Tensor, target_depth: Tensor, weights: tuple[float, float],
    background: float, epsilon: float, low_pass: float,
) -> Comparison:  # fmt: skip
    views = [
        rasterize(*gaussians, pose, intrinsics, size, low_pass=low_pass, pixelwise=True) for pose in poses
    ]
    logs = [torch.log(view.image[..., 0] + (1 - view.alpha) * background + epsilon) for view in views]
    difference = (logs[0] if len(logs) == 1 else logs[1] - logs[0]) - target
    loss = weights[0] * difference.square().sum()
    if len(views) == 1:
        error = (views[0].depth - views[0].alpha * target_depth).abs()
        loss = loss + weights[1] * torch.where(target_depth > 0, error, 0).sum()
    return Comparison(loss, difference.detach())
