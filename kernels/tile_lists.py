"""Lists the Gaussians that each tile of pixels draws, front to back.

All drawn Gaussians are sorted by depth once. A stable counting sort then lists them by tile in that order.
Every (Gaussian, tile) pair has a slot of its own for its gradient; the slots of a Gaussian are contiguous.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.projection import NOT_DRAWN, Projection, gradient_size, unpack_tiles
from edslam_ti.kernels.runtime import CHUNK, workers

RADIX_BITS = 11  # three digits hold the 31 bits of a positive float
RADIX = 2**RADIX_BITS


@ti.kernel
def _sort_by_depth(
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [N]
    keys: ti.types.ndarray(ti.i32, ndim=2),  # scratch [2, N] depth bits
    order: ti.types.ndarray(ti.i32, ndim=2),  # [2, N] Gaussians; out: row 1, the drawn ones by depth
    digits: ti.types.ndarray(ti.i32, ndim=2),  # scratch [3, RADIX]
    numbers: ti.types.ndarray(ti.i32, ndim=1),  # out [2]: [0] drawn Gaussians
):
    # A stable radix sort in three passes; an unstable sort would not be reproducible for equal depths.
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
        numbers[0] = n
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
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [N]
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [N + 1]
    padded: ti.i32,  # Gaussians of a view
    columns: ti.i32,  # of tiles
    tiles: ti.i32,  # of a view
    # scratch
    places: ti.types.ndarray(ti.i32, ndim=2),  # [workers, V * tiles]
    # outputs
    numbers: ti.types.ndarray(ti.i32, ndim=1),  # [2]: [0] drawn Gaussians (in), [1] longest list
    tile_start: ti.types.ndarray(ti.i32, ndim=1),  # [V * tiles + 1]
    pairs: ti.types.ndarray(ti.i32, ndim=2),  # [P, 2] Gaussian and slot, by tile and then by depth
):
    # A stable counting sort: workers take consecutive parts of the order, first to count and then to fill.
    num_workers, num_lists = places.shape[0], places.shape[1]
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, n = chunk // CHUNK, numbers[0]
            for t in range(num_lists):
                places[w, t] = 0
            for rank in range(n * w // num_workers, n * (w + 1) // num_workers):
                g = order[1, rank]
                first = g // padded * tiles
                left, right, top, bottom = unpack_tiles(packed_tiles[g])
                for row in range(top, bottom + 1):
                    for t in range(first + row * columns + left, first + row * columns + right + 1):
                        places[w, t] = places[w, t] + 1
    ti.loop_config(serialize=True)
    for _ in range(1):
        total, longest = 0, 0
        for t in range(num_lists):
            start = total
            tile_start[t] = start
            for w in range(num_workers):
                number = places[w, t]
                places[w, t] = total
                total += number
            longest = ti.max(longest, total - start)
        tile_start[num_lists] = total
        numbers[1] = longest
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, n = chunk // CHUNK, numbers[0]
            for rank in range(n * w // num_workers, n * (w + 1) // num_workers):
                g = order[1, rank]
                first = g // padded * tiles
                left, right, top, bottom = unpack_tiles(packed_tiles[g])
                s = first_slot[g]
                for row in range(top, bottom + 1):
                    for t in range(first + row * columns + left, first + row * columns + right + 1):
                        place = places[w, t]
                        places[w, t] = place + 1
                        pairs[place, 0], pairs[place, 1] = g, s
                        s += 1


@dataclass(frozen=True)
class TileLists:
    """The Gaussians that each tile draws: pairs[start[t] : start[t + 1]] are those of tile t."""

    tile: int  # pixels
    start: Tensor  # [V * tiles + 1] int32
    pairs: Tensor  # [P, 2] int32 Gaussian and slot, front to back
    longest: int  # list

    def new_slots(self, projection: Projection) -> Tensor:  # [P, gradient_size(C)]
        """Return memory for one gradient per pair."""
        return projection.record.new_empty(len(self.pairs), gradient_size(projection.channels))


def list_pairs(projection: Projection, size: tuple[int, int], tile: int) -> TileLists:
    """Return the lists of all tiles of all views."""
    n, device = len(projection.depth_bits), projection.depth_bits.device

    def integers(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.int32, device=device)

    order, numbers = integers(2, n), integers(2)
    _sort_by_depth(projection.depth_bits, integers(2, n), order, integers(3, RADIX), numbers)
    columns, rows = (-(-pixels // tile) for pixels in size)
    num_lists = len(projection.poses) * columns * rows
    start = integers(num_lists + 1)
    pairs = integers(max(int(projection.first_slot[-1]), 1), 2)
    _list_pairs(
        order, projection.packed_tiles, projection.first_slot,
        max(projection.padded, 1), columns, columns * rows,
        integers(workers(), num_lists), numbers, start, pairs,
    )  # fmt: skip
    return TileLists(tile, start, pairs, int(numbers[1]))
