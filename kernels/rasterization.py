"""Alpha compositing of projected Gaussians (Eq. 8), forward and backward.

    I(x) = sum_i c_i alpha_i T_i,   D(x) = sum_i d_i alpha_i T_i,   A(x) = 1 - T_end
    T_i = prod_{j<i} (1 - alpha_j),   alpha_i = o_i exp(-1/2 d_i^T K_i d_i)

Every tile of pixels has its list of Gaussians, front to back (kernels.tile_lists). On a CPU one worker owns
a tile: it copies the records of the list to where they stay in its cache, and lists them for each block of
4 x 4 pixels that their ellipses reach. The pixels of a block are the lanes of a vector (kernels.lanes): their
state stays in registers while the block's list is walked, and a pixel that an ellipse does not reach, or that
is finished, is masked out. The backward pass walks the same lists in reverse; each (Gaussian, tile) pair has
a private slot for its gradient, and the slots of a Gaussian are summed in a fixed order: no atomics, and the
same bits at every run.

Images are stored by blocks inside the kernels: [..., tiles * blocks, LANES].

Eq. 8's depth is a sum weighted by alpha; divide by alpha for an expected depth.
"""

from dataclasses import dataclass

import taichi as ti
import torch
from torch import Tensor

from kernels.lanes import (
    LANES,
    SUMS,
    exp,
    integer_lanes,
    lanes,
    largest,
    sums,
    sums_of,
    vector_instructions,
)
from kernels.projection import (
    BLOCK,
    COLUMNS,
    EXTENT,
    FEATURES,
    GRAD_FEATURES,
    HALF,
    HALF_K_XX,
    HALF_K_YY,
    K_XY,
    LOW_PASS,
    MAX_TILES,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    ROWS,
    SPAN,
    SPANS,
    Projection,
    by_sums,
    gradient_size,
    once,
    project,
    project_backward,
    record_size,
)
from kernels.runtime import CHUNK, check_shape, float_dtype, plain, workers
from kernels.tile_lists import TileLists, list_pairs

TILE = 32  # pixels; a multiple of the blocks
MAX_ALPHA = 0.99  # so that T never reaches zero and the backward pass can divide by 1 - alpha
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished below this
VISIBLE_TRANSMITTANCE = 0.5  # Sec. III-E: visible while the accumulated opacity is below 0.5


@ti.func
def lane_columns():
    return ti.Vector([float(lane % BLOCK) for lane in range(LANES)])


@ti.func
def lane_rows():
    return ti.Vector([float(lane // BLOCK) for lane in range(LANES)])


@ti.func
def log_255_alpha(record: ti.template(), at, dx, dy):
    """Not negative inside the ellipse of a record, at the distance d from its mean."""
    along_x = record[at, HALF_K_XX] * dx + record[at, K_XY] * dy
    return record[at, EXTENT] - dx * along_x - record[at, HALF_K_YY] * dy * dy


@ti.func
def list_blocks(
    # inputs
    records: ti.template(),  # [N, record_size / SUMS] sums
    pairs: ti.template(), first, past,
    column, row, across, w,  # the tile's first column and row of blocks, its blocks across, and the worker
    # outputs
    near: ti.template(), near_record: ti.template(),  # [workers * longest, record_size], sums and numbers
    number: ti.template(),  # [workers, blocks]
    items: ti.template(),  # [workers, blocks, longest]
    C: ti.template(),
):  # fmt: skip
    """Copy the records of a tile to where they are neighbours, and list for each block those it draws."""
    base = w * items.shape[2]
    for j in range(past - first):  # a loop this short waits for many records at once
        g = pairs[first + j, 0]
        for k in ti.static(range(record_size(C) // SUMS)):
            near[base + j, k] = records[g, k]
    for block in range(across * across):
        number[w, block] = 0
    for j in range(past - first):
        top, bottom = halves(near_record[base + j, ti.static(gradient_size(C)) + ROWS])
        for r in range(ti.max(top, row), ti.min(bottom, row + across - 1) + 1):
            where = ti.select(r - top < SPANS, SPAN + r - top, COLUMNS)
            left, right = halves(near_record[base + j, ti.static(gradient_size(C)) + where])
            for c in range(ti.max(left, column), ti.min(right, column + across - 1) + 1):
                block = (r - row) * across + c - column
                n = number[w, block]
                items[w, block, n] = j
                number[w, block] = n + 1


@ti.func
def halves(packed):
    """a and b of a * HALF + b."""
    both = ti.cast(packed, ti.i32)
    return both // HALF, both % HALF


@ti.func
def draw(
    # inputs
    record: ti.template(), pairs: ti.template(), first, number, items: ti.template(), w, block,
    x, y, is_inside, i,  # the block (or pixel) and its place in the outputs
    # outputs
    values: ti.template(), transmittance: ti.template(), last: ti.template(), front: ti.template(),
    visible: ti.template(),
    C: ti.template(), is_block: ti.template(),
):  # fmt: skip
    """Composite the `number` records of a block's list (or of a tile's, for a pixel)."""
    T = ti.select(is_inside, 1.0, 0.0)  # pixels outside the image count as finished: nothing is drawn there
    last_drawn = ti.select(is_inside, -1, -1)
    front_gaussian = ti.select(is_inside, -1, -1)
    feature = [once(T * 0.0) for _ in range(1 + C)]
    for n in range(number):
        at, pair = place_of(pairs, first, items, w, block, n, is_block)
        dx, dy = x - record[at, MEAN_X], y - record[at, MEAN_Y]
        inside = log_255_alpha(record, at, dx, dy)
        is_drawn = (inside >= 0.0) & (T > MIN_TRANSMITTANCE)
        alpha = MIN_ALPHA * exp(inside)
        weight = ti.select(is_drawn, ti.select(alpha < MAX_ALPHA, alpha, MAX_ALPHA) * T, 0.0)
        for k in ti.static(range(1 + C)):
            feature[k] += weight * record[at, FEATURES + k]
        last_drawn = ti.select(is_drawn, n, last_drawn)
        is_front = is_drawn & (T > VISIBLE_TRANSMITTANCE)
        g = pairs[pair, 0]
        front_gaussian = ti.select(is_front, g, front_gaussian)
        is_seen = ti.select(is_front, 1.0, 0.0)
        if ti.static(is_block):
            if largest(is_seen) > 0:
                visible[g] = ti.cast(1, ti.u8)
        else:
            if is_seen > 0:
                visible[g] = ti.cast(1, ti.u8)
        T = T - weight
    for k in ti.static(range(1 + C)):
        values[k, i] = feature[k]
    transmittance[i] = T
    last[i] = last_drawn
    front[i] = ti.select(T <= VISIBLE_TRANSMITTANCE, front_gaussian, -1)


@ti.func
def place_of(pairs: ti.template(), first, items: ti.template(), w, block, n, is_block: ti.template()):
    """Where the n-th record of a list is, and which pair it belongs to."""
    at, pair = 0, first + n
    if ti.static(is_block):
        j = items[w, block, n]
        at, pair = w * items.shape[2] + j, first + j
    else:
        at = pairs[pair, 0]
    return at, pair


@ti.func
def draw_backward(
    # inputs
    record: ti.template(), pairs: ti.template(), first, number, items: ti.template(), w, block,
    x, y, i,
    transmittance: ti.template(), last: ti.template(),  # as `draw` left them
    grad_values: ti.template(), grad_alpha: ti.template(),
    # outputs
    gradient: ti.template(),  # of the records: where they are, or in slots
    C: ti.template(), is_block: ti.template(),
):  # fmt: skip
    """Add to the gradients of the records."""
    # With q_i = f_i . dF for the features f = (depth, colours), the loss depends on alpha_i as
    #   dL/dalpha_i = T_i (q_i - B_i),   B_{i-1} = B_i + alpha_i (q_i - B_i),   B_end = -dA:
    # alpha_i scales its own weight and takes as much from what is behind it, whose part in the loss is B_i.
    # T_i is recovered backwards from T_end by dividing by 1 - alpha_i. With v = alpha dL/dalpha:
    #   d mean = K sum v d,   dK = -1/2 sum v d d^T,   d opacity = sum v / o.
    T, last_drawn = transmittance[i], last[i]
    behind = 0.0 - grad_alpha[i]
    grad_feature = [once(grad_values[k, i]) for k in range(1 + C)]
    for from_end in range(number):
        n = number - 1 - from_end
        at, pair = place_of(pairs, first, items, w, block, n, is_block)
        dx, dy = x - record[at, MEAN_X], y - record[at, MEAN_Y]
        inside = log_255_alpha(record, at, dx, dy)
        is_drawn = (inside >= 0.0) & (last_drawn >= n)
        raw = MIN_ALPHA * exp(inside)
        alpha = ti.select(is_drawn, ti.select(raw < MAX_ALPHA, raw, MAX_ALPHA), 0.0)
        T = T / (1.0 - alpha)
        weight = alpha * T
        q = 0.0 - behind
        for k in ti.static(range(1 + C)):
            q += record[at, FEATURES + k] * grad_feature[k]
        behind += alpha * q
        v = ti.select(raw < MAX_ALPHA, weight * q, 0.0)  # min() passes no gradient where it cuts
        v_x, v_y = v * dx, v * dy
        part = (
            [v, v_x, v_y, v_x * dx, v_x * dy, v_y * dy]
            + [weight * grad_feature[k] for k in range(1 + C)]
            + [v * 0.0 for _ in range(ti.static(gradient_size(C) - GRAD_FEATURES - 1 - C))]
        )
        if ti.static(is_block):
            for k in ti.static(range(gradient_size(C) // SUMS)):
                p = [part[SUMS * k + j] for j in range(SUMS)]
                total = sums_of(p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7])
                gradient[at, k] = gradient[at, k] + total
        else:
            for k in ti.static(range(GRAD_FEATURES + 1 + C)):
                if part[k] != 0.0:
                    ti.atomic_add(gradient[pairs[pair, 1], k], part[k])


@vector_instructions
@ti.kernel
def _rasterize_forward(
    # inputs
    records: sums(2),  # [N, record_size / SUMS]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    # scratch; the first two are the same memory
    near: sums(2),  # [workers * longest, record_size / SUMS]
    near_record: ti.types.ndarray(ndim=2),  # [workers * longest, record_size]
    number: ti.types.ndarray(ti.i32, ndim=2),  # [workers, blocks of a tile]
    items: ti.types.ndarray(ti.i32, ndim=3),  # [workers, blocks of a tile, longest]
    # outputs, all by blocks
    values: lanes(2),  # [1 + C, blocks] depth and colours
    transmittance: lanes(1),  # [blocks]
    last: integer_lanes(1),  # [blocks] last one of the block's list that was drawn, -1: none
    front: integer_lanes(1),  # [blocks] Gaussian at which T falls below 0.5, -1: none
    visible: ti.types.ndarray(ti.u8, ndim=1),  # [N] zeros in, 1 where drawn at T > 0.5
    C: ti.template(),
):
    columns, across = (width + tile - 1) // tile, tile // BLOCK
    for chunk in range(number.shape[0] * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                column, row = t % columns * across, t // columns * across
                first = tile_start[t]
                list_blocks(
                    records, pairs, first, tile_start[t + 1], column, row, across, w,
                    near, near_record, number, items, C,
                )  # fmt: skip
                for block in range(across * across):
                    x = (column + block % across) * BLOCK + lane_columns()
                    y = (row + block // across) * BLOCK + lane_rows()
                    draw(
                        near_record, pairs, first, number[w, block], items, w, block,
                        x, y, (x < width) & (y < height), t * across * across + block,
                        values, transmittance, last, front, visible, C, True,
                    )  # fmt: skip
                t = ti.atomic_add(next_tile[0], 1)


@vector_instructions
@ti.kernel
def _rasterize_backward(
    # inputs
    records: sums(2),  # [N, record_size / SUMS]
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    next_tile: ti.types.ndarray(ti.i32, ndim=1),  # [1] queue of tiles, starts at 0
    transmittance: lanes(1),  # [blocks] final T of the forward pass
    last: integer_lanes(1),  # [blocks]
    grad_values: lanes(2),  # [1 + C, blocks]
    grad_alpha: lanes(1),  # [blocks]
    # scratch; the first two are the same memory
    near: sums(2),  # [workers * longest, record_size / SUMS]
    near_record: ti.types.ndarray(ndim=2),  # [workers * longest, record_size]
    near_grad: sums(2),  # [workers * longest, gradient_size / SUMS]
    number: ti.types.ndarray(ti.i32, ndim=2),  # [workers, blocks of a tile]
    items: ti.types.ndarray(ti.i32, ndim=3),  # [workers, blocks of a tile, longest]
    # outputs
    slot_grad: sums(2),  # [P, gradient_size / SUMS]
    C: ti.template(),
):
    columns, across = (width + tile - 1) // tile, tile // BLOCK
    for chunk in range(number.shape[0] * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            t = ti.atomic_add(next_tile[0], 1)
            while t < tile_start.shape[0] - 1:
                column, row = t % columns * across, t // columns * across
                first, past = tile_start[t], tile_start[t + 1]
                list_blocks(
                    records, pairs, first, past, column, row, across, w,
                    near, near_record, number, items, C,
                )  # fmt: skip
                clear(near_grad, w * items.shape[2], past - first, C)
                for block in range(across * across):
                    x = (column + block % across) * BLOCK + lane_columns()
                    y = (row + block // across) * BLOCK + lane_rows()
                    draw_backward(
                        near_record, pairs, first, number[w, block], items, w, block,
                        x, y, t * across * across + block,
                        transmittance, last, grad_values, grad_alpha, near_grad, C, True,
                    )  # fmt: skip
                fill_slots(near_grad, w * items.shape[2], pairs, first, past, slot_grad, C)
                t = ti.atomic_add(next_tile[0], 1)


@ti.func
def clear(near_grad: ti.template(), base, number, C: ti.template()):
    for j in range(number):
        for k in ti.static(range(gradient_size(C) // SUMS)):
            near_grad[base + j, k] = ti.Vector([0.0 for _ in range(SUMS)])


@ti.func
def fill_slots(
    near_grad: ti.template(), base, pairs: ti.template(), first, past,
    slot_grad: ti.template(), C: ti.template(),
):  # fmt: skip
    """Move the gradients of a tile's records to their slots."""
    for pair in range(first, past):
        for k in ti.static(range(gradient_size(C) // SUMS)):
            slot_grad[pairs[pair, 1], k] = near_grad[base + pair - first, k]


@dataclass(frozen=True)
class Workspace:
    """Where workers keep what they need of a tile."""

    near: Tensor  # [workers * longest, record_size]
    near_grad: Tensor  # [workers * longest, gradient_size]
    number: Tensor  # [workers, blocks of a tile] int32
    items: Tensor  # [workers, blocks of a tile, longest] int32

    @staticmethod
    def of(projection: Projection, lists: TileLists, num_views: int = 1) -> "Workspace":
        """Return memory for as many tiles as are worked on at once, `num_views` a worker."""
        record, longest, blocks = projection.record, max(lists.longest, 1), (lists.tile // BLOCK) ** 2
        spaces = workers() * num_views
        return Workspace(
            record.new_empty(spaces * longest, record.shape[1]),
            record.new_empty(spaces * longest, gradient_size(projection.channels)),
            torch.empty(spaces, blocks, dtype=torch.int32, device=record.device),
            torch.empty(spaces, blocks, longest, dtype=torch.int32, device=record.device),
        )


def to_blocks(
    images: Tensor,  # [K, H, W]
    tile: int,
) -> Tensor:  # [K, tiles * blocks, LANES]
    """Return images by tiles and blocks, filled up with zeros."""
    num, height, width = images.shape
    rows, columns, across = -(-height // tile), -(-width // tile), tile // BLOCK
    if (rows * tile, columns * tile) != (height, width):
        images = torch.nn.functional.pad(images, (0, columns * tile - width, 0, rows * tile - height))
    split = images.reshape(num, rows, across, BLOCK, columns, across, BLOCK)
    return split.permute(0, 1, 4, 2, 5, 3, 6).reshape(num, -1, LANES)


def from_blocks(
    blocks: Tensor,  # [K, tiles * blocks, LANES]
    size: tuple[int, int],  # (width, height)
    tile: int,
) -> Tensor:  # [K, H, W]
    """Undo `to_blocks`."""
    width, height = size
    rows, columns, across = -(-height // tile), -(-width // tile), tile // BLOCK
    split = blocks.view(-1, rows, columns, across, across, BLOCK, BLOCK).permute(0, 1, 3, 5, 2, 4, 6)
    return split.reshape(-1, rows * tile, columns * tile)[:, :height, :width]


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
        count, channels, device = len(means), colors.shape[1], means.device
        pose = plain("T_camera_world", T_camera_world)[None]
        projection = project(means, quats, scales, opacities, colors, pose, intrinsics, size, tile, low_pass)
        lists = list_pairs(projection, size, tile)
        blocks = (len(lists.start) - 1) * (tile // BLOCK) ** 2
        values = torch.empty(1 + channels, blocks, LANES, dtype=float_dtype(), device=device)
        transmittance = torch.empty(blocks, LANES, dtype=float_dtype(), device=device)
        last, front = (torch.empty(blocks, LANES, dtype=torch.int32, device=device) for _ in range(2))
        visible = torch.zeros(projection.padded, dtype=torch.uint8, device=device)
        space = Workspace.of(projection, lists)
        _rasterize_forward(
            by_sums(projection.record), lists.start, lists.pairs,
            *size, tile, torch.zeros(1, dtype=torch.int32, device=device),
            by_sums(space.near), space.near, space.number, space.items,
            values, transmittance, last, front, visible, channels,
        )  # fmt: skip
        ctx.projection, ctx.lists, ctx.size = projection, lists, size
        ctx.transmittance, ctx.last = transmittance, last
        planes = from_blocks(values, size, tile)
        alpha = 1 - from_blocks(transmittance[None], size, tile)[0]
        dominant = from_blocks(front[None], size, tile)[0].contiguous()
        visible = visible[:count].bool()
        ctx.mark_non_differentiable(visible, dominant)
        return planes[1:].permute(1, 2, 0), planes[0], alpha, visible, dominant

    @staticmethod
    def backward(ctx, grad_image, grad_depth, grad_alpha, _visible, _dominant):
        projection: Projection = ctx.projection
        lists: TileLists = ctx.lists
        grad_values = to_blocks(torch.cat([grad_depth[None], grad_image.permute(2, 0, 1)]), lists.tile)
        grad_rest = to_blocks(grad_alpha[None], lists.tile)[0]
        slot_grad = lists.new_slots(projection)
        space = Workspace.of(projection, lists)
        _rasterize_backward(
            by_sums(projection.record), lists.start, lists.pairs,
            *ctx.size, lists.tile, torch.zeros(1, dtype=torch.int32, device=slot_grad.device),
            ctx.transmittance, ctx.last, grad_values, grad_rest,
            by_sums(space.near), space.near, by_sums(space.near_grad), space.number, space.items,
            by_sums(slot_grad), projection.channels,
        )  # fmt: skip
        gradients, grad_poses = project_backward(projection, slot_grad)
        return *gradients, grad_poses[0], None, None, None, None


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
    check_gaussians(means, quats, scales, opacities, colors)
    check_shape("T_camera_world", T_camera_world, (4, 4))
    check_tile(tile, size)
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


def check_tile(tile: int, size: tuple[int, int]) -> None:
    """Raise ValueError unless the image can be cut into tiles of that size."""
    smallest = BLOCK * max(-(-max(size) // (BLOCK * MAX_TILES)), 1)
    if tile < smallest or tile % BLOCK:
        raise ValueError(f"tile: expected a multiple of {BLOCK} of at least {smallest}, got {tile}")
    if max(size) >= BLOCK * HALF:
        raise ValueError(f"size: expected less than {BLOCK * HALF} pixels across and down, got {size}")


def check_gaussians(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> None:
    """Raise ValueError unless the shapes belong together."""
    n = means.shape[0]
    for name, tensor, shape in (
        ("means", means, (None, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)),
        ("colors", colors, (n, None)),
    ):
        check_shape(name, tensor, shape)
