"""Times steps of a whole run against alternatives, and the growth of the kernels' cost with their input.

experiments/kernel_times.py times the kernels alone; this file times the steps that need a map or a sequence.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edslam_ti import kernels
from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import SampledSequence, open_sequence
from edslam_ti.datasets.base import Sample
from edslam_ti.experiments.front_end import front_end
from edslam_ti.experiments.kernel_times import (
    OURS,
    Row,
    Stopwatch,
    cold_start,
    rasterize_pairs,
    rasterizer,
    room_scene,
    surface,
    tracking,
)
from edslam_ti.geometry import inverse
from edslam_ti.kernels.view_losses import compare_change
from edslam_ti.mapping.gaussians import GaussianMap, Gaussians
from edslam_ti.mapping.rendering import render
from edslam_ti.methods import METHODS
from edslam_ti.pipeline import contrast_of, make_slam
from edslam_ti.results.pictures import new_figure, save_figure
from edslam_ti.slam import Slam

WARM_UP_FRAMES = 3
MOTION = (0.01, 0.0, 0.005)  # metres between the two views of a mapping step
EPSILON, BACKGROUND = 0.004, 0.5
EVENT_FLOOR = 1e-3  # avoids division by zero for an interval without events


def rows(
    suites: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    gaussians: Sequence[int],
    events: Sequence[int],
    sequence: tuple[str, float],  # scene and seconds of it, for the suite slam
    watch: Stopwatch,
    device: str,
) -> Iterator[Row]:
    """Yield the rows of all suites."""
    for size in sizes:
        for count in events if "time_surface" in suites else ():
            yield from surface(size, count, watch)
        for count in events if "front_end" in suites else ():
            yield from front_end(size, count, watch)
        if "tracking" in suites:
            yield from tracking(size, watch)
        for count in gaussians:
            if "rasterizer" in suites:
                yield from rasterizer(size, count, watch, device)
            if "mapping_step" in suites:
                yield from mapping_step(size, count, watch)
    if "cold_start" in suites:
        yield from cold_start(torch.get_num_threads(), rounds=3)
    if "slam" in suites:
        yield from slam(*sequence)


# --- mapping step ---


def brightness_change(
    intensity_start: Tensor,  # [H, W]
    intensity_end: Tensor,  # [H, W]
    epsilon: float,
) -> Tensor:  # [H, W]
    """Return the synthesised log-brightness change, Eq. 10 of the paper."""
    return torch.log(intensity_end + epsilon) - torch.log(intensity_start + epsilon)


def event_loss(
    predicted: Tensor,  # [H, W] Eq. 10
    measured: Tensor,  # [H, W] Eq. 11
) -> Tensor:
    """Return the paper's Eq. 12 squared and divided by the measured mean square.

    The raw loss grows with motion and interval length; the division gives every interval the same weight.
    """
    return (predicted - measured).square().mean() / (measured.square().mean() + EVENT_FLOOR)


def mapping_step(size: tuple[int, int], count: int, watch: Stopwatch) -> Iterator[Row]:
    """The paper's step: two views, event loss (Eq. 10-12), gradients of the map and of both poses, Adam.

    The mapper compares one view (mapping/losses.py), which costs half as much.
    """
    (means, quats, scales, _, colors, pose), intrinsics = room_scene(count, *size)
    camera = Camera(*size, *intrinsics)
    gaussians = GaussianMap(Config().mapping)
    gaussians.add(means, quats, scales, 0.7, colors)
    moved = pose.clone()
    moved[:3, 3] -= torch.tensor(MOTION)
    poses = torch.stack([pose, moved])  # T_camera_world
    measured = 0.1 * torch.randn(size[1], size[0], generator=torch.Generator().manual_seed(0))
    scale = 1 / (measured.numel() * (float(measured.square().mean()) + EVENT_FLOOR))

    def in_one_pass() -> None:
        drawn = gaussians.activated()
        compare_change(
            drawn.means, drawn.quats, drawn.scales, drawn.opacities, drawn.colors,
            poses.clone().requires_grad_(), intrinsics, size, measured, BACKGROUND, EPSILON, scale,
        ).loss.backward()  # fmt: skip
        gaussians.step()

    def by_pairs(drawn: Gaussians, T_camera_world: Tensor) -> Tensor:
        image, _, alpha = rasterize_pairs(
            drawn.means, drawn.quats, drawn.scales, drawn.opacities, drawn.colors, T_camera_world,
            intrinsics, size,
        )  # fmt: skip
        return image[..., 0] + (1 - alpha) * BACKGROUND

    def by_kernels(drawn: Gaussians, T_camera_world: Tensor) -> Tensor:
        return render(drawn, camera, inverse(T_camera_world), BACKGROUND).intensity

    def by_autograd(view: Callable[[Gaussians, Tensor], Tensor]) -> None:
        drawn, free = gaussians.activated(), poses.clone().requires_grad_()
        predicted = brightness_change(view(drawn, free[0]), view(drawn, free[1]), EPSILON)
        event_loss(predicted, measured).backward()
        gaussians.step()

    def renders() -> None:
        for T in poses:
            by_kernels(gaussians.activated(), T.clone().requires_grad_()).backward(measured)
        for value in gaussians.raw.values():
            value.grad = None

    candidates = {
        OURS: in_one_pass,
        f"{OURS}, two renders with gradients alone": renders,
        f"{OURS}, two renders compared by torch": lambda: by_autograd(by_kernels),
        "torch pair list": lambda: by_autograd(by_pairs),
    }
    task = f"{size[0]}x{size[1]}, {count} Gaussians: mapping step"
    yield from watch.compare("mapping_step", task, candidates)


# --- whole runs ---

# Name: method and settings that differ from it
COMPARED: dict[str, tuple[str, dict[str, Any]]] = {
    "ed_slam": ("ed_slam", {}),
    "ed_slam with time surfaces": ("ed_slam", {"tracking": {"brightness": False}}),
    "ed_slam_paper": ("ed_slam_paper", {}),
    "open3d_icp": ("open3d_icp", {}),
    "open3d_rgbd": ("open3d_rgbd", {}),
}


def slam(scene: str, duration: float) -> Iterator[Row]:
    """Time the frames of a sequence with several methods in turn: tracking alone, and `ed_slam` with mapping.

    Results are means over the frames, because some cost more than others.
    """
    base = Config(scene=scene, duration=duration)
    sequence = open_sequence(base)
    samples = SampledSequence(sequence, 0.0, duration, base.max_interval)
    contrast = contrast_of(base, sequence, samples)
    runs = {}
    for name, (method, differences) in COMPARED.items():
        config = base.updated({"method": method, **METHODS[method].overrides}).updated(differences)
        config = config.updated({"mapping": {"enabled": False}})
        runs[f"{name}, tracking"] = make_slam(config, sequence, samples, contrast)
    runs["ed_slam, tracking and mapping"] = make_slam(base, sequence, samples, contrast)
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for sample in samples:
        for name, run in runs.items():
            seconds[name].append(_timed(run, sample))
    camera = sequence.camera
    task = f"{scene}, {camera.width}x{camera.height}: one frame"
    means = {name: 1e3 * np.mean(pairs[WARM_UP_FRAMES:], axis=0) for name, pairs in seconds.items()}
    wall_ours, cpu_ours = next(iter(means.values()))
    for name, (wall, cpu) in means.items():
        ratios = float(wall / wall_ours), float(cpu / cpu_ours)
        frames = len(seconds[name]) - WARM_UP_FRAMES
        yield Row("slam", task, name, float(wall), float(cpu), *ratios, None, frames)


def _timed(run: Slam, sample: Sample) -> tuple[float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    run.process(sample)
    return time.perf_counter() - wall, time.process_time() - cpu


# --- how the cost grows ---


@dataclass(frozen=True)
class Curve:
    """Cost of one task as a function of one size; `exponent` fits cost ~ size^exponent."""

    task: str
    against: str  # "pixels", "Gaussians", "events" or "threads"
    sizes: list[float]
    wall_ms: list[float]
    cpu_ms: list[float]

    @property
    def exponent(self) -> float:
        """Slope of a line through the logarithms: of wall time for threads, else of CPU time."""
        cost = self.wall_ms if self.against == "threads" else self.cpu_ms
        return float(np.polyfit(np.log(self.sizes), np.log(cost), 1)[0])


def scaling(
    sizes: Sequence[tuple[int, int]],
    gaussians: Sequence[int],
    events: Sequence[int],
    threads: Sequence[int],
    watch: Stopwatch,
) -> Iterator[Curve]:
    """Yield the kernels' cost against each size, others at their middle; changes the number of threads."""
    size, count, batch = sizes[len(sizes) // 2], gaussians[len(gaussians) // 2], events[len(events) // 2]

    def curves(against: str, values: Sequence[float], rows: Callable[[int], list[Row]]) -> Iterator[Curve]:
        columns = zip(*(rows(k) for k in range(len(values))))
        for column in columns:
            task = column[0].task.split(": ")[1]
            walls, cpus = [row.wall_ms for row in column], [row.cpu_ms for row in column]
            yield Curve(task, against, [float(v) for v in values], walls, cpus)

    def with_threads(k: int) -> list[Row]:
        kernels.init("cpu", threads=threads[k])
        torch.set_num_threads(threads[k])
        return [
            *rasterizer(size, count, watch), *tracking(size, watch),
            next(surface(size, max(events), watch)),
        ]  # fmt: skip

    yield from curves(
        "pixels", [w * h for w, h in sizes],
        lambda k: [
            *rasterizer(sizes[k], count, watch), *mapping_step(sizes[k], count, watch),
            *tracking(sizes[k], watch), *surface(sizes[k], batch, watch),
        ],
    )  # fmt: skip
    yield from curves(
        "Gaussians",
        gaussians,
        lambda k: [*rasterizer(size, gaussians[k], watch), *mapping_step(size, gaussians[k], watch)],
    )
    yield from curves("events", events, lambda k: [next(surface(size, events[k], watch))])
    yield from curves("threads", threads, with_threads)


def scaling_table(curves: Sequence[Curve]) -> list[str]:
    """Return the curves as lines of a Markdown table."""
    lines = ["| task | against | from | to | CPU ms | wall ms | exponent |", "|---|---|--:|--:|---|---|--:|"]
    for curve in curves:
        cpu, wall = (", ".join(f"{v:.3g}" for v in values) for values in (curve.cpu_ms, curve.wall_ms))
        ends = f"{curve.sizes[0]:.0f} | {curve.sizes[-1]:.0f}"
        lines.append(f"| {curve.task} | {curve.against} | {ends} | {cpu} | {wall} | {curve.exponent:.2f} |")
    return lines


def plot_scaling(path: Path, curves: Sequence[Curve]) -> None:
    """Write a picture of all curves: a panel for each size, both axes logarithmic."""
    kinds = list(dict.fromkeys(curve.against for curve in curves))
    figure = new_figure(3.5 * len(kinds), 5, dpi=90)
    panels = figure.subplots(1, len(kinds), squeeze=False)
    for kind, panel in zip(kinds, panels[0]):
        shown = [curve for curve in curves if curve.against == kind]
        for curve in shown:
            cost = curve.wall_ms if kind == "threads" else curve.cpu_ms
            panel.loglog(curve.sizes, cost, "o-", label=f"{curve.task}: {curve.exponent:.2f}")
        sizes = np.array(shown[0].sizes)
        lowest = min(min(curve.cpu_ms + curve.wall_ms) for curve in shown)
        slope = -1 if kind == "threads" else 1
        panel.loglog(sizes, 0.7 * lowest * (sizes / sizes[0]) ** slope, "k:", label=f"slope {slope}")
        panel.set_xlabel(kind)
        panel.set_xticks(sizes, [f"{size:,.0f}" for size in sizes], rotation=20)
        panel.minorticks_off()
        panel.set_ylabel("wall ms" if kind == "threads" else "CPU ms")
        panel.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1))
    save_figure(figure, path)
