"""Depth images: reduction, filling of holes, and detection of edges between surfaces.

Depth is in metres, 0 = missing. Five functions test whether pixels belong to the same surface. They compare
different quantities and fear different mistakes, so their limits differ. All are shares of the depth:

    halving for the tracker       range of 2 x 2 depths          HALVED_RANGE
    reducing for brightness       range of a block's depths      REDUCED_RANGE
    denser Gaussians at outlines  second difference              OUTLINE_STEP
    normals of new Gaussians      second difference              SMOOTH_STEP
    fusing rendered depth         difference of two neighbours   FUSED_STEP

Kernels test the same of warped points, with constants of their own (`SAME_SURFACE` and `OCCLUDED` in
`kernels/brightness_image.py`, `MAX_SLOPE` in `kernels/patch_warp.py`, `DepthAgreement` in
`kernels/depth_average.py`, the setting `max_depth_difference` in metres), because noise and errors of the
pose matter there, too.
"""

import cv2
import numpy as np

from edslam_ti.kernels.brightness_image import SAME_SURFACE

# Largest range in 2 x 2 pixels: tracking has no use for steeper slopes, and a mean across an edge lies on no
# surface.
HALVED_RANGE = 0.05
# Largest range in a block: the solver accepts SAME_SURFACE to either side of its mean.
REDUCED_RANGE = 2 * SAME_SURFACE
# Beyond this neighbours are two surfaces. Slanted surfaces stay below, since a plane has hardly any second
# difference. A false alarm costs a few Gaussians, a miss gives a ragged outline.
OUTLINE_STEP = 0.03
# Below this the neighbours on both sides give a normal. This limit is stricter, because a wrong normal tilts
# a disc out of the surface; a missing normal only leaves it facing the camera.
SMOOTH_STEP = 0.02
# Beyond this a pixel of a rendered view may lie between two surfaces. Slopes of up to 5 % a pixel are kept.
FUSED_STEP = 0.05

# From that share of measured pixels on beside missing ones depth is sparse (lines of a lidar, fields of an
# interlaced image, random pixels). Kinect-like images: 0.12, real ones 0.02, depth along edges 0.2 to 0.64.
SPARSE_SHARE = 0.7
# In sparse depth gaps are bridged that are as long as most of them: longer ones are holes, as windows are.
USUAL_GAPS = 90  # percentile of their lengths
LONGEST_GAP = 0.15  # of the image's height
# Two ends of a gap lie on one surface if they, or their continuations, differ by less than this share.
BRIDGED_STEP = 0.03

HOLE_WIDTH = 9  # px; narrower holes in depth are not filled
FAR_SIDE = 90  # percentile of the depth around a hole
BEHIND = 1.25  # times that depth is assumed in the hole: if too near, it would hide surfaces measured later


def downscaled(image: np.ndarray) -> np.ndarray:  # [H, W] -> [H / 2, W / 2]
    """Return the means of 2x2 blocks; odd edges are cut off."""
    a, b, c, d = _corners(image)
    mean: np.ndarray = image.dtype.type(0.25) * (a + b + c + d)
    return mean


def downscaled_depth(depth: np.ndarray) -> np.ndarray:  # [H, W] -> [H / 2, W / 2]
    """Return means of 2x2 blocks where all four depths exist and lie on one surface, else 0 (missing)."""
    a, b, c, d = _corners(depth)
    low = np.minimum(np.minimum(a, b), np.minimum(c, d))
    high = np.maximum(np.maximum(a, b), np.maximum(c, d))
    return np.where(_is_one_surface(low, high, HALVED_RANGE), 0.25 * (a + b + c + d), np.float32(0))


def block_means(image: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, W / r] float32
    """Return the means of blocks of reduction x reduction pixels, odd edges cut off.

    `reduction` 1 returns the image itself. Of 2, means may differ from `downscaled` in the last bit.
    """
    return image if reduction == 1 else _blocks(image, reduction).mean((1, 3), dtype=np.float32)


def block_depth(depth: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, W / r]
    """Return block means where all depths of a block exist and lie on one surface, else 0 (missing)."""
    if reduction == 1:
        return depth
    blocks = _blocks(depth, reduction)
    low, high = blocks.min((1, 3)), blocks.max((1, 3))
    return np.where(_is_one_surface(low, high, REDUCED_RANGE), blocks.mean((1, 3)), 0)


def measured_means(depth: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, W / r]
    """Return means of the depths that exist in a block and lie on one surface, else 0 (missing).

    Unlike `block_depth` it keeps blocks that are partly measured: lines of a lidar, rims of holes.
    """
    if reduction == 1:
        return depth
    blocks = _blocks(depth, reduction)
    exist = blocks > 0
    low, high = np.where(exist, blocks, np.inf).min((1, 3)), blocks.max((1, 3))
    mean = blocks.sum((1, 3)) / np.maximum(exist.sum((1, 3)), 1)
    return np.where(_is_one_surface(low, high, REDUCED_RANGE) & (high > 0), mean, 0)


def beside_steps(
    depth: np.ndarray,  # [H, W] metres, 0 = missing
) -> np.ndarray:  # [H, W] bool
    """Return the pixels next to which depth jumps or ends; slanted surfaces are not marked."""
    padded = np.pad(depth, 1, mode="reflect", reflect_type="odd")  # continue the slope
    across = padded[1:-1, :-2] + padded[1:-1, 2:] - 2 * depth
    down = padded[:-2, 1:-1] + padded[2:, 1:-1] - 2 * depth
    return np.maximum(np.abs(across), np.abs(down)) > OUTLINE_STEP * depth


def is_smooth(
    before: np.ndarray,  # metres, 0 = missing, of the neighbours on one side
    depth: np.ndarray,  # of the pixels
    after: np.ndarray,  # of the neighbours on the other side
) -> np.ndarray:  # bool
    """Return where all three depths exist and lie on one smooth surface."""
    exist = (before > 0) & (depth > 0) & (after > 0)
    return exist & (np.abs(before + after - 2 * depth) < SMOOTH_STEP * depth)


def beside_edges(
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    relative_step: float,  # of neighbouring depths, as a share of the nearer one
) -> np.ndarray:  # [H, W] bool
    """Return the pixels on both sides of a depth step between neighbours, or of the end of depth."""
    edge = np.zeros(depth.shape, bool)
    for a, b, at_a, at_b in (
        (depth[:-1], depth[1:], edge[:-1], edge[1:]),
        (depth[:, :-1], depth[:, 1:], edge[:, :-1], edge[:, 1:]),
    ):
        step = np.abs(a - b) > relative_step * np.minimum(a, b)
        at_a |= step
        at_b |= step
    return edge


def without_depth_edges(
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    relative_step: float = FUSED_STEP,
) -> np.ndarray:  # [H, W] metres
    """Return depth without the pixels on both sides of a step between neighbours.

    Rendered depth is a mean over a pixel's area. At a depth edge it lies between two surfaces, and fusing it
    would connect them.
    """
    return np.where(beside_edges(depth, relative_step), 0, depth)


def with_holes_filled(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
    """Return depth with large holes filled slightly behind the far side of their surroundings.

    A sensor measures nothing in windows and beyond its range, but a surface exists there, and it is not in
    front. Narrow holes (shadows of the sensor's projector, noise at edges) stay: other views measure them.
    """
    missing = (depth <= 0).astype(np.uint8)
    holes = cv2.morphologyEx(missing, cv2.MORPH_OPEN, np.ones((HOLE_WIDTH, HOLE_WIDTH), np.uint8))
    filled = depth.copy()
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(holes)
    reach = 2 * (HOLE_WIDTH // 2) + 1  # more than the opening removes at the rim
    for label in range(1, number):
        left, top, width, height, _ = boxes[label]
        box = np.s_[max(top - reach, 0) : top + height + reach, max(left - reach, 0) : left + width + reach]
        hole = (labels[box] == label).astype(np.uint8)
        near = cv2.dilate(hole, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        around = depth[box][near & (depth[box] > 0)]
        if len(around):
            gap = near & (depth[box] <= 0)
            filled[box][gap] = BEHIND * np.percentile(around, FAR_SIDE)
    return filled


def with_gaps_filled(
    depth: np.ndarray,  # [H, W] float32 metres, 0 = missing
) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
    """Return sparse depth with the gaps between measured pixels filled; dense depth comes back as it is.

    Missing rows, columns or single pixels are filled along columns and rows, linearly in inverse depth, as
    planes are. Gaps between two surfaces stay, and gaps longer than usual ones in the image.
    """
    measured = depth > 0
    if not is_sparse(measured):
        return depth
    lengths = [_gaps(mask)[1] for mask in (measured, measured.T)]
    usual = [np.percentile(n, USUAL_GAPS) for n in lengths if len(n)]
    if not usual:
        return depth
    longest = min(int(min(usual)), int(LONGEST_GAP * depth.shape[0]))
    with np.errstate(divide="ignore"):
        inverse_depth = np.where(measured, np.float32(1) / depth, np.float32(0))
    for _ in range(2):  # a grid of points becomes lines first
        inverse_depth = _bridged(inverse_depth, longest)
    filled = np.zeros_like(depth)
    np.divide(np.float32(1), inverse_depth, out=filled, where=inverse_depth > 0)
    return np.where(measured, depth, filled)


def is_sparse(measured: np.ndarray) -> bool:  # [H, W] bool
    """Return whether depth is missing beside so many measured pixels that it is missing everywhere."""
    padded = np.pad(measured, 1, mode="edge")
    inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    number = np.count_nonzero(measured)
    return bool(np.count_nonzero(measured & ~inside) > SPARSE_SHARE * number)


def _bridged(inverse_depth: np.ndarray, longest: int) -> np.ndarray:  # [H, W] 1 / m, 0 = missing
    """Return inverse depth with gaps of up to so many pixels filled along rows and columns.

    Where both directions fill a pixel, the shorter gap does.
    """
    across, across_length = _bridged_along_rows(inverse_depth, longest)
    down, down_length = (a.T for a in _bridged_along_rows(np.ascontiguousarray(inverse_depth.T), longest))
    filled = np.where(down_length < across_length, down, across)
    both = (down_length == across_length) & (down > 0)
    filled[both] = 0.5 * (down + across)[both]
    return np.where(inverse_depth > 0, inverse_depth, filled)


def _bridged_along_rows(
    inverse_depth: np.ndarray, longest: int
) -> tuple[np.ndarray, np.ndarray]:  # [H, W] 1 / m, 0 = not filled; [H, W] length of the gap, px
    """Return what gaps in rows are filled with where their ends lie on one surface."""
    width, flat = inverse_depth.shape[1], inverse_depth.ravel()
    filled, length = np.zeros_like(flat), np.full(flat.shape, np.iinfo(np.int32).max, np.int32)
    at, gap_lengths = _gaps(inverse_depth > 0)
    pixels = np.flatnonzero(flat)  # measured
    short = gap_lengths <= longest
    at, n = at[short], gap_lengths[short]
    first, last = pixels[at], pixels[at + 1]
    a, b = flat[first], flat[last]
    before, after = _slopes(flat, pixels, width)
    is_one = np.abs(b - a) < BRIDGED_STEP * np.minimum(a, b)
    continued = np.abs(a + before[at] * (n + 1) - b) < BRIDGED_STEP * b
    continued &= np.abs(b - after[at + 1] * (n + 1) - a) < BRIDGED_STEP * a
    is_one |= continued  # not so for NaN
    first, a, b, n = first[is_one], a[is_one], b[is_one], n[is_one]
    step = _counted(n)  # 1, 2, ... in every gap
    target = np.repeat(first, n) + step
    filled[target] = np.repeat(a, n) + np.repeat((b - a) / (n + 1), n) * step
    length[target] = np.repeat(n, n)
    return filled.reshape(inverse_depth.shape), length.reshape(inverse_depth.shape)


def _slopes(
    flat: np.ndarray, pixels: np.ndarray, width: int
) -> tuple[np.ndarray, np.ndarray]:  # per pixel, of each measured pixel; NaN = no other in the row
    """Return the slopes at measured pixels to the measured one before and to the one after, in rows."""
    slope = np.diff(flat[pixels]) / np.diff(pixels)
    slope = np.where(np.diff(pixels // width) == 0, slope, np.float32(np.nan)).astype(np.float32)
    end = np.full(1, np.nan, np.float32)
    return np.concatenate([end, slope]), np.concatenate([slope, end])


def _gaps(measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [H, W] bool -> [N], [N]
    """Return the gaps between measured pixels of a row: which of them each follows, and lengths in pixels."""
    pixels = np.flatnonzero(measured)
    missing = np.diff(pixels) - 1
    at = np.flatnonzero((missing > 0) & (np.diff(pixels // measured.shape[1]) == 0))
    return at, missing[at]


def _counted(numbers: np.ndarray) -> np.ndarray:  # [N] -> [sum of them]
    """Return 1, 2, ... up to each of the numbers, one after the other."""
    ends = np.cumsum(numbers)
    return np.arange(1, (ends[-1] if len(ends) else 0) + 1) - np.repeat(ends - numbers, numbers)


def _corners(image: np.ndarray) -> list[np.ndarray]:  # four [H / 2, W / 2]
    """Return the four pixels that form each pixel of the image at half size."""
    h, w = (n // 2 for n in image.shape)
    return [image[y : 2 * h : 2, x : 2 * w : 2] for y in (0, 1) for x in (0, 1)]


def _blocks(image: np.ndarray, reduction: int) -> np.ndarray:  # [H, W] -> [H / r, r, W / r, r]
    h, w = image.shape[0] // reduction, image.shape[1] // reduction
    return image[: h * reduction, : w * reduction].reshape(h, reduction, w, reduction)


def _is_one_surface(low: np.ndarray, high: np.ndarray, share: float) -> np.ndarray:
    """Return where the least and the largest depth of a block exist and differ by less than a share."""
    return (low > 0) & (high - low < share * high)
