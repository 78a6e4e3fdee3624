"""Times kernels against alternatives that compute the same: torch, numpy, and others if installed.

Everything runs in one process. Every round times one candidate after the other, so that other load on the
machine affects all of them; results are medians of the rounds. CPU time counts all threads. The machine's
limit follows from the bytes that must be moved and the operations that must be done, and from the bandwidth
and the rate that torch reaches here.
"""

import importlib.util
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from edslam_ti.geometry import adjoint
from edslam_ti.kernels import brightness_image, depth_average, patch_warp, reference
from edslam_ti.kernels import time_surface as surfaces
from edslam_ti.kernels.compositing import MAX_ALPHA, MIN_TRANSMITTANCE
from edslam_ti.kernels.constants import NEAR
from edslam_ti.kernels.engine import ENGINE
from edslam_ti.kernels.patch_warp import (
    MAX_SLOPE,
    Alignment,
    Direction,
    Patches,
    ResidualModel,
    extract_patches,
)
from edslam_ti.kernels.projection import MIN_ALPHA
from edslam_ti.kernels.rasterization import rasterize
from edslam_ti.kernels.runtime import is_gpu, synchronize
from edslam_ti.kernels.time_surface import MANY_EVENTS, time_surface, update_last_timestamps
from edslam_ti.kernels.view_losses import compare_change, compare_view

OURS = ENGINE.capitalize()  # in the names of rows
TWIN_LIMIT = 3e7  # Gaussians times pixels up to which the torch twin, which computes all at once, is timed
DV_LIMIT = 2_000_000  # events; dv-processing takes them from Python one by one
NUM_PATCHES, PATCH_SIZE = 400, 9
MIN_SAMPLE = 0.005  # seconds
SLOW = 2.0  # seconds; longer calls are timed once
# Floating point operations, counted in the formulas
FLOPS_FORWARD, FLOPS_BACKWARD = 30, 48  # of a (pixel, Gaussian) pair
FLOPS_LINEARISE = 230  # of a patch pixel: warp, two samples, two Jacobians, 2 x 27 sums

Candidates = Mapping[str, Callable[[], object]]
Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]  # of `rasterize`: five of Gaussians, the pose
Render = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy, pixels


@dataclass(frozen=True)
class Work:
    """Memory traffic and operations that a task needs at least."""

    num_bytes: float = 0.0
    flops: float = 0.0


@dataclass(frozen=True)
class Row:
    """One candidate at one task."""

    suite: str
    task: str
    name: str
    wall_ms: float
    cpu_ms: float
    wall_times_ours: float  # wall time divided by that of our kernel
    cpu_times_ours: float
    limit_ms: float | None  # the machine's limit; None: not counted
    rounds: int  # number of timings

    def as_markdown(self) -> str:
        """Return the row of a table: task, name, wall and CPU ms, both divided by ours, limit ms."""
        times = (
            f"{self.wall_ms:.3g} | {self.cpu_ms:.3g} | {self.wall_times_ours:.2f} | {self.cpu_times_ours:.2f}"
        )
        limit = "" if self.limit_ms is None else f"{self.limit_ms:.2g}"
        return f"| {self.task} | {self.name} | {times} | {limit} |"


def processor() -> str:
    """Return the processor's name, if Linux states it, and the number of its cores."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


class Stopwatch:
    """Measures the machine's limits, and times candidates in turn (or the first one alone)."""

    def __init__(self, rounds: int, has_alternatives: bool = True) -> None:
        self._rounds = rounds
        self.has_alternatives = has_alternatives
        source, target = torch.ones(1 << 25), torch.empty(1 << 25)  # 128 MiB each
        matrix = torch.ones(1536, 1536)
        copying = self._best(lambda: target.copy_(source))
        multiplying = self._best(lambda: matrix @ matrix)
        self.bytes_per_second = 2 * source.numel() * source.element_size() / copying
        self.flops_per_second = 2 * len(matrix) ** 3 / multiplying

    def _best(self, run: Callable[[], object]) -> float:
        seconds = []
        for _ in range(max(3, self._rounds)):
            started = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - started)
        return min(seconds)

    def _calls(self, run: Callable[[], object]) -> tuple[int, int]:
        """Warm up; return the number of calls per sample, for a measurable duration, and of samples."""
        _seconds(run)
        seconds, _ = _seconds(run)
        return max(1, min(1000, int(MIN_SAMPLE / seconds))), 1 if seconds > SLOW else self._rounds

    def compare(self, suite: str, task: str, candidates: Candidates, work: Work | None = None) -> list[Row]:
        """Return the medians of all candidates; the first calls of each do not count."""
        if not self.has_alternatives:
            candidates = dict(list(candidates.items())[:1])
        # A sample of a short candidate has many calls: then all of them find their data in the cache.
        calls = {name: self._calls(run) for name, run in candidates.items()}
        samples: dict[str, list[tuple[float, float]]] = {name: [] for name in candidates}
        for k in range(self._rounds):
            for name, run in candidates.items():
                number, rounds = calls[name]
                if k < rounds:
                    samples[name].append(_seconds(run, number))
        medians = {name: 1e3 * np.median(values, axis=0) for name, values in samples.items()}
        wall_ours, cpu_ours = medians[next(iter(medians))]
        limit = None
        if work is not None:
            limit = 1e3 * max(work.num_bytes / self.bytes_per_second, work.flops / self.flops_per_second)
        return [
            Row(
                suite, task, name, float(w), float(c), float(w / wall_ours), float(c / cpu_ours), limit,
                len(samples[name]),
            )
            for name, (w, c) in medians.items()
        ]  # fmt: skip


def _seconds(run: Callable[[], object], calls: int = 1) -> tuple[float, float]:
    """Return wall and CPU seconds per call, the mean over consecutive calls."""
    _finish_device()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        run()
    _finish_device()
    return (time.perf_counter() - wall) / calls, (time.process_time() - cpu) / calls


def _finish_device() -> None:
    """Wait for launched kernels; on a CPU they have finished already."""
    if is_gpu():
        synchronize()


# --- rasterizer ---


def room_scene(n: int, width: int, height: int, seed: int = 0) -> tuple[Inputs, Intrinsics]:
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
    return _inputs([*tensors, pose]), (focal, focal, width / 2, height / 2)


def _inputs(tensors: Iterable[Tensor]) -> Inputs:
    means, quats, scales, opacities, colors, pose = tensors
    return means, quats, scales, opacities, colors, pose


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
        counts = sides.prod(1) * ((depths > NEAR) & (extent > 0))
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


def count_pairs(inputs: Inputs, intrinsics: tuple[float, ...], size: tuple[int, int]) -> int:
    """Return how many (pixel, Gaussian) pairs the Gaussians in view have, hidden ones included."""
    means, quats, scales, opacities, _, pose = inputs
    centres, covariances, depths = reference.project(means, quats, scales, pose, intrinsics)
    in_view = (depths > NEAR) & ((centres >= 0) & (centres < torch.tensor(size))).all(1)
    extent = torch.log(opacities / MIN_ALPHA).clamp_min(0)
    area = 2 * torch.pi * extent * torch.linalg.det(covariances).clamp_min(0).sqrt()
    return int(area[in_view].sum())


def rasterizer(size: tuple[int, int], count: int, watch: Stopwatch, device: str = "cpu") -> Iterator[Row]:
    """Time rendering of a view, and rendering with all gradients, including the pose's."""
    inputs, intrinsics = room_scene(count, *size)
    pairs = count_pairs(inputs, intrinsics, size)
    inputs = _inputs(x.to(device) for x in inputs)
    cotangent = torch.randn(size[1], size[0], generator=torch.Generator().manual_seed(0)).to(device)

    def kernel(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = rasterize(*_inputs(tensors), intrinsics, size)
        return view.image, view.depth, view.alpha

    def twin(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = reference.rasterize(*_inputs(tensors), intrinsics, size)
        return view.image, view.depth, view.alpha

    def gradients(render: Render) -> object:
        tensors = _inputs(x.clone().requires_grad_() for x in inputs)
        loss = torch.stack([(image.squeeze(-1) * cotangent).sum() for image in render(*tensors)]).sum()
        return torch.autograd.grad(loss, tensors)

    renders: dict[str, Render] = {OURS: kernel}
    if device == "cpu":  # the alternatives create tensors on the CPU
        renders["torch pair list"] = lambda *x: rasterize_pairs(*_inputs(x), intrinsics, size)
        if size[0] * size[1] * count <= TWIN_LIMIT:
            renders["torch twin"] = twin
    task = f"{size[0]}x{size[1]}, {count} Gaussians"
    values = sum(x.numel() for x in inputs)
    pixels = 3 * size[0] * size[1]
    with torch.no_grad():
        forward = {name: lambda render=render: render(*inputs) for name, render in renders.items()}
        work = Work(4 * (values + pixels), FLOPS_FORWARD * pairs)
        yield from watch.compare("rasterizer", f"{task}: render", forward, work)
    both = {name: lambda render=render: gradients(render) for name, render in renders.items()}
    work = Work(8 * (values + pixels), (FLOPS_FORWARD + FLOPS_BACKWARD) * pairs)
    yield from watch.compare("rasterizer", f"{task}: render and gradients", both, work)


# --- time surface ---


def surface(size: tuple[int, int], count: int, watch: Stopwatch) -> Iterator[Row]:
    """Time the update by a batch of events, and the evaluation of the surface."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 1, count))
    last = np.full((size[1], size[0]), -np.inf)
    everywhere = [rng.integers(0, n, count).astype(np.int16) for n in size]
    task = f"{size[0]}x{size[1]}, {count} events"
    yield from _update(f"{task}: update", everywhere, t, last, watch)
    # Most events in the middle, none in the corners
    middle = [np.clip(rng.normal(n / 2, n / 6, count), 0, n - 1).astype(np.int16) for n in size]
    yield from _update(f"{task}, most in the middle: update", middle, t, last, watch)
    evaluations = {
        OURS: lambda: time_surface(last, 1.0, 0.03),
        "torch twin": lambda: reference.time_surface(torch.from_numpy(last), 1.0, 0.03),
    }
    work = Work(last.nbytes + last.nbytes // 2, 20 * last.size)
    yield from watch.compare("time_surface", f"{task}: evaluate", evaluations, work)


def _update(
    task: str,
    places: Sequence[np.ndarray],  # x and y, [N] int16 each
    t: np.ndarray,  # [N] float64 seconds
    last: np.ndarray,  # [H, W] float64 seconds
    watch: Stopwatch,
) -> Iterator[Row]:
    """Time the update by a batch of events."""
    x, y = places
    height, width = last.shape
    x_of_twin, y_of_twin, t_of_twin = map(torch.from_numpy, (x, y, t))

    def assign() -> None:
        last[y, x] = t

    updates = {
        OURS: lambda: update_last_timestamps(x, y, t, last),
        "numpy last[y, x] = t": assign,
        "torch twin": lambda: reference.last_timestamps(x_of_twin, y_of_twin, t_of_twin, (height, width)),
    }
    if importlib.util.find_spec("numba"):
        compiled = _numba_assignment()
        updates["numba"] = lambda: compiled(x, y, t, last)
    if watch.has_alternatives and importlib.util.find_spec("dv_processing") and len(t) <= DV_LIMIT:
        updates["dv-processing"] = _dv_update(x, y, t, (width, height))
    newest = min(len(t), last.size)  # times that are needed
    work = Work(x.nbytes + y.nbytes + (t.itemsize + last.itemsize) * newest)
    yield from watch.compare("time_surface", task, updates, work)


def _numba_assignment() -> Callable[..., None]:
    import numba

    @numba.njit
    def assign(x: np.ndarray, y: np.ndarray, t: np.ndarray, last: np.ndarray) -> None:
        for i in range(len(t)):
            last[y[i], x[i]] = t[i]

    return assign


def _dv_update(x: np.ndarray, y: np.ndarray, t: np.ndarray, size: tuple[int, int]) -> Callable[[], None]:
    import dv_processing

    store = dv_processing.EventStore()
    for event in zip((1e6 * t).astype(np.int64).tolist(), x.tolist(), y.tolist()):
        store.push_back(*event, True)
    surface = dv_processing.TimeSurface(size)
    return lambda: surface.accept(store)


# --- tracking ---


def linearise_in_numpy(
    patches: Patches, surface: np.ndarray, depth: np.ndarray, T_b_a: np.ndarray,
    intrinsics: tuple[float, ...], model: ResidualModel, inverse: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return H [6, 6] and g [6] of `kernels.patch_warp.Alignment`, computed in numpy.

    The unknown updates T_b_a <- exp(xi) T_b_a; if `inverse`, it updates T_a_b <- exp(xi) T_a_b.
    """
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
    is_smooth = keep & has_depth & (highest - corners.min(1) < MAX_SLOPE * highest)
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


def linearise_in_torch(
    patches: Patches, surface: np.ndarray, depth: np.ndarray, T_b_a: np.ndarray,
    intrinsics: tuple[float, ...], model: ResidualModel, inverse: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the same from the torch twin's residuals, by forward differentiation along the six twists."""
    arrays = (patches.pixels, patches.values, surface, depth)
    pixels, values, image, depths = map(torch.from_numpy, arrays)
    T = torch.from_numpy(T_b_a).float()
    columns: tuple[list[Tensor], list[Tensor]] = ([], [])
    residuals: tuple[Tensor, ...] = ()
    for generator in torch.from_numpy(_GENERATORS).float():
        with forward_ad.dual_level():
            moved = forward_ad.make_dual(T, -T @ generator if inverse else generator @ T)
            duals = [
                forward_ad.unpack_dual(r)
                for r in reference.alignment_residuals(
                    pixels, values, image, depths, moved, intrinsics, model
                )
            ]
            residuals = tuple(dual.primal for dual in duals)
            for column, dual in zip(columns, duals):
                column.append(torch.zeros_like(dual.primal) if dual.tangent is None else dual.tangent)
    H, g = torch.zeros(6, 6), torch.zeros(6)
    for r, column, share in zip(residuals, columns, (1.0, model.depth_weight)):
        J = torch.stack(column, -1)
        weight = share * torch.clamp(model.huber_threshold / r.abs().clamp_min(1e-12), max=1.0)
        H += J.T @ (weight[:, None] * J)
        g += J.T @ (weight * r)
    return H.double().numpy(), g.double().numpy()


# d exp(xi) / d xi_k at 0, twists being (translation, rotation)
_GENERATORS = np.zeros((6, 4, 4))
for _k in range(3):
    _i, _j = (_k + 1) % 3, (_k + 2) % 3
    _GENERATORS[_k, _k, 3] = _GENERATORS[_k + 3, _j, _i] = 1
    _GENERATORS[_k + 3, _i, _j] = -1


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


def tracking(size: tuple[int, int], watch: Stopwatch) -> Iterator[Row]:
    """Time one linearisation of the alignment in both directions, as in an iteration of the tracker."""
    intrinsics, model = (0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2), ResidualModel()
    patches, surface, depth, T = tracking_inputs(size)
    view = np.stack([surface, depth], -1)[None]
    additive, compositional = (
        Alignment([Direction(patches.points(intrinsics, template), 0, model)] * 2, view, intrinsics)
        for template in (None, (surface, depth))
    )
    poses = [T, np.linalg.inv(T)]

    def linearise(alignment: Alignment) -> object:
        forward, backward = alignment.linearise(poses)
        if alignment.is_compositional:  # exp(xi) T = T exp(Ad(T^-1) xi)
            forward, backward = (
                system.transformed(np.linalg.inv(adjoint(pose)))
                for system, pose in zip((forward, backward), poses)
            )
        return forward + backward.transformed(-adjoint(poses[1]))

    arguments = [
        (patches, surface, depth, pose, intrinsics, model, inverse)
        for pose, inverse in zip(poses, (False, True))
    ]
    candidates = {
        OURS: lambda: linearise(additive),
        f"{OURS}, inverse compositional": lambda: linearise(compositional),
        "numpy": lambda: [linearise_in_numpy(*each) for each in arguments],
        "torch twin": lambda: [linearise_in_torch(*each) for each in arguments],
    }
    task = f"{size[0]}x{size[1]}, {NUM_PATCHES} patches of {PATCH_SIZE}x{PATCH_SIZE}: linearise"
    pixels = 2 * NUM_PATCHES * PATCH_SIZE**2
    work = Work(16 * pixels + surface.nbytes + depth.nbytes, FLOPS_LINEARISE * pixels)
    yield from watch.compare("tracking", task, candidates, work)


# --- cold start ---

FRESH_PROCESS = """
import json, time
def now():
    return time.perf_counter(), time.process_time()
stamps = [now()]
import edslam_ti.cold_start
edslam_ti.cold_start.load_kernels()
import edslam_ti.kernels, edslam_ti.experiments.kernel_times
stamps.append(now())
edslam_ti.kernels.init("cpu", threads={threads})
stamps.append(now())
edslam_ti.experiments.kernel_times.run_every_kernel()
stamps.append(now())
print(json.dumps(stamps))
"""


def run_every_kernel() -> None:
    """Run all kernels of a SLAM run on tiny inputs, so that all of them are compiled."""
    inputs, intrinsics = room_scene(20, 16, 12)
    view = rasterize(*_inputs(x.requires_grad_() for x in inputs), intrinsics, (16, 12))
    (view.image.sum() + view.depth.sum()).backward()
    target, poses = torch.zeros(12, 16), torch.stack([inputs[-1]] * 2)
    means, quats, scales, opacities, colors, _ = _inputs(x.detach() for x in inputs)
    scene = means, quats, scales, opacities, colors
    compare_change(*scene, poses, intrinsics, (16, 12), target, 0.5, 0.01, 1.0)
    compare_view(*scene, poses[0], intrinsics, (16, 12), target, target, 0.5, 0.01, 1.0, 1.0)
    for module in (patch_warp, brightness_image, depth_average, surfaces):
        module.compile_kernels()
    x, t = np.zeros(MANY_EVENTS, np.int16), np.zeros(MANY_EVENTS)
    update_last_timestamps(x, x, t, np.zeros((1, 1)))


def cold_start(threads: int, rounds: int) -> Iterator[Row]:
    """Yield the times of the parts of a start in a fresh process, with Taichi's kernel cache warm."""
    code = FRESH_PROCESS.format(threads=threads)
    samples = []
    for _ in range(rounds):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        samples.append(np.diff(json.loads(done.stdout.splitlines()[-1]), axis=0))
    parts = 1e3 * np.median(samples, axis=0)  # of three or more, as the first may have filled the cache
    names = ("import", f"start {OURS}", "compile every kernel")
    total = parts.sum(0)
    for name, (wall, cpu) in zip(("all", *names), [total, *parts]):
        ratios = float(wall / total[0]), float(cpu / total[1])
        yield Row("cold_start", "cold start", name, float(wall), float(cpu), *ratios, None, rounds)
