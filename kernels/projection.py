"""3D Gaussians to 2D ellipses (Eq. 6-7), forward and backward, with the gradient of the camera pose.

For one Gaussian with mean mu, rotation R(q) and scales s, seen from T_camera_world = [R_c | t_c]:

    p  = R_c mu + t_c                             camera frame, metres
    m  = (f_x p_x / p_z + c_x, f_y p_y / p_z + c_y)     pixels
    J  = [f_x/p_z, 0, -f_x p_x/p_z^2;  0, f_y/p_z, -f_y p_y/p_z^2]
    A  = J R_c R(q) diag(s)                       [2, 3]
    S' = A A^T + low_pass I                       Eq. 7, with the usual low-pass filter, 0.3 px^2
    K  = S'^-1                                    the conic: alpha = o exp(-1/2 d^T K d), Eq. 8
"""

import taichi as ti

NEAR = 0.05  # metres; nearer Gaussians are culled
LOW_PASS = 0.3  # px^2 added to the 2D covariance at full size (Kerbl et al. 2023)
MIN_ALPHA = 1.0 / 255.0  # a Gaussian ends where its alpha falls below this
NOT_DRAWN = -1  # in place of the depth bits, which are positive

# Columns of the projected record [N, FEATURES + 1 + C]; the features are the depth and the colours
MEAN_X, MEAN_Y, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, EXTENT, HALF_WIDTH, HALF_HEIGHT, FEATURES = range(10)
# Columns of the record's gradient [pairs, GRADIENT_FEATURES + 1 + C]: as above up to the opacity, features
GRADIENT_FEATURES = 6
MAX_TILES = 256  # across and down: a Gaussian's first and last tile column and row fit into one integer


@ti.func
def rotation_of(q):
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@ti.func
def load_pose(T: ti.template()):
    R = ti.Matrix([[T[0, 0], T[0, 1], T[0, 2]], [T[1, 0], T[1, 1], T[1, 2]], [T[2, 0], T[2, 1], T[2, 2]]])
    return R, ti.Vector([T[0, 3], T[1, 3], T[2, 3]])


@ti.func
def load_quaternion(quats: ti.template(), i):
    q = ti.Vector([quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]])
    norm = ti.sqrt(q.dot(q))
    return q / norm, norm


@ti.func
def tiles_between(low, high, size, tile):
    """First and last tile, of a row or column of them, that holds a pixel of [low, high]."""
    first = ti.max(0, ti.cast(ti.ceil(low), ti.i32))
    last = ti.min(size - 1, ti.cast(ti.floor(high), ti.i32))
    return first // tile, ti.select(first <= last, last // tile, -1)


@ti.func
def pack_tiles(left, right, top, bottom):
    return (left << 24) | (right << 16) | (top << 8) | bottom


@ti.func
def unpack_tiles(packed):
    """First and last tile column, first and last tile row."""
    return (packed >> 24) & 255, (packed >> 16) & 255, (packed >> 8) & 255, packed & 255


@ti.kernel
def _project_forward(
    # inputs
    means: ti.types.ndarray(ndim=2),  # [N, 3] metres, world
    quats: ti.types.ndarray(ndim=2),  # [N, 4] wxyz, any norm
    scales: ti.types.ndarray(ndim=2),  # [N, 3] metres
    opacities: ti.types.ndarray(ndim=1),  # [N]
    colors: ti.types.ndarray(ndim=2),  # [N, C]
    T_camera_world: ti.types.ndarray(ndim=2),  # [4, 4]
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: ti.i32,
    height: ti.i32,
    tile: ti.i32,
    low_pass: float,  # px^2
    # outputs
    record: ti.types.ndarray(ndim=2),  # [N, FEATURES + 1 + C]
    depth_bits: ti.types.ndarray(ti.i32, ndim=1),  # [N] sorts as the depth, NOT_DRAWN where culled
    packed_tiles: ti.types.ndarray(ti.i32, ndim=1),  # [N] tiles touched
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [N + 1] slots of Gaussian i: first_slot[i] .. [i + 1]
):
    for i in range(means.shape[0]):
        first_slot[i] = 0
        depth_bits[i] = NOT_DRAWN
        R_c, t_c = load_pose(T_camera_world)
        p = R_c @ ti.Vector([means[i, 0], means[i, 1], means[i, 2]]) + t_c
        if p[2] > NEAR:
            inv_z = 1.0 / p[2]
            u, v = fx * p[0] * inv_z + cx, fy * p[1] * inv_z + cy
            # The affine approximation is useless far outside the image.
            if -0.3 * width < u < 1.3 * width and -0.3 * height < v < 1.3 * height:
                q, _ = load_quaternion(quats, i)
                M = R_c @ rotation_of(q)
                j02, j12 = -fx * p[0] * inv_z * inv_z, -fy * p[1] * inv_z * inv_z
                cov_xx, cov_xy, cov_yy = low_pass, 0.0, low_pass
                for k in ti.static(range(3)):
                    a = (fx * inv_z * M[0, k] + j02 * M[2, k]) * scales[i, k]
                    b = (fy * inv_z * M[1, k] + j12 * M[2, k]) * scales[i, k]
                    cov_xx += a * a
                    cov_xy += a * b
                    cov_yy += b * b
                inv_det = 1.0 / (cov_xx * cov_yy - cov_xy * cov_xy)
                extent = ti.log(opacities[i] / MIN_ALPHA)  # alpha >= 1/255 <=> d^T K d <= 2 extent
                if extent > 0 and inv_det > 0:
                    record[i, MEAN_X], record[i, MEAN_Y] = u, v
                    record[i, CONIC_XX] = cov_yy * inv_det
                    record[i, CONIC_XY] = -cov_xy * inv_det
                    record[i, CONIC_YY] = cov_xx * inv_det
                    record[i, OPACITY] = opacities[i]
                    record[i, EXTENT] = extent
                    half_width, half_height = ti.sqrt(2 * extent * cov_xx), ti.sqrt(2 * extent * cov_yy)
                    record[i, HALF_WIDTH], record[i, HALF_HEIGHT] = half_width, half_height
                    record[i, FEATURES] = p[2]
                    for k in range(colors.shape[1]):
                        record[i, FEATURES + 1 + k] = colors[i, k]
                    left, right = tiles_between(u - half_width, u + half_width, width, tile)
                    top, bottom = tiles_between(v - half_height, v + half_height, height, tile)
                    if left <= right and top <= bottom:
                        first_slot[i] = (right - left + 1) * (bottom - top + 1)  # the number, for now
                        packed_tiles[i] = pack_tiles(left, right, top, bottom)
                        # positive floats sort as integers
                        depth_bits[i] = ti.bit_cast(ti.cast(p[2], ti.f32), ti.i32)
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for i in range(means.shape[0]):
            number = first_slot[i]
            first_slot[i] = total
            total += number
        first_slot[means.shape[0]] = total


@ti.kernel
def _project_backward(
    # inputs
    means: ti.types.ndarray(ndim=2),  # [N, 3]
    quats: ti.types.ndarray(ndim=2),  # [N, 4]
    scales: ti.types.ndarray(ndim=2),  # [N, 3]
    T_camera_world: ti.types.ndarray(ndim=2),  # [4, 4]
    fx: float,
    fy: float,
    record: ti.types.ndarray(ndim=2),  # [N, FEATURES + 1 + C]
    first_slot: ti.types.ndarray(ti.i32, ndim=1),  # [N + 1] slots of Gaussian i: first_slot[i] .. [i + 1]
    slot_grad: ti.types.ndarray(ndim=2),  # [slots, GRADIENT_FEATURES + 1 + C] one row per (Gaussian, tile)
    # outputs
    grad_means: ti.types.ndarray(ndim=2),  # [N, 3]
    grad_quats: ti.types.ndarray(ndim=2),  # [N, 4]
    grad_scales: ti.types.ndarray(ndim=2),  # [N, 3]
    grad_opacities: ti.types.ndarray(ndim=1),  # [N]
    grad_colors: ti.types.ndarray(ndim=2),  # [N, C]
    grad_pose: ti.types.ndarray(ndim=2),  # [parts, 12] rows of [dR | dt], to be summed over parts
    C: ti.template(),
):
    parts = grad_pose.shape[0]
    n = ti.cast(means.shape[0], ti.i64)
    for part in range(parts):
        R_c, t_c = load_pose(T_camera_world)
        dR_c = ti.Matrix([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        dt_c = ti.Vector([0.0, 0.0, 0.0])
        for i in range(ti.cast(n * part // parts, ti.i32), ti.cast(n * (part + 1) // parts, ti.i32)):
            g = ti.Vector([0.0 for _ in range(GRADIENT_FEATURES + 1)])
            dcolor = ti.Vector([0.0 for _ in range(C)])
            for s in range(first_slot[i], first_slot[i + 1]):
                for k in ti.static(range(GRADIENT_FEATURES + 1)):
                    g[k] += slot_grad[s, k]
                for k in ti.static(range(C)):
                    dcolor[k] += slot_grad[s, GRADIENT_FEATURES + 1 + k]
            for k in ti.static(range(C)):
                grad_colors[i, k] = dcolor[k]
            grad_opacities[i] = g[OPACITY]
            dmean, dscale = ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0])
            dquat = ti.Vector([0.0, 0.0, 0.0, 0.0])
            if first_slot[i + 1] > first_slot[i]:
                K = ti.Matrix(
                    [
                        [record[i, CONIC_XX], record[i, CONIC_XY]],
                        [record[i, CONIC_XY], record[i, CONIC_YY]],
                    ]
                )
                half = 0.5 * g[CONIC_XY]  # K_xy stands twice in the symmetric matrix
                dK = ti.Matrix([[g[CONIC_XX], half], [half, g[CONIC_YY]]])
                dS = -(K @ dK @ K)  # from K = S'^-1
                mean = ti.Vector([means[i, 0], means[i, 1], means[i, 2]])
                p = R_c @ mean + t_c
                inv_z = 1.0 / p[2]
                q, norm = load_quaternion(quats, i)
                R = rotation_of(q)
                M = R_c @ R
                j00, j11 = fx * inv_z, fy * inv_z
                j02, j12 = -fx * p[0] * inv_z * inv_z, -fy * p[1] * inv_z * inv_z
                dM = ti.Matrix([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
                dj00, dj11, dj02, dj12 = 0.0, 0.0, 0.0, 0.0
                for k in ti.static(range(3)):
                    # S' = sum_k a_k a_k^T with 2-vectors a_k = s_k (J M)_k, so da_k = 2 dS a_k
                    jm_a, jm_b = j00 * M[0, k] + j02 * M[2, k], j11 * M[1, k] + j12 * M[2, k]
                    s = scales[i, k]
                    da = 2 * s * (dS[0, 0] * jm_a + dS[0, 1] * jm_b)
                    db = 2 * s * (dS[1, 0] * jm_a + dS[1, 1] * jm_b)
                    dscale[k] = da * jm_a + db * jm_b
                    da, db = da * s, db * s
                    dM[0, k], dM[1, k], dM[2, k] = da * j00, db * j11, da * j02 + db * j12
                    dj00 += da * M[0, k]
                    dj02 += da * M[2, k]
                    dj11 += db * M[1, k]
                    dj12 += db * M[2, k]
                # p enters through the mean (u, v), the depth, and J.
                inv_z2, inv_z3 = inv_z * inv_z, inv_z * inv_z * inv_z
                dp = ti.Vector(
                    [
                        g[MEAN_X] * fx * inv_z - dj02 * fx * inv_z2,
                        g[MEAN_Y] * fy * inv_z - dj12 * fy * inv_z2,
                        g[GRADIENT_FEATURES]
                        - (g[MEAN_X] * fx * p[0] + g[MEAN_Y] * fy * p[1]) * inv_z2
                        - (dj00 * fx + dj11 * fy) * inv_z2
                        + 2 * inv_z3 * (fx * p[0] * dj02 + fy * p[1] * dj12),
                    ]
                )
                dmean = R_c.transpose() @ dp  # p = R_c mu + t_c
                dt_c += dp
                dR_c += dp.outer_product(mean) + dM @ R.transpose()  # M = R_c R
                dR = R_c.transpose() @ dM
                w, x, y, z = q[0], q[1], q[2], q[3]
                dunit = 2 * ti.Vector(
                    [
                        x * (dR[2, 1] - dR[1, 2]) + y * (dR[0, 2] - dR[2, 0]) + z * (dR[1, 0] - dR[0, 1]),
                        -2 * x * (dR[1, 1] + dR[2, 2])
                        + y * (dR[1, 0] + dR[0, 1])
                        + z * (dR[2, 0] + dR[0, 2])
                        + w * (dR[2, 1] - dR[1, 2]),
                        x * (dR[1, 0] + dR[0, 1])
                        - 2 * y * (dR[0, 0] + dR[2, 2])
                        + z * (dR[2, 1] + dR[1, 2])
                        + w * (dR[0, 2] - dR[2, 0]),
                        x * (dR[2, 0] + dR[0, 2])
                        + y * (dR[2, 1] + dR[1, 2])
                        - 2 * z * (dR[0, 0] + dR[1, 1])
                        + w * (dR[1, 0] - dR[0, 1]),
                    ]
                )
                dquat = (dunit - q * q.dot(dunit)) / norm  # through the normalisation
            for k in ti.static(range(3)):
                grad_means[i, k] = dmean[k]
                grad_scales[i, k] = dscale[k]
            for k in ti.static(range(4)):
                grad_quats[i, k] = dquat[k]
        for a in ti.static(range(3)):
            for b in ti.static(range(3)):
                grad_pose[part, 4 * a + b] = dR_c[a, b]
            grad_pose[part, 4 * a + 3] = dt_c[a]
