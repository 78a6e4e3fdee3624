"""Kernels timed in turn with alternatives that compute the same: torch, numpy.

Everything runs in one process, one candidate after the other in every round, so that whatever else the
machine does hits all of them; medians of the rounds. CPU time counts all threads.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kernels import reference
from kernels.patch_warp import (
    NEAR,
    Patches,
    ResidualModel,
    extract_patches,
    normal_equations,
)
from kernels.projection import MIN_ALPHA
from kernels.rasterization import MAX_ALPHA, MIN_TRANSMITTANCE, rasterize
from kernels.time_surface import time_surface, update_last_timestamps

OURS = "Taichi"
TWIN_LIMIT = 3e7  # Gaussians times pixels that the torch twin still manages, all at once
NUM_PATCHES, PATCH_SIZE = 400, 9

Candidates = dict[str, Callable[[], object]]
Scene = tuple[list[Tensor], tuple[float, float, float, float]]  # inputs of `rasterize`, intrinsics


@dataclass(frozen=True)
class Row:
    """One candidate at one task."""

    suite: str
    task: str
    name: str
    wall_ms: float
    cpu_ms: float
    times_ours: float  # wall time in units of ours


def measure(suite: str, task: str, candidates: Candidates, rounds: int) -> list[Row]:
    """Return the medians of all candidates; the first call of each is not counted."""
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in candidates}
    for k in range(rounds + 1):
        for name, run in candidates.items():
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            if k > 0:
                samples[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    medians = {name: 1e3 * np.median(values, axis=0) for name, values in samples.items()}
    ours = medians[OURS][0]
    return [Row(suite, task, name, float(w), float(c), float(w / ours)) for name, (w, c) in medians.items()]


# --- rasterizer ---


def room_scene(n: int, width: int, height: int, seed: int = 0) -> Scene:
    """Gaussians of about 1.2 pixels on the walls of a room 5 x 2.6 x 4.5 m, seen from its middle."""
    rng = np.random.default_rng(seed)
    focal = 0.8 * width
    u = rng.uniform(-0.1 * width, 1.1 * width, n)
    v = rng.uniform(-0.1 * height, 1.1 * height, n)
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones(n)], -1)
    means = rays * (np.array([2.5, 1.3, 4.5]) / np.abs(rays).clip(1e-9)).min(1)[:, None]
    scales = 1.2 * means[:, 2:] / focal * np.exp(rng.normal(0, 0.35, (n, 3)))
    inputs = [means, rng.normal(size=(n, 4)), scales, rng.uniform(0.2, 0.95, n), rng.uniform(0, 1, (n, 1))]
    tensors = [torch.from_numpy(x.astype(np.float32)) for x in inputs]
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.02, -0.01, 0.03])
    return [*tensors, pose], (focal, focal, width / 2, height / 2)


def rasterize_pairs(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    T_camera_world: Tensor, intrinsics: tuple[float, ...], size: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Image [H, W, C], depth and alpha [H, W] from a list of all (pixel, Gaussian) pairs, in plain torch."""
    width, height = size
    centres, covariances, depths = reference.project(means, quats, scales, T_camera_world, intrinsics)
    conics = torch.linalg.inv(covariances)
    with torch.no_grad():
        extent = torch.log(opacities / MIN_ALPHA)
        half = torch.sqrt(2 * extent.clamp_min(0)[:, None] * covariances.diagonal(dim1=1, dim2=2))
        limits = torch.tensor([width - 1, height - 1])
        low = (centres - half).ceil().long().clamp_min(0)
        sides = (torch.minimum((centres + half).floor().long(), limits) - low + 1).clamp_min(0)
        counts = sides.prod(1) * ((depths > 0.05) & (extent > 0))
        order = depths.argsort(stable=True)
        g = order.repeat_interleave(counts[order])
        starts = counts[order].cumsum(0) - counts[order]
        k = torch.arange(len(g)) - starts.repeat_interleave(counts[order])
        x, y = low[g, 0] + k % sides[g, 0], low[g, 1] + k // sides[g, 0]
        d = torch.stack([x, y], -1) - centres[g]
        inside = 0.5 * torch.einsum("pi,pij,pj->p", d, conics[g], d) <= extent[g]
        pixel = (y * width + x)[inside]
        by_pixel = pixel.argsort(stable=True)
        g, x, y, pixel = (values[inside][by_pixel] for values in (g, x, y, y * width + x))
    d = torch.stack([x, y], -1) - centres[g]
    alpha = opacities[g] * torch.exp(-0.5 * torch.einsum("pi,pij,pj->p", d, conics[g], d))
    logs = torch.log1p(-alpha.clamp_max(MAX_ALPHA)).double()
    before = logs.cumsum(0) - logs
    first = torch.searchsorted(pixel, pixel)  # of each pixel's pairs
    T = torch.exp(before - before[first]).float()
    weights = alpha.clamp_max(MAX_ALPHA) * T * (T > MIN_TRANSMITTANCE)
    features = torch.cat([colors[g], depths[g, None], torch.ones_like(weights)[:, None]], 1)
    drawn = torch.zeros(width * height, features.shape[1]).index_add(0, pixel, weights[:, None] * features)
    image, depth, total = drawn.view(height, width, -1).split([colors.shape[1], 1, 1], -1)
    return image, depth[..., 0], total[..., 0]


def rasterizer(size: tuple[int, int], count: int, rounds: int) -> Iterator[Row]:
    """Render a view; render it and compute all gradients, pose included."""
    inputs, intrinsics = room_scene(count, *size)
    cotangent = torch.randn(size[1], size[0], generator=torch.Generator().manual_seed(0))

    def kernel(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = rasterize(*tensors, intrinsics, size)
        return view.image, view.depth, view.alpha

    def twin(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = reference.rasterize(*tensors, intrinsics, size)
        return view.image, view.depth, view.alpha

    def gradients(render: Callable[..., tuple[Tensor, ...]]) -> object:
        tensors = [x.clone().requires_grad_() for x in inputs]
        loss = sum((image.squeeze(-1) * cotangent).sum() for image in render(*tensors))
        return torch.autograd.grad(loss, tensors)

    renders = {OURS: kernel, "torch pair list": lambda *x: rasterize_pairs(*x, intrinsics, size)}
    if size[0] * size[1] * count <= TWIN_LIMIT:
        renders["torch twin"] = twin
    task = f"{size[0]}x{size[1]}, {count} Gaussians"
    with torch.no_grad():
        forward = {name: lambda render=render: render(*inputs) for name, render in renders.items()}
        yield from measure("rasterizer", f"{task}: render", forward, rounds)
    both = {name: lambda render=render: gradients(render) for name, render in renders.items()}
    yield from measure("rasterizer", f"{task}: render and gradients", both, rounds)


# --- time surface ---


def surface(size: tuple[int, int], count: int, rounds: int) -> Iterator[Row]:
    """Take in a batch of events; evaluate the surface."""
    rng = np.random.default_rng(0)
    x = rng.integers(0, size[0], count).astype(np.int16)
    y = rng.integers(0, size[1], count).astype(np.int16)
    t = np.sort(rng.uniform(0, 1, count))
    last = np.full((size[1], size[0]), -np.inf)

    def assign() -> None:
        last[y, x] = t

    task = f"{size[0]}x{size[1]}, {count} events"
    updates = {OURS: lambda: update_last_timestamps(x, y, t, last), "numpy last[y, x] = t": assign}
    yield from measure("time_surface", f"{task}: update", updates, rounds)
    evaluations = {
        OURS: lambda: time_surface(last, 1.0, 0.03),
        "numpy exp": lambda: np.exp(((last - 1.0) / 0.03).astype(np.float32)),
    }
    yield from measure("time_surface", f"{task}: evaluate", evaluations, rounds)


# --- tracking ---


def linearise_in_numpy(
    patches: Patches, surface: np.ndarray, depth: np.ndarray, T_b_a: np.ndarray,
    intrinsics: tuple[float, ...], model: ResidualModel, inverse: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """H [6, 6] and g [6] of `kernels.patch_warp.normal_equations`, in numpy."""
    fx, fy, cx, cy = intrinsics
    T = T_b_a.astype(np.float32)
    x, y, rho = patches.pixels[patches.pixels[:, 2] > 0].T
    values = patches.values[patches.pixels[:, 2] > 0]
    p_a = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) / rho[:, None]
    p = p_a @ T[:3, :3].T + T[:3, 3]
    inv_z = 1 / np.maximum(p[:, 2], NEAR)
    u, v = fx * p[:, 0] * inv_z + cx, fy * p[:, 1] * inv_z + cy
    height, width = surface.shape
    keep = (p[:, 2] > NEAR) & (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
    p_a, p, inv_z, u, v, values = (array[keep] for array in (p_a, p, inv_z, u, v, values))
    j, i = u.astype(np.int32), v.astype(np.int32)
    a, b = (u - j)[:, None], (v - i)[:, None]

    def sample(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c = np.stack([image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1]], -1)
        top, bottom = c[:, :1] + a * (c[:, 1:2] - c[:, :1]), c[:, 2:3] + a * (c[:, 3:] - c[:, 2:3])
        along_x = (1 - b) * (c[:, 1:2] - c[:, :1]) + b * (c[:, 3:] - c[:, 2:3])
        return (top + b * (bottom - top))[:, 0], np.concatenate([along_x, bottom - top], 1), c

    value, gradient, _ = sample(surface)
    d, d_gradient, corners = sample(depth)
    r_depth = p[:, 2] - d
    has_depth, highest = corners.min(1) > NEAR, corners.max(1)
    keep = ~has_depth | (np.abs(r_depth) < model.max_depth_difference)
    is_smooth = keep & has_depth & (highest - corners.min(1) < 0.05 * highest)
    zero = np.zeros_like(inv_z)
    du = np.stack([fx * inv_z, zero, -fx * p[:, 0] * inv_z**2], -1)
    dv = np.stack([zero, fy * inv_z, -fy * p[:, 1] * inv_z**2], -1)
    H, g = np.zeros((6, 6)), np.zeros(6)
    sigma_depth = model.depth_sigma + model.depth_sigma_2 * p[:, 2] ** 2
    along_depth = np.array([0, 0, 1], np.float32) - d_gradient[:, :1] * du - d_gradient[:, 1:] * dv
    for along, r, sigma, share, used in (
        (gradient[:, :1] * du + gradient[:, 1:] * dv, value - values, model.surface_sigma + zero, 1.0, keep),
        (along_depth, r_depth, sigma_depth, model.depth_weight, is_smooth),
    ):
        along, at = (-along @ T[:3, :3], p_a) if inverse else (along, p)
        J = np.concatenate([along, np.cross(at, along)], 1)[used] / sigma[used, None]
        r = r[used] / sigma[used]
        weight = share * np.minimum(1, model.huber_threshold / np.maximum(np.abs(r), 1e-12))
        H += J.T @ (weight[:, None] * J)
        g += J.T @ (weight * r)
    return H, g


def tracking_inputs(size: tuple[int, int]) -> tuple[Patches, np.ndarray, np.ndarray, np.ndarray]:
    """Patches of a view, surface and depth of the same view, and a small motion [4, 4]."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float32)
    surface = (0.5 + 0.25 * np.sin(u / 4) + 0.2 * np.cos(v / 3 - u / 9)).astype(np.float32)
    depth = (2 + 0.3 * np.sin(u / 15) + 0.2 * np.cos(v / 11)).astype(np.float32)
    centres = np.stack([rng.integers(0, s, NUM_PATCHES) for s in size], -1).astype(np.int32)
    T = np.eye(4)
    T[:3, 3] = [0.004, -0.003, 0.005]
    return extract_patches(surface, depth, centres, PATCH_SIZE), surface, depth, T


def tracking(size: tuple[int, int], rounds: int) -> Iterator[Row]:
    """Linearise the alignment once, both directions."""
    intrinsics, model = (0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2), ResidualModel()
    patches, surface, depth, T = tracking_inputs(size)
    arguments = [
        (patches, surface, depth, pose, intrinsics, model, inverse)
        for pose, inverse in ((T, False), (np.linalg.inv(T), True))
    ]
    candidates = {
        OURS: lambda: [normal_equations(*each) for each in arguments],
        "numpy": lambda: [linearise_in_numpy(*each) for each in arguments],
    }
    task = f"{size[0]}x{size[1]}, {NUM_PATCHES} patches of {PATCH_SIZE}x{PATCH_SIZE}: linearise"
    yield from measure("tracking", task, candidates, rounds)
