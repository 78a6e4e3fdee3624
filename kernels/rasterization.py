"""Alpha compositing of projected Gaussians (Eq. 8), forward and backward.

    I(x) = sum_i c_i alpha_i T_i,   D(x) = sum_i d_i alpha_i T_i,   A(x) = 1 - T_end
    T_i = prod_{j<i} (1 - alpha_j),   alpha_i = o_i exp(-1/2 d_i^T K_i d_i)

Gaussians are sorted by depth once and listed per tile by a stable counting pass. One worker owns a
tile and draws Gaussian by Gaussian, row by row over the exact span of its ellipse, so that no two
workers write the same pixel: no atomics, and the same bits at every run. The backward pass walks the
same lists in reverse; each (Gaussian, tile) pair has a private slot for its gradient, and the slots of
a Gaussian are summed in a fixed order.

Eq. 8's depth is a sum weighted by alpha; divide by alpha for an expected depth.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import torch
from torch import Tensor

from kernels.projection import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    CULLED,
    DEPTH,
    EXTENT,
    GRADIENT_SIZE,
    HALF_HEIGHT,
    LOW_PASS,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    RECORD_SIZE,
    _project_backward,
    _project_forward,
    tile_range,
)
from kernels.runtime import CHUNK, check_shape, float_dtype, plain, workers

TILE = 32  # pixels; 32 and 64 are equally fast on a CPU, 16 is slower
MAX_ALPHA = 0.99  # so that T never reaches zero and the backward pass can divide by 1 - alpha
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished below this
VISIBLE_TRANSMITTANCE = 0.5  # Sec. III-E: visible while the accumulated opacity is below 0.5
POSE_PARTS = 1024  # partial sums of the pose gradient, added in float64


@ti.func
def index_of(key):
    return ti.cast(key, ti.i32)  # keeps the lower 32 bits


@ti.kernel
def _count_pairs(
    keys: ti.types.ndarray(ti.i64, ndim=1),  # [N] sorted
    num_drawn: ti.i32,
    record: ti.types.ndarray(ndim=2),
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    counts: ti.types.ndarray(ti.i32, ndim=2),  # out [workers, tiles]
):
    num_workers = counts.shape[0]
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            for t in range(counts.shape[1]):
                counts[w, t] = 0
            columns = (width + tile - 1) // tile
            for k in range(num_drawn * w // num_workers, num_drawn * (w + 1) // num_workers):
                r = tile_range(record, index_of(keys[k]), width, height, tile)
                for ty in range(r[2], r[3] + 1):
                    for tx in range(r[0], r[1] + 1):
                        counts[w, ty * columns + tx] = counts[w, ty * columns + tx] + 1


@ti.kernel
def _prefix_sums(
    num_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [N] tiles of each Gaussian
    counts: ti.types.ndarray(ti.i32, ndim=2),  # [workers, tiles]: counts in, first positions out
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # out [tiles + 1]
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # out [N + 1]
):
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for t in range(counts.shape[1]):
            tile_start[t] = total
            for w in range(counts.shape[0]):
                count = counts[w, t]
                counts[w, t] = total
                total += count
        tile_start[counts.shape[1]] = total
        slots = 0
        for i in range(num_tiles.shape[0]):
            first_slot[i] = slots
            slots += num_tiles[i]
        first_slot[num_tiles.shape[0]] = slots


@ti.kernel
def _fill_lists(
    keys: ti.types.ndarray(ti.i64, ndim=1),
    num_drawn: ti.i32,
    record: ti.types.ndarray(ndim=2),
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    positions: ti.types.ndarray(ti.i32, ndim=2),  # [workers, tiles] next free place, counted up
    first_slot: ti.types.ndarray(ti.i32, ndim=1),
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # out [pairs] Gaussian, by tile and then by depth
    slot: ti.types.ndarray(ti.i32, ndim=1),  # out [pairs] its private gradient row
):
    num_workers = positions.shape[0]
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            columns = (width + tile - 1) // tile
            for k in range(num_drawn * w // num_workers, num_drawn * (w + 1) // num_workers):
                g = index_of(keys[k])
                r = tile_range(record, g, width, height, tile)
                s = first_slot[g]
                for ty in range(r[2], r[3] + 1):
                    for tx in range(r[0], r[1] + 1):
                        place = positions[w, ty * columns + tx]
                        positions[w, ty * columns + tx] = place + 1
                        gaussian[place] = g
                        slot[place] = s
                        s += 1


@ti.func
def row_span(first, last, mean_x, mean_y, a, b, c, extent, y):
    """Columns of row y where d^T K d <= 2 extent: the roots of a dx^2 + 2 b dy dx + c dy^2 = 2 extent."""
    dy = y - mean_y
    discriminant = b * dy * b * dy - a * (c * dy * dy - 2.0 * extent)
    begin, end = 0, -1
    if discriminant > 0:
        root = ti.sqrt(discriminant)
        begin = ti.max(first, ti.cast(ti.ceil(mean_x + (-b * dy - root) / a), ti.i32))
        end = ti.min(last, ti.cast(ti.floor(mean_x + (-b * dy + root) / a), ti.i32))
    return begin, end


@ti.func
def row_exponentials(opacity, a, b, c, dx, dy):
    """alpha at dx and its ratio to the next pixel's; ratios themselves shrink by exp(-a) a pixel."""
    alpha = opacity * ti.exp(-(0.5 * c * dy * dy + dx * (0.5 * a * dx + b * dy)))
    return alpha, ti.exp(-(a * (dx + 0.5) + b * dy))


@ti.kernel
def _rasterize_forward(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, RECORD_SIZE]
    colors: ti.types.ndarray(ndim=2),  # [N, C]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    tile: ti.i32,
    num_workers: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    # outputs
    image: ti.types.ndarray(ndim=3),  # [H, W, C]
    depth: ti.types.ndarray(ndim=2),  # [H, W]
    transmittance: ti.types.ndarray(ndim=2),  # [H, W]
    last: ti.types.ndarray(ti.i32, ndim=2),  # [H, W] last pair that was drawn
    visible: ti.types.ndarray(ti.u8, ndim=1),  # [N] zeros in, 1 where drawn at T > 0.5
    dominant: ti.types.ndarray(ti.i32, ndim=2),  # [H, W] Gaussian at which T falls below 0.5, -1: none
    C: ti.template(),
):
    height, width = depth.shape[0], depth.shape[1]
    columns = (width + tile - 1) // tile
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                x0, y0 = (t % columns) * tile, (t // columns) * tile
                x1, y1 = ti.min(x0 + tile, width) - 1, ti.min(y0 + tile, height) - 1
                for y in range(y0, y1 + 1):
                    for x in range(x0, x1 + 1):
                        transmittance[y, x] = 1.0
                        depth[y, x] = 0.0
                        last[y, x] = -1
                        dominant[y, x] = -1
                        for k in ti.static(range(C)):
                            image[y, x, k] = 0.0
                for pair in range(tile_start[t], tile_start[t + 1]):
                    g = gaussian[pair]
                    mean_x, mean_y = record[g, MEAN_X], record[g, MEAN_Y]
                    a, b, c = record[g, CONIC_XX], record[g, CONIC_XY], record[g, CONIC_YY]
                    opacity, d, extent = record[g, OPACITY], record[g, DEPTH], record[g, EXTENT]
                    half_height = record[g, HALF_HEIGHT]
                    color = ti.Vector([0.0 for _ in range(C)])
                    for k in ti.static(range(C)):
                        color[k] = colors[g, k]
                    ratio_of_ratios = ti.exp(-a)
                    seen = 0
                    top = ti.max(y0, ti.cast(ti.ceil(mean_y - half_height), ti.i32))
                    bottom = ti.min(y1, ti.cast(ti.floor(mean_y + half_height), ti.i32))
                    for y in range(top, bottom + 1):
                        begin, end = row_span(x0, x1, mean_x, mean_y, a, b, c, extent, y)
                        alpha, ratio = row_exponentials(opacity, a, b, c, begin - mean_x, y - mean_y)
                        for x in range(begin, end + 1):
                            T = transmittance[y, x]
                            weight = ti.min(MAX_ALPHA, alpha) * T
                            alpha *= ratio
                            ratio *= ratio_of_ratios
                            if T > MIN_TRANSMITTANCE:
                                transmittance[y, x] = T - weight
                                depth[y, x] = depth[y, x] + weight * d
                                for k in ti.static(range(C)):
                                    image[y, x, k] = image[y, x, k] + weight * color[k]
                                last[y, x] = pair
                                if T > VISIBLE_TRANSMITTANCE:
                                    seen = 1
                                    if T - weight <= VISIBLE_TRANSMITTANCE:
                                        dominant[y, x] = g
                    if seen == 1:
                        visible[g] = ti.cast(1, ti.u8)
                t = ti.atomic_add(next_tile[0], 1)


@ti.kernel
def _rasterize_backward(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, RECORD_SIZE]
    colors: ti.types.ndarray(ndim=2),  # [N, C]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    slot: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    tile: ti.i32,
    num_workers: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    transmittance: ti.types.ndarray(ndim=2),  # [H, W] final T of the forward pass
    last: ti.types.ndarray(ti.i32, ndim=2),  # [H, W]
    grad_image: ti.types.ndarray(ndim=3),  # [H, W, C]
    grad_depth: ti.types.ndarray(ndim=2),  # [H, W]
    grad_alpha: ti.types.ndarray(ndim=2),  # [H, W]
    # scratch
    T_now: ti.types.ndarray(ndim=2),  # [H, W]
    suffix: ti.types.ndarray(ndim=2),  # [H, W]
    # outputs
    slot_grad: ti.types.ndarray(ndim=2),  # [pairs, GRADIENT_SIZE + C]
    C: ti.template(),
):
    # With q_i = c_i . dI + d_i dD, the loss depends on alpha_i as
    #   dL/dalpha_i = T_i q_i - S_i / (1 - alpha_i),   S_i = sum_{j>i} alpha_j T_j q_j - T_end dA,
    # because alpha_i scales its own weight and every later weight (and T_end) holds a factor 1 - alpha_i.
    # T_i is recovered backwards from T_end by dividing by 1 - alpha_i. With v = alpha dL/dalpha:
    #   d mean = K sum v d,   dK_xx = -1/2 sum v dx^2,   dK_xy = -sum v dx dy,   d opacity = sum v / o.
    height, width = T_now.shape[0], T_now.shape[1]
    columns = (width + tile - 1) // tile
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                x0, y0 = (t % columns) * tile, (t // columns) * tile
                x1, y1 = ti.min(x0 + tile, width) - 1, ti.min(y0 + tile, height) - 1
                for y in range(y0, y1 + 1):
                    for x in range(x0, x1 + 1):
                        T_now[y, x] = transmittance[y, x]
                        suffix[y, x] = -transmittance[y, x] * grad_alpha[y, x]
                first, past = tile_start[t], tile_start[t + 1]
                for k in range(past - first):
                    pair = past - 1 - k
                    g = gaussian[pair]
                    mean_x, mean_y = record[g, MEAN_X], record[g, MEAN_Y]
                    a, b, c = record[g, CONIC_XX], record[g, CONIC_XY], record[g, CONIC_YY]
                    opacity, d, extent = record[g, OPACITY], record[g, DEPTH], record[g, EXTENT]
                    half_height = record[g, HALF_HEIGHT]
                    color = ti.Vector([0.0 for _ in range(C)])
                    dcolor = ti.Vector([0.0 for _ in range(C)])
                    for m in ti.static(range(C)):
                        color[m] = colors[g, m]
                    ratio_of_ratios = ti.exp(-a)
                    # moments of v over the pixels, and the gradient of the depth
                    v_sum, v_x, v_y, v_xx, v_xy, v_yy, ddepth = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                    top = ti.max(y0, ti.cast(ti.ceil(mean_y - half_height), ti.i32))
                    bottom = ti.min(y1, ti.cast(ti.floor(mean_y + half_height), ti.i32))
                    for y in range(top, bottom + 1):
                        begin, end = row_span(x0, x1, mean_x, mean_y, a, b, c, extent, y)
                        dy = y - mean_y
                        alpha_raw, ratio = row_exponentials(opacity, a, b, c, begin - mean_x, dy)
                        row, row_x, row_xx = 0.0, 0.0, 0.0
                        for x in range(begin, end + 1):
                            alpha = ti.min(MAX_ALPHA, alpha_raw)
                            clamped = alpha_raw > MAX_ALPHA
                            alpha_raw *= ratio
                            ratio *= ratio_of_ratios
                            if pair <= last[y, x]:
                                dx = x - mean_x
                                inverse = 1.0 / (1.0 - alpha)
                                T = T_now[y, x] * inverse
                                T_now[y, x] = T
                                weight = alpha * T
                                q = d * grad_depth[y, x]
                                ddepth += weight * grad_depth[y, x]
                                for m in ti.static(range(C)):
                                    q += color[m] * grad_image[y, x, m]
                                    dcolor[m] += weight * grad_image[y, x, m]
                                S = suffix[y, x]
                                suffix[y, x] = S + weight * q
                                if not clamped:  # min() passes no gradient where it cuts
                                    v = alpha * (T * q - S * inverse)
                                    row += v
                                    row_x += v * dx
                                    row_xx += v * dx * dx
                        v_sum += row
                        v_x += row_x
                        v_xx += row_xx
                        v_y += row * dy
                        v_xy += row_x * dy
                        v_yy += row * dy * dy
                    s = slot[pair]
                    slot_grad[s, MEAN_X] = a * v_x + b * v_y
                    slot_grad[s, MEAN_Y] = b * v_x + c * v_y
                    slot_grad[s, CONIC_XX] = -0.5 * v_xx
                    slot_grad[s, CONIC_XY] = -v_xy
                    slot_grad[s, CONIC_YY] = -0.5 * v_yy
                    slot_grad[s, OPACITY] = v_sum / opacity
                    slot_grad[s, DEPTH] = ddepth
                    for m in ti.static(range(C)):
                        slot_grad[s, GRADIENT_SIZE + m] = dcolor[m]
                t = ti.atomic_add(next_tile[0], 1)


@dataclass(frozen=True)
class Rasterization:
    """A rendered view. `visible` is Sec. III-E's: drawn where accumulated opacity was below 0.5."""

    image: Tensor  # [H, W, C]
    depth: Tensor  # [H, W] metres, weighted by alpha (Eq. 8)
    alpha: Tensor  # [H, W]
    visible: Tensor  # [N] bool
    dominant: Tensor  # [H, W] int32, index of the Gaussian at half the opacity; -1 where there is none


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, means, quats, scales, opacities, colors, T_camera_world, intrinsics, size, tile, low_pass
    ):
        width, height = size
        inputs = [
            plain(name, tensor)
            for name, tensor in zip(
                ("means", "quats", "scales", "opacities", "colors", "T_camera_world"),
                (means, quats, scales, opacities, colors, T_camera_world),
            )
        ]
        means_, quats_, scales_, opacities_, colors_, pose_ = inputs
        n, channels, device = len(means_), colors_.shape[1], means_.device

        def floats(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=float_dtype(), device=device)

        def integers(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=torch.int32, device=device)

        record, num_tiles = floats(n, RECORD_SIZE), integers(n)
        keys = torch.empty(n, dtype=torch.int64, device=device)
        _project_forward(
            means_, quats_, scales_, opacities_, pose_, *intrinsics, width, height, tile,
            low_pass, record, keys, num_tiles,
        )  # fmt: skip
        keys, num_drawn = _sorted_by_depth(keys)
        tiles = -(-width // tile) * -(-height // tile)
        counts, tile_start, first_slot = integers(workers(), tiles), integers(tiles + 1), integers(n + 1)
        _count_pairs(keys, num_drawn, record, width, height, tile, counts)
        _prefix_sums(num_tiles, counts, tile_start, first_slot)
        pairs = int(tile_start[-1])
        gaussian, slot = integers(max(pairs, 1)), integers(max(pairs, 1))
        _fill_lists(keys, num_drawn, record, width, height, tile, counts, first_slot, gaussian, slot)

        image, depth = floats(height, width, channels), floats(height, width)
        transmittance, last = floats(height, width), integers(height, width)
        visible = torch.zeros(n, dtype=torch.uint8, device=device)
        dominant = integers(height, width)
        queue = torch.zeros(1, dtype=torch.int32, device=device)
        _rasterize_forward(
            record, colors_, tile_start, gaussian, tile, workers(), queue,
            image, depth, transmittance, last, visible, dominant, channels,
        )  # fmt: skip
        ctx.save_for_backward(*inputs, record, tile_start, first_slot, gaussian, slot, transmittance, last)
        ctx.intrinsics, ctx.tile = intrinsics, tile
        visible = visible.bool()
        ctx.mark_non_differentiable(visible, dominant)
        return image, depth, 1 - transmittance, visible, dominant

    @staticmethod
    def backward(ctx, grad_image, grad_depth, grad_alpha, _visible, _dominant):
        (
            means, quats, scales, _, colors, pose,
            record, tile_start, first_slot, gaussian, slot, transmittance, last,
        ) = ctx.saved_tensors  # fmt: skip
        channels = colors.shape[1]
        slot_grad = record.new_empty(len(slot), GRADIENT_SIZE + channels)
        queue = torch.zeros(1, dtype=torch.int32, device=record.device)
        _rasterize_backward(
            record, colors, tile_start, gaussian, slot, ctx.tile, workers(), queue, transmittance, last,
            grad_image.contiguous(), grad_depth.contiguous(), grad_alpha.contiguous(),
            torch.empty_like(transmittance), torch.empty_like(transmittance), slot_grad, channels,
        )  # fmt: skip
        grads = [torch.empty_like(x) for x in (means, quats, scales)]
        grad_opacities, grad_colors = record.new_empty(len(means)), torch.empty_like(colors)
        pose_parts = record.new_empty(POSE_PARTS, 12)
        fx, fy, _, _ = ctx.intrinsics
        _project_backward(
            means, quats, scales, pose, fx, fy, record, first_slot, slot_grad,
            *grads, grad_opacities, grad_colors, pose_parts, channels,
        )  # fmt: skip
        grad_pose = torch.zeros_like(pose)
        grad_pose[:3] = pose_parts.sum(0, dtype=torch.float64).view(3, 4).to(pose.dtype)
        return *grads, grad_opacities, grad_colors, grad_pose, None, None, None, None


def _sorted_by_depth(keys: Tensor) -> tuple[Tensor, int]:
    """Return the keys in ascending order and how many of them are drawn."""
    # numpy's int64 sort is vectorised; torch's CPU sort is 10 to 20 times slower.
    ordered = keys.sort().values if keys.is_cuda else torch.from_numpy(np.sort(keys.numpy()))
    first_culled = torch.tensor(CULLED << 32, dtype=torch.int64, device=keys.device)
    return ordered, int(torch.searchsorted(ordered, first_culled))


def rasterize(
    means: Tensor,  # [N, 3] metres, world frame
    quats: Tensor,  # [N, 4] wxyz, need not be normalised
    scales: Tensor,  # [N, 3] metres
    opacities: Tensor,  # [N] in (0, 1)
    colors: Tensor,  # [N, C]
    T_camera_world: Tensor,  # [4, 4]
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy; pixel centres at integers
    size: tuple[int, int],  # (width, height)
    tile: int = TILE,
    low_pass: float = LOW_PASS,  # px^2 added to every 2D covariance; less in a view of reduced size
) -> Rasterization:
    """Render Gaussians: colours, depth and alpha, differentiable in all tensor arguments.

    Eq. 7-8. The gradient of the pose is with respect to the 12 entries of [R | t]; chain it to a
    twist through the function that made the matrix. Raises ValueError on wrong shapes.
    """
    n = means.shape[0]
    for name, tensor, shape in (
        ("means", means, (None, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)),
        ("colors", colors, (n, None)),
        ("T_camera_world", T_camera_world, (4, 4)),
    ):
        check_shape(name, tensor, shape)
    outputs = _Rasterize.apply(
        means,
        quats,
        scales,
        opacities,
        colors,
        T_camera_world,
        tuple(intrinsics),
        tuple(size),
        tile,
        low_pass,
    )
    return Rasterization(*outputs)
