"""Alpha compositing of projected Gaussians (Eq. 8), forward and backward.

    I(x) = sum_i c_i alpha_i T_i,   D(x) = sum_i d_i alpha_i T_i,   A(x) = 1 - T_end
    T_i = prod_{j<i} (1 - alpha_j),   alpha_i = o_i exp(-1/2 d_i^T K_i d_i)

Every tile of pixels has its list of Gaussians, front to back (kernels.tile_lists). On a CPU one worker owns
a tile: it copies the list's records into memory that stays in its cache, and lists them for each block of
4 x 4 pixels that their ellipses reach. The pixels of a block are the lanes of a vector (kernels.lanes). Their
state stays in registers while the worker traverses the block's list; pixels that an ellipse does not reach,
or that are finished, are masked out. The backward pass traverses the same lists in reverse. Each (Gaussian,
tile) pair has a private slot for its gradient, and the slots of a Gaussian are summed in a fixed order. So no
atomics are needed, and every run gives the same bits. On a GPU every pixel is a thread
(kernels.rasterization_gpu).

Images are stored by blocks inside the kernels: [..., tiles * blocks, LANES].

Eq. 8's depth is a sum weighted by alpha; divide by alpha for an expected depth.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.kernels import rasterization_gpu
from edslam_ti.kernels.compositing import (
    clear,
    draw,
    draw_backward,
    fill_slots,
    lane_columns,
    lane_rows,
    list_blocks,
)
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, integer_lanes, lanes, sums, vector_instructions
from edslam_ti.kernels.projection import (
    BLOCK,
    HALF,
    LOW_PASS,
    MAX_TILES,
    Projection,
    by_sums,
    gradient_size,
    project,
    project_backward,
)
from edslam_ti.kernels.runtime import CHUNK, check_shape, float_dtype, is_gpu, plain, workers
from edslam_ti.kernels.tile_lists import TileLists, list_pairs

TILE = 32  # pixels; a multiple of the blocks


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


@dataclass(frozen=True)
class Workspace:
    """Memory for the tiles that workers process."""

    near: Tensor  # [workers * longest, record_size]
    near_grad: Tensor  # [workers * longest, gradient_size]
    number: Tensor  # [workers, blocks of a tile] int32
    items: Tensor  # [workers, blocks of a tile, longest] int32

    @staticmethod
    def of(projection: Projection, lists: TileLists, num_views: int = 1) -> "Workspace":
        """Return memory for the tiles processed at once, `num_views` per worker."""
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
    """Return images by tiles and blocks, padded with zeros."""
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
        ctx,
        means,
        quats,
        scales,
        opacities,
        colors,
        T_camera_world,
        intrinsics,
        size,
        tile,
        low_pass,
        pixelwise,
    ):
        count, channels, device = len(means), colors.shape[1], means.device
        pose = plain("T_camera_world", T_camera_world)[None]
        inputs = (means, quats, scales, opacities, colors, pose, intrinsics, size, tile, low_pass)
        projection = rasterization_gpu.project(*inputs) if pixelwise else project(*inputs)
        lists = (rasterization_gpu.list_pairs if pixelwise else list_pairs)(projection, size, tile)
        blocks = (len(lists.start) - 1) * (tile // BLOCK) ** 2
        drawn = torch.empty(2 + channels, blocks, LANES, dtype=float_dtype(), device=device)
        values, transmittance = drawn[:-1], drawn[-1]
        last, front = (torch.empty(blocks, LANES, dtype=torch.int32, device=device) for _ in range(2))
        visible = torch.zeros(projection.padded, dtype=torch.uint8, device=device)
        if pixelwise:
            rasterization_gpu.draw_lists(projection, lists, size, values, transmittance, last, front, visible)
        else:
            space = Workspace.of(projection, lists)
            _rasterize_forward(
                by_sums(projection.record), lists.start, lists.pairs,
                *size, tile, torch.zeros(1, dtype=torch.int32, device=device),
                by_sums(space.near), space.near, space.number, space.items,
                values, transmittance, last, front, visible, channels,
            )  # fmt: skip
        ctx.projection, ctx.lists, ctx.size, ctx.pixelwise = projection, lists, size, pixelwise
        ctx.transmittance, ctx.last = transmittance, last
        planes = from_blocks(drawn, size, tile)
        dominant = from_blocks(front[None], size, tile)[0].contiguous()
        visible = visible[:count].bool()
        ctx.mark_non_differentiable(visible, dominant)
        return planes[1:-1].permute(1, 2, 0), planes[0], 1 - planes[-1], visible, dominant

    @staticmethod
    def backward(ctx, grad_image, grad_depth, grad_alpha, _visible, _dominant):
        projection: Projection = ctx.projection
        lists: TileLists = ctx.lists
        grad_images = torch.cat([grad_depth[None], grad_image.permute(2, 0, 1), grad_alpha[None]])
        grad_drawn = to_blocks(grad_images, lists.tile)
        grad_values, grad_rest = grad_drawn[:-1], grad_drawn[-1]
        if ctx.pixelwise:
            slot_grad = rasterization_gpu.draw_lists_backward(
                projection, lists, ctx.size[0], ctx.transmittance, ctx.last, grad_values, grad_rest
            )
            gradients, grad_poses = rasterization_gpu.project_backward(projection, slot_grad)
            return *gradients, grad_poses[0], *[None] * 5
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
        return *gradients, grad_poses[0], *[None] * 5


def rasterize(
    means: Tensor,  # [N, 3] metres, world frame
    quats: Tensor,  # [N, 4] wxyz, need not be normalised
    scales: Tensor,  # [N, 3] metres
    opacities: Tensor,  # [N] in (0, 1)
    colors: Tensor,  # [N, C]
    T_camera_world: Tensor,  # [4, 4]
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy; pixel centres at integers
    size: tuple[int, int],  # (width, height)
    tile: int | None = None,  # pixels; None: the default of the CPU or GPU path
    low_pass: float = LOW_PASS,  # px^2 added to every 2D covariance; less in a view of reduced size
    pixelwise: bool | None = None,  # a pixel per thread instead of blocks of them; None: on a GPU
) -> Rasterization:
    """Render Gaussians: colours, depth and alpha, differentiable in all tensor arguments.

    Eq. 7-8. The gradient of the pose is with respect to the 12 entries of [R | t]; chain it to a
    twist through the function that made the matrix. Raises ValueError on wrong shapes.
    """
    check_gaussians(means, quats, scales, opacities, colors)
    check_shape("T_camera_world", T_camera_world, (4, 4))
    if pixelwise is None:
        pixelwise = is_gpu()
    if tile is None:
        tile = rasterization_gpu.TILE if pixelwise else TILE
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
        pixelwise,
    )
    return Rasterization(*outputs)


def check_tile(tile: int, size: tuple[int, int]) -> None:
    """Raise ValueError unless the image can be divided into tiles of this size."""
    smallest = BLOCK * max(-(-max(size) // (BLOCK * MAX_TILES)), 1)
    if tile < smallest or tile % BLOCK:
        raise ValueError(f"tile: expected a multiple of {BLOCK} of at least {smallest}, got {tile}")
    if max(size) >= BLOCK * HALF:
        raise ValueError(f"size: expected less than {BLOCK * HALF} pixels across and down, got {size}")


def check_gaussians(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> None:
    """Raise ValueError unless the shapes agree."""
    n = means.shape[0]
    for name, tensor, shape in (
        ("means", means, (None, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)),
        ("colors", colors, (n, None)),
    ):
        check_shape(name, tensor, shape)
