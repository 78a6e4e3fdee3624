"""Twins of the kernels in plain torch, or in numpy where no gradient is needed: the specification.

They are written for reading, and tests compare the kernels with them. Autograd differentiates the twins in
torch, and tests compare the hand-written backward passes with its gradients. Kernels for a CPU and for a GPU
have one twin, because they compute the same. The twins of kernels.texture are in reference_texture.py.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from edslam_ti.kernels.brightness_image import (
    BORDER,
    OCCLUDED,
    OCCLUDED_MARGIN,
    SAME_SURFACE,
    ChangeImage,
)
from edslam_ti.kernels.compositing import MAX_ALPHA, MIN_TRANSMITTANCE, VISIBLE_TRANSMITTANCE
from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.culling import REACH
from edslam_ti.kernels.depth_average import DepthAgreement
from edslam_ti.kernels.patch_warp import MAX_SLOPE, ResidualModel
from edslam_ti.kernels.projection import LOW_PASS, MARGIN, MIN_ALPHA
from edslam_ti.kernels.rasterization import Rasterization

# --- time surface ---


def last_timestamps(x: Tensor, y: Tensor, t: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the time of the newest event of every pixel, -inf where there is none."""
    flat = torch.full((shape[0] * shape[1],), -torch.inf, dtype=torch.float64)
    flat.scatter_reduce_(0, y.long() * shape[1] + x.long(), t.double(), "amax")
    return flat.view(shape)


def time_surface(last: Tensor, t: float, decay: float) -> Tensor:
    """Eq. 1."""
    return torch.exp(-(t - last) / decay).float()


def count_events(x: Tensor, y: Tensor, polarity: Tensor, shape: tuple[int, int]) -> Tensor:
    """Negative and positive events of every pixel [H, W, 2]: Eq. 11 is C times their difference."""
    flat = torch.zeros(shape[0] * shape[1] * 2, dtype=torch.int32)
    place = 2 * (y.long() * shape[1] + x.long()) + (polarity > 0).long()
    return flat.index_add_(0, place, torch.ones(len(x), dtype=torch.int32)).view(*shape, 2)


# --- patches ---


def warp_pixels(pixels: Tensor, T_b_a: Tensor, intrinsics: tuple[float, ...]) -> Tensor:
    """Eq. 3: pixels [M, 3] (x, y, rho) of view a -> [M, 3] (x', y', z') in view b."""
    fx, fy, cx, cy = intrinsics
    z = 1 / pixels[:, 2]
    p_a = torch.stack([(pixels[:, 0] - cx) / fx * z, (pixels[:, 1] - cy) / fy * z, z], -1)
    p = p_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    return torch.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy, p[:, 2]], -1)


def sample_bilinear(image: Tensor, points: Tensor) -> Tensor:
    """Eq. 4: image [H, W] at points [M, >= 2] inside it."""
    x, y = points[:, 0], points[:, 1]
    j, i = x.detach().floor().long(), y.detach().floor().long()
    fx, fy = x - j, y - i
    top = image[i, j] * (1 - fx) + image[i, j + 1] * fx
    bottom = image[i + 1, j] * (1 - fx) + image[i + 1, j + 1] * fx
    return top * (1 - fy) + bottom * fy


def alignment_residuals(
    pixels: Tensor, values: Tensor, surface: Tensor, depth: Tensor, T_b_a: Tensor,
    intrinsics: tuple[float, ...], model: ResidualModel,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Eq. 5, one direction: normalised surface residuals and (weighted) depth residuals."""
    usable = pixels[:, 2] > 0
    warped = warp_pixels(pixels[usable], T_b_a, intrinsics)
    height, width = surface.shape
    x, y, z = warped.unbind(-1)
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1) & (z > NEAR)
    warped, values = warped[inside], values[usable][inside]
    j, i = warped[:, 0].detach().floor().long(), warped[:, 1].detach().floor().long()
    corners = torch.stack([depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]], -1)
    has_depth = corners.amin(-1) > NEAR
    r_depth = warped[:, 2] - sample_bilinear(depth, warped)
    keep = ~has_depth | (r_depth.abs() < model.max_depth_difference)
    r_surface = (sample_bilinear(surface, warped) - values)[keep] / model.surface_sigma
    is_smooth = corners.amax(-1) - corners.amin(-1) < MAX_SLOPE * corners.amax(-1)
    sigma = model.depth_sigma + model.depth_sigma_2 * warped[:, 2].detach() ** 2
    return r_surface, (r_depth / sigma)[keep & has_depth & is_smooth]


def huber(r: Tensor, threshold: float) -> Tensor:
    """Return Huber's cost of each normalised residual."""
    return torch.where(r.abs() <= threshold, 0.5 * r * r, threshold * (r.abs() - 0.5 * threshold))


# --- Gaussians ---


def rotation_matrices(quats: Tensor) -> Tensor:
    """Quaternions [N, 4] wxyz of any norm -> rotation matrices [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).view(-1, 3, 3)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, T_camera_world: Tensor, intrinsics: tuple[float, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Eq. 6-7: 2D means [N, 2], 2D covariances [N, 2, 2] and depths [N]."""
    fx, fy, cx, cy = intrinsics
    R_c, t_c = T_camera_world[:3, :3], T_camera_world[:3, 3]
    x, y, z = (means @ R_c.T + t_c).unbind(-1)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).view(-1, 2, 3)
    A = J @ R_c @ rotation_matrices(quats) @ torch.diag_embed(scales)
    covariances = A @ A.transpose(-1, -2) + LOW_PASS * torch.eye(2, dtype=means.dtype)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), covariances, z


def _is_near(position: Tensor, size: int) -> Tensor:
    """Return whether a mean is near enough to the image for the affine approximation of Eq. 7."""
    return (position > -MARGIN * size) & (position < (1 + MARGIN) * size)


def rasterize(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    T_camera_world: Tensor, intrinsics: tuple[float, ...], size: tuple[int, int],
) -> Rasterization:  # fmt: skip
    """Eq. 8 for every pixel and Gaussian at once; see kernels.rasterization.rasterize."""
    width, height = size
    n = len(means)
    R_c, t_c = T_camera_world[:3, :3], T_camera_world[:3, 3]
    front = torch.nonzero(((means @ R_c.T + t_c)[:, 2] > NEAR) & (opacities > MIN_ALPHA))[:, 0]
    means_2d, covariances, depths = project(
        means[front], quats[front], scales[front], T_camera_world, intrinsics
    )
    u, v = means_2d.detach().unbind(-1)
    near_image = _is_near(u, width) & _is_near(v, height)
    order = depths.detach().float().argsort(stable=True)
    order = order[near_image[order]]
    index = front[order]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=means.dtype), torch.arange(width, dtype=means.dtype), indexing="ij"
    )
    delta = torch.stack([x, y], -1).view(-1, 1, 2) - means_2d[order]  # [H W, n, 2]
    power = 0.5 * torch.einsum("pni,nij,pnj->pn", delta, torch.linalg.inv(covariances[order]), delta)
    alpha = opacities[index] * torch.exp(-power)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), torch.zeros_like(alpha))
    before = torch.cat([torch.ones_like(alpha[:, :1]), torch.cumprod(1 - alpha, 1)[:, :-1]], 1)
    alpha = torch.where(before > MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
    T = torch.cat([torch.ones_like(alpha[:, :1]), torch.cumprod(1 - alpha, 1)], 1)  # [H W, n + 1]
    weights = alpha * T[:, :-1]
    visible = torch.zeros(n, dtype=torch.bool)
    visible[index] = ((alpha > 0) & (T[:, :-1] > VISIBLE_TRANSMITTANCE)).any(0)
    is_half = (T[:, :-1] > VISIBLE_TRANSMITTANCE) & (T[:, 1:] <= VISIBLE_TRANSMITTANCE)  # at most one a row
    dominant = torch.where(is_half.any(1), index[is_half.int().argmax(1)], -1).int()
    return Rasterization(
        (weights @ colors[index]).view(height, width, -1),
        (weights @ depths[order]).view(height, width),
        (1 - T[:, -1]).view(height, width),
        visible,
        dominant.view(height, width),
    )


def drawable(
    means: Tensor,  # [N, 3]
    log_scales: Tensor,  # [N, 3]
    T_camera_world: Tensor,  # [4, 4]
    intrinsics: tuple[float, ...],
    size: tuple[int, int],  # (width, height)
) -> Tensor:  # [M] indices
    """Return the Gaussians whose largest ball may reach the image; see kernels.culling."""
    fx, fy, cx, cy = intrinsics
    x, y, z = (means @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).unbind(-1)
    sigma = log_scales.amax(-1).exp() / z
    marked = z > NEAR
    for offset, f, centre, n in ((fx * x / z, fx, cx, size[0]), (fy * y / z, fy, cy, size[1])):
        reach = REACH * torch.sqrt((f**2 + offset**2) * sigma**2 + LOW_PASS)
        for margin in (reach, torch.full_like(reach, MARGIN * n)):
            marked &= (offset + centre > -1 - margin) & (offset + centre < n + margin)
    return torch.nonzero(marked).squeeze(1)


def compare_change(
    starts: Rasterization, ends: Rasterization, measured: Tensor, background: float, epsilon: float
) -> Tensor:
    """Return the squared error of the brightness change between two views, Eq. 10-12."""
    start, end = (_intensity(view, background) + epsilon for view in (starts, ends))
    return (torch.log(end / start) - measured).square().sum()


def compare_view(
    view: Rasterization, log_brightness: Tensor, depth: Tensor, background: float, epsilon: float
) -> tuple[Tensor, Tensor]:
    """Return the squared error of the log brightness, and the depth error weighted by alpha (Eq. 14, 15)."""
    squares = (torch.log(_intensity(view, background) + epsilon) - log_brightness).square().sum()
    return squares, (view.depth - view.alpha * depth).abs()[depth > 0].sum()


def _intensity(view: Rasterization, background: float) -> Tensor:
    return view.image[..., 0] + (1 - view.alpha) * background


# --- images of a depth camera ---


def average_depth(
    depth: np.ndarray,  # [H, W] metres, 0 = missing
    others: Sequence[np.ndarray],  # K times [H, W]
    poses: Sequence[np.ndarray],  # K times [4, 4] T_other_camera
    intrinsics: tuple[float, float, float, float],
    agreement: DepthAgreement,
) -> np.ndarray:  # [H, W]
    """Return each pixel's depth averaged along its ray with depths of other images that agree."""
    result = depth.astype(float)
    for v, u in np.argwhere(depth > 0):
        own = float(depth[v, u])
        noise = agreement.sigma + agreement.sigma_2 * own**2
        gate = min(agreement.num_sigmas * noise, agreement.share * own)
        ray, measured = _ray(u, v, intrinsics), [own]
        for other, T in zip(others, poses, strict=True):
            p, (x, y) = _seen(T, own * ray, intrinsics)
            if p[2] < NEAR or not (0 <= x < depth.shape[1] - 1 and 0 <= y < depth.shape[0] - 1):
                continue
            j, i = int(x), int(y)
            seen = float((_bilinear_weights(x, y) * other[i : i + 2, j : j + 2]).sum())
            further = (seen - p[2]) / (T[2, :3] @ ray)
            if abs(further) < gate:
                measured.append(own + further)
        result[v, u] = np.mean(measured)
    return result


def brightness_equations(
    first: ChangeImage,
    second: ChangeImage,
    T_second_first: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
    is_strict: bool = False,
) -> tuple[np.ndarray, np.ndarray]:  # [N, H W], [N]
    """Return A and b: l(u) - l(x(u)) = E_second(x(u)) - E_first(u) for every pixel u seen in both images."""
    assert first.depth is not None
    height, width = first.depth.shape
    rows, changes = [], []
    for v, u in np.argwhere(first.depth > 0):
        p, (x, y) = _seen(T_second_first, first.depth[v, u] * _ray(u, v, intrinsics), intrinsics)
        if not (p[2] > NEAR and 0 <= x < width - BORDER and 0 <= y < height - BORDER):
            continue
        around = (slice(int(y), int(y) + 2), slice(int(x), int(x) + 2))
        if second.depth is not None:
            measured = second.depth[around]
            nearest = np.where(measured > 0, measured, np.inf).min()
            if p[2] > nearest * (1 + OCCLUDED) + OCCLUDED_MARGIN:
                continue
            if is_strict and (np.abs(measured - p[2]) >= SAME_SURFACE * p[2]).any():
                continue
        weights, row = _bilinear_weights(x, y), np.zeros((height, width))
        row[v, u] = 0 if first.is_known else 1
        if not second.is_known:
            row[around] -= weights
        rows.append(row.ravel())
        changes.append((weights * second.change[around]).sum() - first.change[v, u])
    return np.array(rows).reshape(-1, height * width), np.array(changes)


def brightness_image(
    A: np.ndarray,  # [N, H W]
    b: np.ndarray,  # [N]
    prior: np.ndarray,  # [H, W]
    prior_weight: float,
    huber_threshold: float,
    is_robust: Sequence[bool],  # solutions
) -> np.ndarray:  # [H, W]
    """Return the image to which conjugate gradients converge, by solving the normal equations directly."""
    level = prior.ravel()
    for robust in is_robust:
        size = np.abs(A @ level - b).clip(1e-12)
        weight = np.minimum(1, huber_threshold / size) if robust else np.ones(len(b))
        normal = A.T @ (weight[:, None] * A) + prior_weight * np.eye(prior.size)
        level = np.linalg.solve(normal, A.T @ (weight * b) + prior_weight * prior.ravel())
    return level.reshape(prior.shape)


def _ray(u: float, v: float, intrinsics: tuple[float, float, float, float]) -> np.ndarray:  # [3]
    fx, fy, cx, cy = intrinsics
    return np.array([(u - cx) / fx, (v - cy) / fy, 1])


def _seen(
    T: np.ndarray, point: np.ndarray, intrinsics: tuple[float, float, float, float]
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return a moved point [3] and its pixel."""
    fx, fy, cx, cy = intrinsics
    p = T[:3, :3] @ point + T[:3, 3]
    return p, (fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy)


def _bilinear_weights(x: float, y: float) -> np.ndarray:  # [2, 2] of the corners around a point
    right, down = x - np.floor(x), y - np.floor(y)
    return np.outer([1 - down, down], [1 - right, right])


# --- event simulation ---


def hashed_normal(seed: int, pixel: Tensor, k: Tensor) -> Tensor:  # [M], [M] -> [M] float64
    """Return a standard normal number for (seed, pixel, k): PCG hashes and Box-Muller."""
    mask = 0xFFFFFFFF

    def pcg(value: Tensor) -> Tensor:
        state = (value * 747796405 + 2891336453) & mask
        word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & mask
        return (word >> 22) ^ word

    first = pcg(pcg(pcg(torch.full_like(pixel, seed & mask)) ^ pixel) ^ k)
    second = pcg(first ^ 0x9E3779B9)
    u1, u2 = (first.double() + 0.5) / 2**32, (second.double() + 0.5) / 2**32
    return torch.sqrt(-2 * torch.log(u1)) * torch.cos(2 * torch.pi * u2)


def simulate_events(
    log_start: Tensor,  # [H, W]
    log_end: Tensor,  # [H, W]
    start: int,  # nanoseconds
    end: int,  # nanoseconds
    reference: Tensor,  # [H, W] float64
    num_crossings: Tensor,  # [H, W] int64
    last_event: Tensor,  # [H, W] int64, nanoseconds
    thresholds: tuple[float, float],  # C of brighter and of darker events
    sigma: float,
    refractory: int,  # nanoseconds
    seed: int,
    min_threshold: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return events [N, 4] int64 (x, y, t, polarity), the new reference and the new crossings [H, W].

    ESIM: each pass over the image lets every pixel cross at most one more level.
    """
    L0, L1 = log_start.double(), log_end.double()
    width = L0.shape[1]
    pixel = torch.arange(L0.numel()).view(L0.shape)
    p = torch.sign(L1 - L0)
    brighter, darker = thresholds
    base = torch.where(p > 0, torch.full_like(L0, brighter), torch.full_like(L0, darker))
    level, k, last = reference.clone(), num_crossings.clone(), last_event.clone()
    events = []
    while True:
        C = base if sigma == 0 else (base + sigma * hashed_normal(seed, pixel, k)).clamp_min(min_threshold)
        following = level + p * C
        crossed = (p != 0) & ((L1 - following) * p >= 0)
        if not crossed.any():
            break
        fraction = ((following - L0) / (L1 - L0)).clamp(0, 1)
        t = start + torch.where(crossed, (end - start) * fraction + 0.5, torch.zeros_like(fraction)).long()
        fired = crossed & (t - last >= refractory)
        events.append(torch.stack([pixel % width, pixel // width, t, p.long()], -1)[fired])
        level, k, last = torch.where(crossed, following, level), k + crossed, torch.where(fired, t, last)
    found = torch.cat([torch.empty(0, 4, dtype=torch.int64), *events])
    rows = sorted(found.tolist(), key=lambda event: (event[2], event[1], event[0]))
    return torch.tensor(rows, dtype=torch.int64).view(-1, 4), level, k
