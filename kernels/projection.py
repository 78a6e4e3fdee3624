"""3D Gaussians to 2D ellipses (Eq. 6-7), forward and backward, with the gradient of the camera pose.

For one Gaussian with mean mu, rotation R(q) and scales s, seen from T_camera_world = [R_c | t_c]:

    p  = R_c mu + t_c                             camera frame, metres
    m  = (f_x p_x / p_z + c_x, f_y p_y / p_z + c_y)     pixels
    W  = J R_c,  J = [f_x/p_z, 0, -f_x p_x/p_z^2;  0, f_y/p_z, -f_y p_y/p_z^2]
    A  = W L,    L = R(q) diag(s)                 [2, 3]
    S' = A A^T + low_pass I                       Eq. 7, with the usual low-pass filter, 0.3 px^2
    K  = S'^-1                                    the conic: alpha = o exp(-1/2 d^T K d), Eq. 8

One map is projected into several views at once. Gaussian i of view v is entry v * padded + i of the results,
and everything after projection (sorting, lists, slots) treats the views as one. The parameters are stored by
rows [ROWS, padded], so that on a CPU the same component of LANES Gaussians is one vector; on a GPU the same
functions work on one Gaussian per thread.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import (
    LANES,
    SUMS,
    join_columns,
    lanes,
    largest,
    split_columns,
    sums,
    vector_instructions,
)
from edslam_ti.kernels.runtime import CHUNK, float_dtype, plain, workers

LOW_PASS = 0.3  # px^2 added to the 2D covariance at full size (Kerbl et al. 2023)
MIN_ALPHA = 1.0 / 255.0  # a Gaussian ends where its alpha falls below this
NOT_DRAWN = -1  # in place of the depth bits, which are positive
MARGIN = 0.3  # of the image's size: farther outside, the affine approximation is useless
BLOCK = 4  # pixels across and down that a CPU handles at once: LANES of them
SPANS = 6  # rows of blocks for which the exact extent of an ellipse is kept; for more rows, its box
HALF = 4096  # a * HALF + b holds two counts of blocks in one float
MAX_TILES = 256  # across and down; first and last tile column and row of a Gaussian fit into one integer
SLACK = 0.01  # pixels around an ellipse, so that rounding removes no pixel from its lists
PART = 32  # groups of lanes that share a partial sum of the pose gradient, added in float64

# Rows of the Gaussians' parameters [ROWS + C, padded], then the colours
MEAN, QUAT, SCALE, OPACITY, COLOR = 0, 3, 7, 10, 11
# Columns of the projected record; the features are the depth and the colours
MEAN_X, MEAN_Y, HALF_K_XX, K_XY, HALF_K_YY, EXTENT, FEATURES = range(7)
# and, from gradient_size(C) on, the blocks it touches: columns, rows, and columns in each of SPANS rows
COLUMNS, ROWS, SPAN = range(3)
# Columns of the record's gradient: sums over pixels of v = dL / d ln(alpha), and of v times distances d
V_SUM, V_X, V_Y, V_XX, V_XY, V_YY, GRAD_FEATURES = range(7)


def gradient_size(channels: int) -> int:
    """Return the numbers in the gradient of a record, GRAD_FEATURES + 1 + C, rounded up."""
    return SUMS * ((GRAD_FEATURES + channels) // SUMS + 1)


def record_size(channels: int) -> int:
    """Return the numbers in a record: FEATURES + 1 + C, rounded up, and the blocks."""
    return gradient_size(channels) + SPAN + SPANS


@ti.func
def once(x):
    """Return x in a variable; Taichi would otherwise compute an entry of a list at every use."""
    return x


@ti.func
def quaternion_inverse_norm(gaussians: ti.template(), i):
    w, x = gaussians[QUAT, i], gaussians[QUAT + 1, i]
    y, z = gaussians[QUAT + 2, i], gaussians[QUAT + 3, i]
    return 1.0 / ti.sqrt(w * w + x * x + y * y + z * z)


@ti.func
def rotation_of(w, x, y, z):
    """The nine entries of the rotation matrix of a unit quaternion, by rows."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@ti.func
def ellipses(gaussians: ti.template(), i, poses: ti.template(), v, fx, fy, cx, cy, low_pass):
    """m_x, m_y, p_z, and the entries xx, xy, yy of S' for Gaussian(s) i in view v; unseen if p_z <= NEAR."""
    R_c = [[poses[v, a, b] for b in range(3)] for a in range(3)]
    mean = [gaussians[MEAN + k, i] for k in range(3)]
    p = [
        once(R_c[a][0] * mean[0] + R_c[a][1] * mean[1] + R_c[a][2] * mean[2] + poses[v, a, 3])
        for a in range(3)
    ]
    z = p[2]
    inverse_z = 1.0 / ti.select(z > NEAR, z, 1.0)
    q = quaternion_inverse_norm(gaussians, i)
    R = rotation_of(
        gaussians[QUAT, i] * q,
        gaussians[QUAT + 1, i] * q,
        gaussians[QUAT + 2, i] * q,
        gaussians[QUAT + 3, i] * q,
    )
    j00, j11 = fx * inverse_z, fy * inverse_z
    u, w = j00 * p[0], j11 * p[1]
    j02, j12 = (0.0 - u) * inverse_z, (0.0 - w) * inverse_z
    cov_xx, cov_xy, cov_yy = z * 0.0 + low_pass, z * 0.0, z * 0.0 + low_pass
    W = [[once(j00 * R_c[0][m] + j02 * R_c[2][m]), once(j11 * R_c[1][m] + j12 * R_c[2][m])] for m in range(3)]
    for k in ti.static(range(3)):
        a = (W[0][0] * R[k] + W[1][0] * R[3 + k] + W[2][0] * R[6 + k]) * gaussians[SCALE + k, i]
        b = (W[0][1] * R[k] + W[1][1] * R[3 + k] + W[2][1] * R[6 + k]) * gaussians[SCALE + k, i]
        cov_xx += a * a
        cov_xy += a * b
        cov_yy += b * b
    return u + cx, w + cy, z, cov_xx, cov_xy, cov_yy


@ti.func
def first_and_last(low, high, size):
    """The first and last pixel in [low, high], of a row or column of `size`; first > last: none."""
    first, last = ti.ceil(low - SLACK), ti.floor(high + SLACK)
    return ti.select(first > 0.0, first, 0.0), ti.select(last < size - 1.0, last, size - 1.0)


@ti.func
def is_near_image(x, y, width, height):
    """Whether a mean is near enough to the image for the affine approximation of Eq. 7."""
    return (
        (x > -MARGIN * width) & (x < (1 + MARGIN) * width)
        & (y > -MARGIN * height) & (y < (1 + MARGIN) * height)
    )  # fmt: skip


@ti.func
def reached_columns(a, b, x, slope, p, q, r, extent, width, is_drawn):
    """First * HALF + last column of blocks that ellipses reach between heights a and b above their means.

    The ellipse is p dx^2 + q dx dy + r dy^2 = extent around the column x. Its rightmost point is at the
    height `slope`, its leftmost at -slope: between a and b, the outermost ones are at the nearest heights.
    """
    low, high = (0.0 - slope), slope
    low = ti.select(low < a, a, low)
    low = ti.select(low > b, b, low)
    high = ti.select(high < a, a, high)
    high = ti.select(high > b, b, high)
    root_low = q * q * low * low - 4.0 * p * (r * low * low - extent)
    root_high = q * q * high * high - 4.0 * p * (r * high * high - extent)
    inverse = 0.5 / ti.select(is_drawn, p, 1.0)
    reach_low = (ti.sqrt(ti.select(root_low > 0.0, root_low, 0.0)) + q * low) * inverse
    reach_high = (ti.sqrt(ti.select(root_high > 0.0, root_high, 0.0)) - q * high) * inverse
    begin, end = first_and_last(x - reach_low, x + reach_high, width)
    is_reached = is_drawn & (begin <= end)
    begin = ti.select(is_reached, ti.floor(begin / BLOCK), 1.0)
    return begin * HALF + ti.select(is_reached, ti.floor(end / BLOCK), 0.0)


@ti.func
def unpack_tiles(packed):
    """First and last tile column, first and last tile row."""
    return (packed >> 24) & 255, (packed >> 16) & 255, (packed >> 8) & 255, packed & 255


@ti.func
def differentiate(
    # inputs
    gaussians: ti.template(), i, poses: ti.template(), fx, fy, low_pass,
    gradient_2d: ti.template(),  # [gradient_size(C) + 1, V * n]; last row: 1 where any is nonzero
    # outputs
    gradient: ti.template(),  # [COLOR + C, n]
    pose_parts: ti.template(), part,  # [V, parts, 12] rows of [dR | dt], added to
    C: ti.template(),
):  # fmt: skip
    """Gradients of Gaussian(s) i and of the poses from those of the records in all views."""
    n = gaussians.shape[1]
    zero = gaussians[MEAN, i] * 0.0
    mean = [gaussians[MEAN + k, i] for k in range(3)]
    scale = [gaussians[SCALE + k, i] for k in range(3)]
    inverse_norm = quaternion_inverse_norm(gaussians, i)
    q = [once(gaussians[QUAT + k, i] * inverse_norm) for k in range(4)]
    R = rotation_of(q[0], q[1], q[2], q[3])
    L = [[once(R[3 * m + k] * scale[k]) for k in range(3)] for m in range(3)]
    dL = [[once(zero) for k in range(3)] for m in range(3)]
    dmean = [once(zero) for _ in range(3)]
    dopacity = once(zero)
    dcolor = [once(zero) for _ in range(C)]
    for v in range(poses.shape[0]):
        at = v * n + i
        g = [once(gradient_2d[k, at]) for k in range(GRAD_FEATURES + 1)]
        R_c = [[poses[v, a, b] for b in range(3)] for a in range(3)]
        p = [
            once(R_c[a][0] * mean[0] + R_c[a][1] * mean[1] + R_c[a][2] * mean[2] + poses[v, a, 3])
            for a in range(3)
        ]
        drawn = gradient_2d[ti.static(gradient_size(C)), at] > 0.0
        inverse_z = 1.0 / ti.select(drawn, p[2], 1.0)
        j00, j11 = fx * inverse_z, fy * inverse_z
        j02, j12 = (0.0 - j00) * p[0] * inverse_z, (0.0 - j11) * p[1] * inverse_z
        W0 = [once(j00 * R_c[0][m] + j02 * R_c[2][m]) for m in range(3)]
        W1 = [once(j11 * R_c[1][m] + j12 * R_c[2][m]) for m in range(3)]
        A0 = [once(W0[0] * L[0][k] + W0[1] * L[1][k] + W0[2] * L[2][k]) for k in range(3)]
        A1 = [once(W1[0] * L[0][k] + W1[1] * L[1][k] + W1[2] * L[2][k]) for k in range(3)]
        S_xx = A0[0] * A0[0] + A0[1] * A0[1] + A0[2] * A0[2] + low_pass
        S_xy = A0[0] * A1[0] + A0[1] * A1[1] + A0[2] * A1[2]
        S_yy = A1[0] * A1[0] + A1[1] * A1[1] + A1[2] * A1[2] + low_pass
        inverse_det = 1.0 / (S_xx * S_yy - S_xy * S_xy)
        K_xx, K_xy, K_yy = S_yy * inverse_det, (0.0 - S_xy) * inverse_det, S_xx * inverse_det
        # ln(alpha) = ln(o) - 1/2 d^T K d with d = pixel - m: dm = K sum v d, dK = -1/2 sum v d d^T
        dx, dy = K_xx * g[V_X] + K_xy * g[V_Y], K_xy * g[V_X] + K_yy * g[V_Y]
        dopacity += g[V_SUM]
        # dS' = -K dK K, written as N K / 2 with N = K sum v d d^T
        N_xx, N_xy = K_xx * g[V_XX] + K_xy * g[V_XY], K_xx * g[V_XY] + K_xy * g[V_YY]
        N_yx, N_yy = K_xy * g[V_XX] + K_yy * g[V_XY], K_xy * g[V_XY] + K_yy * g[V_YY]
        # dA = 2 dS' A, from S' = A A^T
        D_xx, D_xy, D_yy = (
            N_xx * K_xx + N_xy * K_xy, N_xx * K_xy + N_xy * K_yy, N_yx * K_xy + N_yy * K_yy,
        )  # fmt: skip
        dA0 = [once(D_xx * A0[k] + D_xy * A1[k]) for k in range(3)]
        dA1 = [once(D_xy * A0[k] + D_yy * A1[k]) for k in range(3)]
        dj00, dj02, dj11, dj12 = once(zero), once(zero), once(zero), once(zero)
        dR_c = [[once(zero) for b in range(3)] for a in range(3)]
        for m in ti.static(range(3)):
            for k in ti.static(range(3)):
                dL[m][k] += ti.select(drawn, W0[m] * dA0[k] + W1[m] * dA1[k], 0.0)  # A = W L
            dW0 = dA0[0] * L[m][0] + dA0[1] * L[m][1] + dA0[2] * L[m][2]
            dW1 = dA1[0] * L[m][0] + dA1[1] * L[m][1] + dA1[2] * L[m][2]
            dj00 += dW0 * R_c[0][m]  # W = J R_c
            dj02 += dW0 * R_c[2][m]
            dj11 += dW1 * R_c[1][m]
            dj12 += dW1 * R_c[2][m]
            dR_c[0][m] += j00 * dW0
            dR_c[1][m] += j11 * dW1
            dR_c[2][m] += j02 * dW0 + j12 * dW1
        # p enters through the mean m, the depth (a feature), and J
        dp0 = (dx - dj02 * inverse_z) * j00
        dp1 = (dy - dj12 * inverse_z) * j11
        dp2 = g[GRAD_FEATURES] + dx * j02 + dy * j12 - (dj00 * j00 + dj11 * j11) * inverse_z
        dp2 = dp2 - 2.0 * (dj02 * j02 + dj12 * j12) * inverse_z
        dp = [once(ti.select(drawn, d, 0.0)) for d in (dp0, dp1, dp2)]
        for a in ti.static(range(3)):
            for m in ti.static(range(3)):
                dmean[m] += R_c[a][m] * dp[a]  # p = R_c mu + t_c
                entry = ti.select(drawn, dR_c[a][m] + dp[a] * mean[m], 0.0)
                pose_parts[v, part, 4 * a + m] = pose_parts[v, part, 4 * a + m] + entry
            pose_parts[v, part, 4 * a + 3] = pose_parts[v, part, 4 * a + 3] + dp[a]
        for k in ti.static(range(C)):
            dcolor[k] += gradient_2d[GRAD_FEATURES + 1 + k, at]
    dR = [[once(dL[m][k] * scale[k]) for k in range(3)] for m in range(3)]  # L = R diag(s)
    w, x, y, z = q[0], q[1], q[2], q[3]
    dunit = [
        once(x * (dR[2][1] - dR[1][2]) + y * (dR[0][2] - dR[2][0]) + z * (dR[1][0] - dR[0][1])),
        once(y * (dR[1][0] + dR[0][1]) + z * (dR[2][0] + dR[0][2]) + w * (dR[2][1] - dR[1][2])
             - 2.0 * x * (dR[1][1] + dR[2][2])),
        once(x * (dR[1][0] + dR[0][1]) + z * (dR[2][1] + dR[1][2]) + w * (dR[0][2] - dR[2][0])
             - 2.0 * y * (dR[0][0] + dR[2][2])),
        once(x * (dR[2][0] + dR[0][2]) + y * (dR[2][1] + dR[1][2]) + w * (dR[1][0] - dR[0][1])
             - 2.0 * z * (dR[0][0] + dR[1][1])),
    ]  # fmt: skip
    along = w * dunit[0] + x * dunit[1] + y * dunit[2] + z * dunit[3]
    for k in ti.static(range(3)):
        gradient[MEAN + k, i] = dmean[k]
        gradient[SCALE + k, i] = dL[0][k] * R[k] + dL[1][k] * R[3 + k] + dL[2][k] * R[6 + k]
    for k in ti.static(range(4)):  # through the normalisation
        gradient[QUAT + k, i] = 2.0 * (dunit[k] - q[k] * along) * inverse_norm
    gradient[OPACITY, i] = dopacity / gaussians[OPACITY, i]
    for k in ti.static(range(C)):
        gradient[COLOR + k, i] = dcolor[k]


@vector_instructions
@ti.kernel
def _project_forward(
    # inputs
    means: lanes(1),  # [3 G] the lanes of [padded, 3]
    quats: lanes(1),  # [4 G]
    scales: lanes(1),  # [3 G]
    opacities: lanes(1),  # [G]
    colors: lanes(1),  # [C G]
    poses: ti.types.ndarray(ndim=3),  # [V, 4, 4] T_camera_world
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    low_pass: float,  # px^2
    num_workers: ti.i32,
    # outputs
    gaussians: lanes(2),  # [COLOR + C, G]
    record: ti.types.ndarray(ndim=2),  # [V * padded, record_size(C)]
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [V * padded] sorts as the depth, NOT_DRAWN where culled
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [V * padded] tiles touched
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [V * padded + 1] of every Gaussian, one slot a tile
    C: ti.template(),
):
    """Project LANES Gaussians at a time into all views, and count the tiles that each Gaussian touches."""
    groups = gaussians.shape[1]
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w = chunk // CHUNK
            for group in range(groups * w // num_workers, groups * (w + 1) // num_workers):
                split_columns(means, group, gaussians, MEAN, QUAT - MEAN)
                split_columns(quats, group, gaussians, QUAT, SCALE - QUAT)
                split_columns(scales, group, gaussians, SCALE, OPACITY - SCALE)
                split_columns(opacities, group, gaussians, OPACITY, COLOR - OPACITY)
                split_columns(colors, group, gaussians, COLOR, C)
                opacity = gaussians[OPACITY, group]
                # alpha >= 1/255 <=> d^T K d <= 2 extent
                extent = ti.Vector([ti.log(opacity[lane] / MIN_ALPHA) for lane in range(LANES)])
                for v in range(poses.shape[0]):
                    mean_x, mean_y, z, cov_xx, cov_xy, cov_yy = ellipses(
                        gaussians, group, poses, v, fx, fy, cx, cy, low_pass
                    )
                    det = cov_xx * cov_yy - cov_xy * cov_xy
                    is_near = is_near_image(mean_x, mean_y, width, height)
                    is_seen = (z > NEAR) & is_near & (extent > 0.0) & (det > 0.0)
                    x, y = ti.select(is_seen, mean_x, 0.0), ti.select(is_seen, mean_y, 0.0)
                    half_width = ti.sqrt(ti.select(is_seen, 2.0 * extent * cov_xx, 0.0))
                    half_height = ti.sqrt(ti.select(is_seen, 2.0 * extent * cov_yy, 0.0))
                    left, right = first_and_last(x - half_width, x + half_width, width)
                    top, bottom = first_and_last(y - half_height, y + half_height, height)
                    is_drawn = is_seen & (left <= right) & (top <= bottom)
                    left, right = ti.floor(left / BLOCK), ti.floor(right / BLOCK)  # blocks from here on
                    top, bottom = ti.floor(top / BLOCK), ti.floor(bottom / BLOCK)
                    rows = ti.select(is_drawn, bottom - top + 1.0, 0.0)
                    half = ti.select(is_drawn, 0.5 / det, 0.0)
                    p, q, r = once(cov_yy * half), once((0.0 - 2.0) * cov_xy * half), once(cov_xx * half)
                    first = (v * groups + group) * LANES
                    # The ellipse reaches only some blocks of each row.
                    slope = half_width * cov_xy / ti.select(is_drawn, cov_xx, 1.0)
                    for row in range(ti.min(SPANS, ti.cast(largest(rows), ti.i32))):
                        a = (top + row) * BLOCK - y
                        b = a + (BLOCK - 1.0)
                        a = ti.select(a > 0.0 - half_height, a, 0.0 - half_height)
                        b = ti.select(b < half_height, b, half_height)
                        columns = reached_columns(a, b, x, slope, p, q, r, extent, width, is_drawn)
                        for lane in ti.static(range(LANES)):
                            if rows[lane] > row:
                                record[first + lane, ti.static(gradient_size(C)) + SPAN + row] = columns[lane]
                    box_columns, box_rows = left * HALF + right, top * HALF + bottom
                    across = tile // BLOCK
                    tiles = [once(ti.floor(blocks / across)) for blocks in (left, right, top, bottom)]
                    number = (tiles[1] - tiles[0] + 1.0) * (tiles[3] - tiles[2] + 1.0)
                    for lane in ti.static(range(LANES)):
                        g = first + lane
                        first_slot[g] = 0
                        depth_bits[g] = NOT_DRAWN
                        if rows[lane] > 0:
                            record[g, MEAN_X], record[g, MEAN_Y] = mean_x[lane], mean_y[lane]
                            record[g, HALF_K_XX], record[g, K_XY] = p[lane], q[lane]
                            record[g, HALF_K_YY], record[g, EXTENT] = r[lane], extent[lane]
                            record[g, FEATURES] = z[lane]
                            for k in ti.static(range(C)):
                                record[g, FEATURES + 1 + k] = gaussians[COLOR + k, group][lane]
                            record[g, ti.static(gradient_size(C)) + COLUMNS] = box_columns[lane]
                            record[g, ti.static(gradient_size(C)) + ROWS] = box_rows[lane]
                            packed_tiles[g] = ti.cast(tiles[0][lane], ti.i32)
                            for k in ti.static(range(1, 4)):
                                packed_tiles[g] = packed_tiles[g] << 8 | ti.cast(tiles[k][lane], ti.i32)
                            first_slot[g] = ti.cast(number[lane], ti.i32)  # not yet summed up
                            # positive floats sort as integers
                            depth_bits[g] = ti.bit_cast(ti.cast(z[lane], ti.f32), ti.i32)
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for g in range(depth_bits.shape[0]):
            count = first_slot[g]
            first_slot[g] = total
            total += count
        first_slot[depth_bits.shape[0]] = total


@vector_instructions
@ti.kernel
def _project_backward(
    # inputs
    gaussians: lanes(2),  # [COLOR + C, groups]
    poses: ti.types.ndarray(ndim=3),  # [V, 4, 4]
    fx: float,
    fy: float,
    low_pass: float,
    num_workers: ti.i32,
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [V * padded + 1]
    slot_grad: sums(2),  # [slots, rows / SUMS] GRAD_FEATURES + 1 + C numbers of every (Gaussian, tile)
    # scratch, twice the same memory
    gradient_2d: ti.types.ndarray(ndim=2),  # [gradient_size(C) + 1, V * padded]
    gradient_2d_lanes: lanes(2),  # [gradient_size(C) + 1, V * groups]
    # outputs
    gradient: lanes(2),  # [COLOR + C, groups]
    grad_means: lanes(1),  # [3 G] the lanes of [padded, 3]
    grad_quats: lanes(1),  # [4 G]
    grad_scales: lanes(1),  # [3 G]
    grad_opacities: lanes(1),  # [G]
    grad_colors: lanes(1),  # [C G]
    pose_parts: lanes(3),  # [V, parts, 12] rows of [dR | dt], zeros in, to be summed over parts and lanes
    C: ti.template(),
):
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, n = chunk // CHUNK, first_slot.shape[0] - 1
            for g in range(n * w // num_workers, n * (w + 1) // num_workers):
                first, past = first_slot[g], first_slot[g + 1]
                for k in ti.static(range(gradient_size(C) // SUMS)):
                    total = ti.Vector([0.0 for _ in range(SUMS)])
                    for s in range(first, past):
                        total += slot_grad[s, k]
                    for j in ti.static(range(SUMS)):
                        gradient_2d[SUMS * k + j, g] = total[j]
                gradient_2d[ti.static(gradient_size(C)), g] = ti.select(past > first, 1.0, 0.0)
    for chunk in range(num_workers * CHUNK):
        if chunk % CHUNK == 0:
            w, parts = chunk // CHUNK, pose_parts.shape[1]
            for part in range(parts * w // num_workers, parts * (w + 1) // num_workers):
                for group in range(part * PART, ti.min((part + 1) * PART, gaussians.shape[1])):
                    differentiate(
                        gaussians, group, poses, fx, fy, low_pass, gradient_2d_lanes,
                        gradient, pose_parts, part, C,
                    )  # fmt: skip
                    join_columns(gradient, MEAN, QUAT - MEAN, group, grad_means)
                    join_columns(gradient, QUAT, SCALE - QUAT, group, grad_quats)
                    join_columns(gradient, SCALE, OPACITY - SCALE, group, grad_scales)
                    join_columns(gradient, OPACITY, COLOR - OPACITY, group, grad_opacities)
                    join_columns(gradient, COLOR, C, group, grad_colors)


@dataclass(frozen=True)
class Projection:
    """One map projected into several views; index v * padded + i is Gaussian i in view v."""

    count: int  # Gaussians
    gaussians: Tensor  # [COLOR + C, G, LANES], or [COLOR + C, N] of kernels.rasterization_gpu
    poses: Tensor  # [V, 4, 4]
    intrinsics: tuple[float, float, float, float]
    low_pass: float
    record: Tensor  # [V * padded, record_size(C)]
    depth_bits: Tensor  # [V * padded] int32
    packed_tiles: Tensor  # [V * padded] int32 tiles touched
    first_slot: Tensor  # [V * padded + 1] int32

    @property
    def channels(self) -> int:
        return len(self.gaussians) - COLOR

    @property
    def padded(self) -> int:
        """Number of Gaussians, rounded up to full lanes."""
        return self.gaussians.numel() // len(self.gaussians)


def padded_to_lanes(name: str, table: Tensor) -> Tensor:  # [N, ...] -> [padded, ...]
    """Return the table, ready for a kernel, padded with rows of zeros to a multiple of LANES."""
    missing = -len(table) % LANES
    table = plain(name, table)
    return torch.cat([table, table.new_zeros(missing, *table.shape[1:])]) if missing else table


def by_lanes(table: Tensor) -> Tensor:  # [padded, ...] -> [K, LANES]
    """Return the numbers of a table in the shape of a `lanes(1)` argument."""
    return table.view(table.numel() // LANES, LANES)


def by_sums(table: Tensor) -> Tensor:  # [N, K SUMS] -> [N, K, SUMS]
    """Return a table in the shape of a `sums(2)` argument."""
    return table.view(len(table), table.shape[1] // SUMS, SUMS)


def project(
    means: Tensor,  # [N, 3] metres, world
    quats: Tensor,  # [N, 4] wxyz, any norm
    scales: Tensor,  # [N, 3] metres
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, C]
    poses: Tensor,  # [V, 4, 4] T_camera_world
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],  # (width, height)
    tile: int,
    low_pass: float,
) -> Projection:
    """Project every Gaussian into every view, and find the tiles that it touches."""
    named = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    tables = [padded_to_lanes(name, table) for name, table in named.items()]  # padding has opacity 0
    channels, padded, device = colors.shape[1], len(tables[0]), means.device
    n = len(poses) * padded

    def integers(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.int32, device=device)

    gaussians = torch.empty(COLOR + channels, padded // LANES, LANES, dtype=float_dtype(), device=device)
    record = gaussians.new_empty(n, record_size(channels))
    depth_bits, packed_tiles, first_slot = integers(n), integers(n), integers(n + 1)
    _project_forward(
        *[by_lanes(table) for table in tables],
        poses, *intrinsics, *size, tile, low_pass, workers(),
        gaussians, record, depth_bits, packed_tiles, first_slot, channels,
    )  # fmt: skip
    return Projection(
        len(means), gaussians, poses, intrinsics, low_pass, record, depth_bits, packed_tiles, first_slot
    )


def project_backward(
    projection: Projection,
    slot_grad: Tensor,  # [slots, gradient_size(C)]
) -> tuple[list[Tensor], Tensor]:
    """Return the gradients of means, quats, scales, opacities and colours, and of the poses [V, 4, 4]."""
    gaussians, poses, channels = projection.gaussians, projection.poses, projection.channels
    num_views, groups, padded = len(poses), gaussians.shape[1], projection.padded
    rows = gradient_size(channels)
    gradient_2d = gaussians.new_empty(rows + 1, num_views * padded)
    parts = gaussians.new_zeros(num_views, max(-(-groups // PART), 1), 12, LANES)
    gradients = [gaussians.new_empty(padded, *shape) for shape in ((3,), (4,), (3,), (), (channels,))]
    fx, fy, _, _ = projection.intrinsics
    _project_backward(
        gaussians, poses, fx, fy, projection.low_pass, workers(),
        projection.first_slot, by_sums(slot_grad),
        gradient_2d, gradient_2d.view(rows + 1, num_views * groups, LANES), torch.empty_like(gaussians),
        *[by_lanes(gradient) for gradient in gradients], parts, channels,
    )  # fmt: skip
    grad_poses = torch.zeros_like(poses)
    grad_poses[:, :3] = parts.sum((1, 3), dtype=torch.float64).view(num_views, 3, 4).to(poses.dtype)
    return [gradient[: projection.count] for gradient in gradients], grad_poses
