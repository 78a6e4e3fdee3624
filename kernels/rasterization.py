"""Alpha compositing of projected Gaussians (Eq. 8), forward and backward.

    I(x) = sum_i c_i alpha_i T_i,   D(x) = sum_i d_i alpha_i T_i,   A(x) = 1 - T_end
    T_i = prod_{j<i} (1 - alpha_j),   alpha_i = o_i exp(-1/2 d_i^T K_i d_i)

Gaussians are sorted by depth once and listed per tile by a stable counting sort. One worker owns a
tile, so that no two workers write the same pixel: no atomics, and the same bits at every run. It draws
Gaussian by Gaussian, and blocks of 4 x 4 pixels at a time: the pixels of a block are the lanes of a
vector (kernels.lanes), and a pixel that the ellipse does not reach, or that is finished, is masked out.
The backward pass walks the same lists in reverse; each (Gaussian, tile) pair has a private slot for its
gradient, and the slots of a Gaussian are summed in a fixed order.

Eq. 8's depth is a sum weighted by alpha; divide by alpha for an expected depth.
"""

from dataclasses import dataclass

import taichi as ti
import torch
from torch import Tensor

from kernels.lanes import LANES, exp, integer_lanes, lanes, largest, vector_instructions, zeros
from kernels.projection import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    EXTENT,
    FEATURES,
    GRADIENT_FEATURES,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOW_PASS,
    MAX_TILES,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    NOT_DRAWN,
    OPACITY,
    _project_backward,
    _project_forward,
    unpack_tiles,
)
from kernels.runtime import CHUNK, check_shape, float_dtype, plain, workers

TILE = 32  # pixels; a multiple of the blocks below
MAX_ALPHA = 0.99  # so that T never reaches zero and the backward pass can divide by 1 - alpha
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished below this
VISIBLE_TRANSMITTANCE = 0.5  # Sec. III-E: visible while the accumulated opacity is below 0.5
BLOCK_WIDTH, BLOCK_HEIGHT = 4, 4  # pixels handled at once: LANES of them
T_NOW, SUFFIX, GRAD_DEPTH = 0, 1, 2  # columns of the backward pass's state
RADIX_BITS = 11  # three digits hold the 31 bits of a positive float
RADIX = 2**RADIX_BITS
POSE_PARTS = 1024  # partial sums of the pose gradient, added in float64


@ti.func
def lane_columns():
    return ti.Vector([float(lane % BLOCK_WIDTH) for lane in range(LANES)])


@ti.func
def lane_rows():
    return ti.Vector([float(lane // BLOCK_WIDTH) for lane in range(LANES)])


@ti.kernel
def _sort_by_depth(
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [N]
    keys: ti.types.ndarray(ti.i32, ndim=2),  # scratch [2, N] depth bits
    order: ti.types.ndarray(ti.i32, ndim=2),  # [2, N] Gaussians; out: row 1, the drawn ones by depth
    digits: ti.types.ndarray(ti.i32, ndim=2),  # scratch [3, RADIX]
    num_drawn: ti.types.ndarray(ti.i32, ndim=1),  # out [1]
):
    # A stable radix sort in three passes; an unstable one would not be repeatable for equal depths.
    ti.loop_config(serialize=True)
    for _ in range(1):
        for digit in range(RADIX):
            for k in ti.static(range(3)):
                digits[k, digit] = 0
        n = 0
        for i in range(depth_bits.shape[0]):
            key = depth_bits[i]
            if key != NOT_DRAWN:
                keys[0, n], order[0, n] = key, i
                n += 1
                for k in ti.static(range(3)):
                    digit = (key >> (RADIX_BITS * k)) % RADIX
                    digits[k, digit] = digits[k, digit] + 1
        num_drawn[0] = n
        for k in ti.static(range(3)):
            total = 0
            for digit in range(RADIX):
                number = digits[k, digit]
                digits[k, digit] = total
                total += number
            source, target = ti.static(k % 2, 1 - k % 2)
            for i in range(n):
                key = keys[source, i]
                digit = (key >> (RADIX_BITS * k)) % RADIX
                place = digits[k, digit]
                digits[k, digit] = place + 1
                keys[target, place], order[target, place] = key, order[source, i]


@ti.kernel
def _list_pairs(
    # inputs
    order: ti.types.ndarray(ti.i32, ndim=2),  # [2, N] row 1: drawn Gaussians by depth
    num_drawn: ti.types.ndarray(ti.i32, ndim=1),  # [1]
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [N]
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [N + 1]
    columns: ti.i32,  # of tiles
    # scratch
    places: ti.types.ndarray(ti.i32, ndim=2),  # [workers, tiles]
    # outputs
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [pairs] Gaussian, by tile and then by depth
    slot: ti.types.ndarray(ti.i32, ndim=1),  # [pairs] its private gradient row
):
    # A stable counting sort: workers take consecutive parts of the order, first to count and then to fill.
    num_workers, num_tiles = places.shape[0], places.shape[1]
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, n = chunk // CHUNK, num_drawn[0]
            for t in range(num_tiles):
                places[w, t] = 0
            for rank in range(n * w // num_workers, n * (w + 1) // num_workers):
                left, right, top, bottom = unpack_tiles(packed_tiles[order[1, rank]])
                for ty in range(top, bottom + 1):
                    for tx in range(left, right + 1):
                        places[w, ty * columns + tx] = places[w, ty * columns + tx] + 1
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for t in range(num_tiles):
            tile_start[t] = total
            for w in range(num_workers):
                number = places[w, t]
                places[w, t] = total
                total += number
        tile_start[num_tiles] = total
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, n = chunk // CHUNK, num_drawn[0]
            for rank in range(n * w // num_workers, n * (w + 1) // num_workers):
                g = order[1, rank]
                left, right, top, bottom = unpack_tiles(packed_tiles[g])
                s = first_slot[g]
                for ty in range(top, bottom + 1):
                    for tx in range(left, right + 1):
                        place = places[w, ty * columns + tx]
                        places[w, ty * columns + tx] = place + 1
                        gaussian[place] = g
                        slot[place] = s
                        s += 1


@ti.func
def block_range(mean, half_extent, tile_begin, tile_past, size):
    """Blocks of `size` pixels of the tile, begin and past the end, that an ellipse reaches."""
    first = ti.max(tile_begin, ti.cast(ti.ceil(mean - half_extent), ti.i32))
    last = ti.min(tile_past - 1, ti.cast(ti.floor(mean + half_extent), ti.i32))
    begin, past = 0, 0
    if first <= last:
        begin, past = (first - tile_begin) // size, (last - tile_begin) // size + 1
    return begin, past


@vector_instructions
@ti.kernel
def _rasterize_forward(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, FEATURES + 1 + C]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    tile: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    # scratch
    sums: lanes(1),  # [workers * blocks * (1 + C)] of the features
    front: integer_lanes(1),  # [workers * blocks] last Gaussian that was drawn at T > 0.5
    # outputs
    image: ti.types.ndarray(ndim=3),  # [H, W, C]
    depth: ti.types.ndarray(ndim=2),  # [H, W]
    alpha_image: ti.types.ndarray(ndim=2),  # [H, W]
    transmittance: lanes(1),  # [tiles * blocks]
    last: integer_lanes(1),  # [tiles * blocks] last pair that was drawn
    visible: ti.types.ndarray(ti.u8, ndim=1),  # [N] zeros in, 1 where drawn at T > 0.5
    dominant: ti.types.ndarray(ti.i32, ndim=2),  # [H, W] Gaussian at which T falls below 0.5, -1: none
    C: ti.template(),
):
    height, width = depth.shape[0], depth.shape[1]
    columns, blocks_across, num_blocks = (width + tile - 1) // tile, tile // BLOCK_WIDTH, tile * tile // LANES
    num_workers = sums.shape[0] // (num_blocks * (1 + C))
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                x0, y0 = (t % columns) * tile, (t // columns) * tile
                x1, y1 = ti.min(x0 + tile, width), ti.min(y0 + tile, height)
                first, own_first = t * num_blocks, w * num_blocks
                for block in range(num_blocks):
                    x = x0 + block % blocks_across * BLOCK_WIDTH + lane_columns()
                    y = y0 + block // blocks_across * BLOCK_HEIGHT + lane_rows()
                    # pixels outside the image count as finished: nothing is drawn there
                    transmittance[first + block] = ti.select((x < width) & (y < height), 1.0, 0.0)
                    last[first + block] = ti.Vector([-1 for _ in range(LANES)])
                    for k in ti.static(range(1 + C)):
                        sums[(own_first + block) * (1 + C) + k] = zeros()
                for pair in range(tile_start[t], tile_start[t + 1]):
                    g = gaussian[pair]
                    mean_x, mean_y = record[g, MEAN_X], record[g, MEAN_Y]
                    a, b, c = record[g, CONIC_XX], record[g, CONIC_XY], record[g, CONIC_YY]
                    extent = record[g, EXTENT]
                    half_width, half_height = record[g, HALF_WIDTH], record[g, HALF_HEIGHT]
                    feature = [record[g, FEATURES + k] for k in range(1 + C)]
                    left, right = block_range(mean_x, half_width, x0, x1, BLOCK_WIDTH)
                    top, bottom = block_range(mean_y, half_height, y0, y1, BLOCK_HEIGHT)
                    seen = zeros()
                    for row in range(top, bottom):
                        dy = (y0 + row * BLOCK_HEIGHT - mean_y) + lane_rows()
                        dx = (x0 + left * BLOCK_WIDTH - mean_x) + lane_columns()
                        for column in range(left, right):
                            block = first + row * blocks_across + column
                            # d^T K d <= 2 extent where this is positive, and there o exp(-1/2 d^T K d) is
                            # exp(inside) / 255
                            inside = extent - 0.5 * c * dy * dy - dx * (0.5 * a * dx + b * dy)
                            T = transmittance[block]
                            is_drawn = (inside >= 0) & (T > MIN_TRANSMITTANCE)
                            alpha = ti.min(MAX_ALPHA, MIN_ALPHA * exp(inside))
                            weight = ti.select(is_drawn, alpha * T, 0.0)
                            transmittance[block] = T - weight
                            last[block] = ti.select(is_drawn, pair, last[block])
                            is_front = is_drawn & (T > VISIBLE_TRANSMITTANCE)
                            seen = ti.select(is_front, 1.0, seen)
                            own = own_first + row * blocks_across + column
                            front[own] = ti.select(is_front, g, front[own])
                            place = own * (1 + C)
                            for k in ti.static(range(1 + C)):
                                sums[place + k] = sums[place + k] + weight * feature[k]
                            dx += BLOCK_WIDTH
                    if largest(seen) > 0:
                        visible[g] = ti.cast(1, ti.u8)
                for block in range(num_blocks):
                    column, row = block % blocks_across, block // blocks_across
                    for lane in ti.static(range(LANES)):
                        x = x0 + column * BLOCK_WIDTH + lane % BLOCK_WIDTH
                        y = y0 + row * BLOCK_HEIGHT + lane // BLOCK_WIDTH
                        if x < width and y < height:
                            depth[y, x] = sums[(own_first + block) * (1 + C)][lane]
                            T_end = transmittance[first + block][lane]
                            dominant[y, x] = -1
                            if T_end <= VISIBLE_TRANSMITTANCE:
                                dominant[y, x] = front[own_first + block][lane]
                            alpha_image[y, x] = 1.0 - T_end
                            for k in ti.static(range(C)):
                                image[y, x, k] = sums[(own_first + block) * (1 + C) + 1 + k][lane]
                t = ti.atomic_add(next_tile[0], 1)


@vector_instructions
@ti.kernel
def _rasterize_backward(
    # inputs
    record: ti.types.ndarray(ndim=2),  # [N, FEATURES + 1 + C]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    gaussian: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    slot: ti.types.ndarray(ti.i32, ndim=1),  # [pairs]
    tile: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    transmittance: lanes(1),  # [tiles * blocks] final T of the forward pass
    last: integer_lanes(1),  # [tiles * blocks]
    grad_image: ti.types.ndarray(ndim=3),  # [H, W, C]
    grad_depth: ti.types.ndarray(ndim=2),  # [H, W]
    grad_alpha: ti.types.ndarray(ndim=2),  # [H, W]
    # scratch
    state: lanes(1),  # [workers * blocks * (2 + 1 + C)] T, S, and gradients of the features
    # outputs
    slot_grad: ti.types.ndarray(ndim=2),  # [pairs, GRADIENT_FEATURES + 1 + C]
    C: ti.template(),
):
    # With q_i = f_i . dF for the features f = (depth, colours), the loss depends on alpha_i as
    #   dL/dalpha_i = T_i q_i - S_i / (1 - alpha_i),   S_i = sum_{j>i} alpha_j T_j q_j - T_end dA,
    # because alpha_i scales its own weight and every later weight (and T_end) holds a factor 1 - alpha_i.
    # T_i is recovered backwards from T_end by dividing by 1 - alpha_i. With v = alpha dL/dalpha:
    #   d mean = K sum v d,   dK_xx = -1/2 sum v dx^2,   dK_xy = -sum v dx dy,   d opacity = sum v / o.
    height, width = grad_depth.shape[0], grad_depth.shape[1]
    columns, blocks_across, num_blocks = (width + tile - 1) // tile, tile // BLOCK_WIDTH, tile * tile // LANES
    num_workers = state.shape[0] // (num_blocks * (GRAD_DEPTH + 1 + C))
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                x0, y0 = (t % columns) * tile, (t // columns) * tile
                x1, y1 = ti.min(x0 + tile, width), ti.min(y0 + tile, height)
                first_block, scratch = t * num_blocks, w * num_blocks * (GRAD_DEPTH + 1 + C)
                for block in range(num_blocks):
                    place = scratch + block * (GRAD_DEPTH + 1 + C)
                    T_end = transmittance[first_block + block]
                    state[place + T_NOW] = T_end
                    column, row = block % blocks_across, block // blocks_across
                    for lane in ti.static(range(LANES)):  # outside the image any pixel will do
                        x = ti.min(x0 + column * BLOCK_WIDTH + lane % BLOCK_WIDTH, width - 1)
                        y = ti.min(y0 + row * BLOCK_HEIGHT + lane // BLOCK_WIDTH, height - 1)
                        state[place + SUFFIX][lane] = -T_end[lane] * grad_alpha[y, x]
                        state[place + GRAD_DEPTH][lane] = grad_depth[y, x]
                        for k in ti.static(range(C)):
                            state[place + GRAD_DEPTH + 1 + k][lane] = grad_image[y, x, k]
                first, past = tile_start[t], tile_start[t + 1]
                for from_end in range(past - first):
                    pair = past - 1 - from_end
                    g = gaussian[pair]
                    mean_x, mean_y = record[g, MEAN_X], record[g, MEAN_Y]
                    a, b, c = record[g, CONIC_XX], record[g, CONIC_XY], record[g, CONIC_YY]
                    opacity, extent = record[g, OPACITY], record[g, EXTENT]
                    half_width, half_height = record[g, HALF_WIDTH], record[g, HALF_HEIGHT]
                    feature = [record[g, FEATURES + k] for k in range(1 + C)]
                    left, right = block_range(mean_x, half_width, x0, x1, BLOCK_WIDTH)
                    top, bottom = block_range(mean_y, half_height, y0, y1, BLOCK_HEIGHT)
                    # moments of v over the pixels, and the gradients of the features
                    v_sum, v_x, v_y, v_xx, v_xy, v_yy = zeros(), zeros(), zeros(), zeros(), zeros(), zeros()
                    dfeature = [zeros() for _ in range(1 + C)]
                    for row in range(top, bottom):
                        dy = (y0 + row * BLOCK_HEIGHT - mean_y) + lane_rows()
                        dx = (x0 + left * BLOCK_WIDTH - mean_x) + lane_columns()
                        for column in range(left, right):
                            block = row * blocks_across + column
                            place = scratch + block * (GRAD_DEPTH + 1 + C)
                            inside = extent - 0.5 * c * dy * dy - dx * (0.5 * a * dx + b * dy)
                            is_drawn = (inside >= 0) & (last[first_block + block] >= pair)
                            raw = MIN_ALPHA * exp(inside)
                            alpha = ti.select(is_drawn, ti.min(MAX_ALPHA, raw), 0.0)
                            inverse = 1.0 / (1.0 - alpha)
                            T = state[place + T_NOW] * inverse
                            state[place + T_NOW] = T
                            weight = alpha * T
                            q = zeros()
                            for k in ti.static(range(1 + C)):
                                q += feature[k] * state[place + GRAD_DEPTH + k]
                                dfeature[k] += weight * state[place + GRAD_DEPTH + k]
                            S = state[place + SUFFIX]
                            state[place + SUFFIX] = S + weight * q
                            # min() passes no gradient where it cuts
                            v = ti.select(raw <= MAX_ALPHA, alpha * (T * q - S * inverse), 0.0)
                            v_sum += v
                            v_x += v * dx
                            v_y += v * dy
                            v_xx += v * dx * dx
                            v_xy += v * dx * dy
                            v_yy += v * dy * dy
                            dx += BLOCK_WIDTH
                    moment_x, moment_y = v_x.sum(), v_y.sum()
                    s = slot[pair]
                    slot_grad[s, MEAN_X] = a * moment_x + b * moment_y
                    slot_grad[s, MEAN_Y] = b * moment_x + c * moment_y
                    slot_grad[s, CONIC_XX] = -0.5 * v_xx.sum()
                    slot_grad[s, CONIC_XY] = -v_xy.sum()
                    slot_grad[s, CONIC_YY] = -0.5 * v_yy.sum()
                    slot_grad[s, OPACITY] = v_sum.sum() / opacity
                    for k in ti.static(range(1 + C)):
                        slot_grad[s, GRADIENT_FEATURES + k] = dfeature[k].sum()
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

        record, depth_bits, packed_tiles = floats(n, FEATURES + 1 + channels), integers(n), integers(n)
        first_slot = integers(n + 1)
        _project_forward(
            means_, quats_, scales_, opacities_, colors_, pose_, *intrinsics, width, height, tile, low_pass,
            record, depth_bits, packed_tiles, first_slot,
        )  # fmt: skip
        order, num_drawn = integers(2, n), integers(1)
        _sort_by_depth(depth_bits, integers(2, n), order, integers(3, RADIX), num_drawn)
        columns, rows = -(-width // tile), -(-height // tile)
        tiles, blocks, pairs = columns * rows, tile * tile // LANES, max(int(first_slot[-1]), 1)
        tile_start, gaussian, slot = integers(tiles + 1), integers(pairs), integers(pairs)
        _list_pairs(
            order, num_drawn, packed_tiles, first_slot, columns, integers(workers(), tiles),
            tile_start, gaussian, slot,
        )  # fmt: skip
        image, depth, alpha = floats(height, width, channels), floats(height, width), floats(height, width)
        transmittance, last = floats(tiles * blocks, LANES), integers(tiles * blocks, LANES)
        sums = floats(workers() * blocks * (1 + channels), LANES)
        front, dominant = integers(workers() * blocks, LANES), integers(height, width)
        visible = torch.zeros(n, dtype=torch.uint8, device=device)
        queue = torch.zeros(1, dtype=torch.int32, device=device)
        _rasterize_forward(
            record, tile_start, gaussian, tile, queue, sums, front,
            image, depth, alpha, transmittance, last, visible, dominant, channels,
        )  # fmt: skip
        ctx.save_for_backward(*inputs, record, tile_start, first_slot, gaussian, slot, transmittance, last)
        ctx.intrinsics, ctx.tile = intrinsics, tile
        visible = visible.bool()
        ctx.mark_non_differentiable(visible, dominant)
        return image, depth, alpha, visible, dominant

    @staticmethod
    def backward(ctx, grad_image, grad_depth, grad_alpha, _visible, _dominant):
        (
            means, quats, scales, opacities, colors, pose,
            record, tile_start, first_slot, gaussian, slot, transmittance, last,
        ) = ctx.saved_tensors  # fmt: skip
        channels = colors.shape[1]
        slot_grad = record.new_empty(len(slot), GRADIENT_FEATURES + 1 + channels)
        queue = torch.zeros(1, dtype=torch.int32, device=record.device)
        blocks = ctx.tile**2 // LANES
        state = record.new_empty(workers() * blocks * (GRAD_DEPTH + 1 + channels), LANES)
        _rasterize_backward(
            record, tile_start, gaussian, slot, ctx.tile, queue, transmittance, last,
            grad_image.contiguous(), grad_depth.contiguous(), grad_alpha.contiguous(),
            state, slot_grad, channels,
        )  # fmt: skip
        grads = [torch.empty_like(x) for x in (means, quats, scales, opacities, colors)]
        pose_parts = record.new_empty(POSE_PARTS, 12)
        fx, fy, _, _ = ctx.intrinsics
        _project_backward(
            means, quats, scales, pose, fx, fy, record, first_slot, slot_grad,
            *grads, pose_parts, channels,
        )  # fmt: skip
        grad_pose = torch.zeros_like(pose)
        grad_pose[:3] = pose_parts.sum(0, dtype=torch.float64).view(3, 4).to(pose.dtype)
        return *grads, grad_pose, None, None, None, None


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
    if tile % BLOCK_WIDTH or tile % BLOCK_HEIGHT or max(size) > MAX_TILES * tile:
        raise ValueError(
            f"tile: expected a multiple of {BLOCK_WIDTH} of at least {max(size) / MAX_TILES:.0f}, got {tile}"
        )
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
