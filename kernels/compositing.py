"""Compositing of the Gaussians in a tile's or a block's list (Eq. 8), and its gradients.

`draw` and `draw_backward` take a block of pixels, as the lanes of vectors (kernels.rasterization), or a
single pixel (kernels.rasterization_gpu); the maths is in kernels.rasterization.
"""

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.lanes import LANES, SUMS, exp, largest, sums_of
from edslam_ti.kernels.projection import (
    BLOCK,
    COLUMNS,
    EXTENT,
    FEATURES,
    GRAD_FEATURES,
    HALF,
    HALF_K_XX,
    HALF_K_YY,
    K_XY,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    ROWS,
    SPAN,
    SPANS,
    gradient_size,
    once,
    record_size,
)

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
    """log(255 alpha) at distance d from a record's mean; not negative inside its ellipse."""
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
    """Copy the records of a tile into contiguous memory, and list for each block those it draws."""
    base = w * items.shape[2]
    for j in range(past - first):  # so short a loop lets the CPU load many records at once
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
    """The position of the n-th record of a list, and the pair it belongs to."""
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
    # alpha_i scales its own weight and attenuates everything behind it, whose part of the loss is B_i.
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
        v = ti.select(raw < MAX_ALPHA, weight * q, 0.0)  # min() has no gradient where it clips
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
