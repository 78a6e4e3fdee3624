"""Plots of trajectories, comparisons and finished runs (matplotlib, no display)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edslam_ti.camera import NEAREST, Camera
from edslam_ti.errors import DataError
from edslam_ti.evaluation.trajectories import trajectory_errors
from edslam_ti.mapping.volume import MeshView
from edslam_ti.results.pictures import new_figure, save_figure
from edslam_ti.results.reading import Result, load_result
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_poses_at
from edslam_ti.viewer.shapes import frustum_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colour-blind safe (Okabe and Ito); the truth is black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
START, END = "#009E73", "#D55E00"
MAX_DRAWN_POINTS = 60_000
HOLE = 1.5  # usual steps: the true path is not drawn across longer ones


# ---------------------------------------------------------------- trajectories


@dataclass(frozen=True)
class AlignedPath:
    """An estimate moved rigidly onto the truth, with its error at every pose."""

    positions: np.ndarray  # [F, 3] metres
    errors: np.ndarray  # [F] metres; NaN outside the truth's time range

    @property
    def ate_rmse(self) -> float:
        """Root mean square position error in metres; NaN without truth."""
        known = self.errors[np.isfinite(self.errors)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def align_to_truth(estimate: Trajectory, truth: Trajectory | None) -> AlignedPath:
    """Return the estimate under the rigid motion that ATE uses.

    Without truth, or with fewer than three poses inside its time range, the estimate stays as it is.
    """
    positions = estimate.poses[:, :3, 3]
    unknown = np.full(len(positions), np.nan)
    if truth is None:
        return AlignedPath(positions, unknown)
    try:
        compared = trajectory_errors(estimate, truth)
    except DataError:  # too few poses to compare: the path is drawn without errors
        return AlignedPath(positions, unknown)
    unknown[compared.indices] = compared.errors_cm / 100
    T = compared.T_truth_estimate
    return AlignedPath(positions @ T[:3, :3].T + T[:3, 3], unknown)


def plot_trajectory(
    path: Path,
    estimates: Mapping[str, Trajectory],
    truth: Trajectory | None,
    sigmas: np.ndarray | None = None,  # [F] metres, of the first estimate's positions
) -> None:
    """Draw top and side views of estimates, aligned to the truth when there is one.

    A single estimate is coloured by its position error; several by name. Sigmas are drawn as a band over
    time, with the error where the truth is known.
    """
    paths = {
        name: align_to_truth(estimate, truth) for name, estimate in estimates.items() if len(estimate) > 0
    }
    if not paths:
        raise DataError(f"{path.name}: expected at least one trajectory with poses, got none")
    figure = new_figure(11, 5) if sigmas is None else new_figure(11, 7)
    first_estimate = next(e for e in estimates.values() if len(e))
    true = None if truth is None else _known_at(truth, first_estimate.timestamps)
    views = _top_and_side(true or first_estimate)
    grid = figure.add_gridspec(
        1 if sigmas is None else 2, 2, height_ratios=None if sigmas is None else (5, 2)
    )
    axes = [figure.add_subplot(grid[0, k]) for k in range(2)]
    if sigmas is not None:
        _draw_sigmas(figure.add_subplot(grid[1, :]), first_estimate, next(iter(paths.values())), sigmas)
    for ax, view in zip(axes, views):
        if true is not None:
            _draw_path(ax, _with_holes(true), view, color="black", label="truth", linewidth=1.2)
        only = next(iter(paths.values())) if len(paths) == 1 else None
        if only is not None and np.isfinite(only.errors).sum() >= 2:
            bar = _draw_errors(ax, only, view)
            if ax is axes[-1]:
                figure.colorbar(bar, ax=list(axes), label="position error [cm]", fraction=0.03, pad=0.02)
        else:
            for (name, aligned), color in zip(paths.items(), colours()):
                _draw_path(ax, aligned.positions, view, color=color, label=_with_ate(name, aligned))
        first = next(iter(paths.values())).positions
        _mark_ends(ax, first, view)
        _finish_axes(ax, view)
    _legend(axes[0])
    figure.suptitle(
        ", ".join(_with_ate(name, aligned) for name, aligned in paths.items())
        + ("" if truth is None else " (rigidly aligned)")
    )
    save_figure(figure, path)


def _draw_sigmas(ax: "Axes", estimate: Trajectory, aligned: AlignedPath, sigmas: np.ndarray) -> None:
    """Draw twice the sigma of every position as a band over time, and the error where it is known."""
    seconds = estimate.timestamps - estimate.timestamps[0]
    ax.fill_between(seconds, 0, 200 * sigmas, color=COLOURS[5], alpha=0.4, linewidth=0, label="2 sigma")
    if np.isfinite(aligned.errors).any():
        ax.plot(seconds, 100 * aligned.errors, color=COLOURS[1], linewidth=1.2, label="position error")
    ax.set(xlabel="seconds", ylabel="[cm]", xlim=(0, max(float(seconds[-1]), 1e-3)))
    ax.set_ylim(bottom=0)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, framealpha=0.8)


def _known_at(truth: Trajectory, times: np.ndarray) -> Trajectory | None:
    """Return the truth at those times at which it is known; None if there is none."""
    poses, is_known = true_poses_at(truth, times)
    return Trajectory(times[is_known], poses[is_known]) if is_known.any() else None


def _with_holes(path: Trajectory) -> np.ndarray:  # [F + number of holes, 3]
    """Return positions with a row of NaN in every hole, so that no line is drawn across it."""
    steps = np.diff(path.timestamps)
    is_hole = steps > HOLE * np.median(steps) if len(steps) else np.zeros(0, bool)
    after = np.flatnonzero(is_hole) + 1
    return np.insert(path.poses[:, :3, 3], after, np.nan, axis=0)


@dataclass(frozen=True)
class _PlanarView:
    """Two world axes drawn right and up, with their signs."""

    title: str
    right: int
    up: int
    up_sign: float = 1.0

    def project(self, positions: np.ndarray) -> np.ndarray:  # [F, 3] -> [F, 2]
        return np.stack([positions[:, self.right], self.up_sign * positions[:, self.up]], -1)


def _top_and_side(trajectory: Trajectory) -> tuple[_PlanarView, _PlanarView]:
    """Return views along and across the vertical: the world axis nearest to the mean image column."""
    down = trajectory.poses[:, :3, 1].mean(0)  # camera y points down
    vertical = int(np.abs(down).argmax())
    extent = np.ptp(trajectory.poses[:, :3, 3], axis=0)
    a, b = (k for k in range(3) if k != vertical)
    side = a if extent[a] >= extent[b] else b
    return (
        _PlanarView("top view", a, b),
        _PlanarView("side view", side, vertical, up_sign=-1.0 if down[vertical] > 0 else 1.0),
    )


def _draw_path(ax: "Axes", positions: np.ndarray, view: _PlanarView, **style: Any) -> None:
    style = {"linewidth": 1.6, **style}
    ax.plot(*view.project(positions).T, **style)


def _draw_errors(ax: "Axes", aligned: AlignedPath, view: _PlanarView) -> Any:
    """Draw a path coloured by its error in centimetres and return what a colour bar needs."""
    from matplotlib.collections import LineCollection

    points = view.project(aligned.positions)
    segments = np.stack([points[:-1], points[1:]], axis=1)  # [F - 1, 2, 2]
    centimetres = 100 * aligned.errors
    lines = LineCollection(list(segments), cmap="plasma", linewidth=2.5)
    lines.set_array(np.fmax(centimetres[:-1], centimetres[1:]))
    lines.set_clim(0.0, max(float(np.nanmax(centimetres)), 1e-3))
    ax.add_collection(lines)
    ax.autoscale_view()
    return lines


def _mark_ends(ax: "Axes", positions: np.ndarray, view: _PlanarView) -> None:
    start, end = view.project(positions[[0, -1]])
    ax.plot(*start, "o", color=START, markersize=8, markeredgecolor="white", label="start", zorder=5)
    ax.plot(*end, "s", color=END, markersize=8, markeredgecolor="white", label="end", zorder=5)


def _finish_axes(ax: "Axes", view: _PlanarView) -> None:
    name = "xyz"
    sign = "-" if view.up_sign < 0 else ""
    ax.set(title=view.title, xlabel=f"{name[view.right]} [m]", ylabel=f"{sign}{name[view.up]} [m]")
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.08)
    ax.grid(alpha=0.3)


def _with_ate(name: str, aligned: AlignedPath) -> str:
    return name if np.isnan(aligned.ate_rmse) else f"{name}: ATE {100 * aligned.ate_rmse:.2f} cm rmse"


# ---------------------------------------------------------------- comparisons


def plot_groups(path: Path, groups: Mapping[str, Mapping[str, Sequence[float]]], label: str) -> None:
    """Draw each value as a dot, grouped, and the median of each series in each group as a bar."""
    series = list(dict.fromkeys(name for values in groups.values() for name in values))
    figure = new_figure(max(5.0, 1.0 + 1.4 * len(groups)), 4.0)
    ax = figure.add_subplot()
    for k, (name, colour) in enumerate(zip(series, colours())):
        shift = 0.8 * ((k + 0.5) / len(series) - 0.5)
        for place, values in enumerate(groups.values()):
            shown = values.get(name, [])
            if shown:
                spread = np.linspace(-0.25, 0.25, len(shown)) / len(series)
                ax.plot(place + shift + spread, shown, ".", color=colour, alpha=0.6)
                middle, half = float(np.median(shown)), 0.35 / len(series)
                ax.hlines(middle, place + shift - half, place + shift + half, colors=colour, lw=2)
        ax.plot([], [], "s", color=colour, label=name)
    ax.set_yscale("log")
    ax.set_xticks(range(len(groups)), list(groups), rotation=20)
    ax.set_ylabel(label)
    ax.grid(axis="y", alpha=0.3)
    _legend(ax)
    save_figure(figure, path)


def plot_drift(path: Path, curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Draw each curve's error (cm) over the path travelled (m), with the first poses aligned."""
    figure = new_figure(7.0, 4.0)
    ax = figure.add_subplot()
    for (name, (travelled, error)), colour in zip(curves.items(), colours()):
        ax.plot(travelled, error, color=colour, label=name, lw=1)
    ax.set_xlabel("path travelled [m]")
    ax.set_ylabel("distance from the truth [cm]")
    ax.grid(alpha=0.3)
    _legend(ax)
    save_figure(figure, path)


# ---------------------------------------------------------------- finished runs


def draw_results(results: Sequence[Path], path: Path) -> None:
    """Draw finished runs into one picture without a display: mesh or points, and trajectories."""
    runs = [load_result(folder) for folder in results]
    if not runs:
        raise DataError("results: expected at least one results folder, got none")
    figure = new_figure(12, 9)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.15, 1))
    overview = figure.add_subplot(grid[0, :])
    _draw_overview(overview, runs)
    truth = next((run.truth for run in runs if run.truth is not None), None)
    views = _top_and_side(truth or runs[0].trajectory)
    for k, view in enumerate(views):
        ax = figure.add_subplot(grid[1, k])
        _draw_points(ax, runs, view)
        if truth is not None:
            _draw_path(ax, _with_holes(truth), view, color="black", label="truth", linewidth=1.2)
        for run, color in zip(runs, colours()):
            _draw_path(ax, run.trajectory.poses[:, :3, 3], view, color=color, label=run.title, linewidth=2)
        _mark_ends(ax, runs[0].trajectory.poses[:, :3, 3], view)
        _finish_axes(ax, view)
        if k == 0:
            _legend(ax)
    save_figure(figure, path)


def _draw_points(ax: "Axes", runs: Sequence[Result], view: _PlanarView) -> None:
    """Draw the map points of every run that has any, in their brightness."""
    ax.set_facecolor("#dfe5ec")  # so that bright points are visible
    for run in runs:
        if run.points is None or run.brightness is None:
            continue
        chosen = np.linspace(0, len(run.points) - 1, min(len(run.points), MAX_DRAWN_POINTS)).astype(int)
        x, y = view.project(run.points[chosen]).T
        ax.scatter(x, y, 0.8, run.brightness[chosen], cmap="gray", vmin=0, vmax=1, alpha=0.6, linewidths=0)


def _draw_overview(ax: "Axes", runs: Sequence[Result]) -> None:
    """Draw the first run that has a mesh (else points) from behind its first camera, with all paths."""
    shown = next((run for run in runs if run.mesh is not None), None)
    shown = shown or next((run for run in runs if run.points is not None), runs[0])
    camera = Camera(width=960, height=480, fx=500.0, fy=500.0, cx=479.5, cy=239.5)
    T_world_view = _view_from_behind(shown.trajectory)
    image = np.full(camera.shape, 0.12)
    if shown.mesh is not None:
        brightness, depth = MeshView(shown.mesh).render(camera, T_world_view)
        image[depth > 0] = brightness[depth > 0]
    elif shown.points is not None and shown.brightness is not None:
        _splat_points(image, shown.points, shown.brightness, camera, T_world_view)
    ax.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="bilinear")
    for run, color in zip(runs, colours()):
        pixels, depth = _project(run.trajectory.poses[:, :3, 3], camera, T_world_view)
        pixels[depth < NEAREST] = np.nan
        ax.plot(*pixels.T, color=color, linewidth=2)
        for T in run.trajectory.poses[:: max(1, len(run.trajectory) // 6)]:
            for line in frustum_lines(T, camera, size=0.08):
                corners, line_depth = _project(line, camera, T_world_view)
                if (line_depth > NEAREST).all():
                    ax.plot(*corners.T, color=color, linewidth=0.7)
    what = "mesh" if shown.mesh is not None else "points" if shown.points is not None else "no map"
    ax.set(xlim=(0, camera.width - 1), ylim=(camera.height - 1, 0), xticks=[], yticks=[])
    ax.set_title(f"{shown.title} ({what}, seen from behind the first camera)")


def _view_from_behind(trajectory: Trajectory, back: float = 0.9, up: float = 0.25) -> np.ndarray:  # [4, 4]
    """Return a pose `back` metres behind and `up` metres above the first camera, looking its way."""
    T = trajectory.poses[0].copy()
    T[:3, 3] = trajectory.poses[:, :3, 3].mean(0) - back * T[:3, 2] - up * T[:3, 1]
    return T


def _project(points: np.ndarray, camera: Camera, T_world_view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels [N, 2] and depths [N] of world points [N, 3]; pixels behind the view are NaN."""
    T = np.linalg.inv(T_world_view)
    p = points @ T[:3, :3].T + T[:3, 3]
    u, v, depth = camera.project(p)
    pixels = np.stack([u, v], -1)
    pixels[depth <= 0] = np.nan
    return pixels, depth


def _splat_points(
    image: np.ndarray,  # [H, W], drawn into
    points: np.ndarray,  # [N, 3]
    brightness: np.ndarray,  # [N]
    camera: Camera,
    T_world_view: np.ndarray,
) -> None:
    """Draw points as 2x2 pixels, the nearest on top."""
    pixels, depth = _project(points, camera, T_world_view)
    with np.errstate(invalid="ignore"):
        inside = (
            (depth > NEAREST) & (pixels >= 0).all(1) & (pixels < (camera.width - 2, camera.height - 2)).all(1)
        )
    order = np.flatnonzero(inside)[np.argsort(-depth[inside])]
    x, y = pixels[order].astype(int).T
    for dy, dx in np.ndindex(2, 2):
        image[y + dy, x + dx] = brightness[order]


# ---------------------------------------------------------------- matplotlib


def _legend(ax: "Axes") -> None:
    handles, labels = ax.get_legend_handles_labels()
    unique = dict(zip(labels, handles))
    ax.legend(list(unique.values()), list(unique), fontsize=8, framealpha=0.8)


def colours() -> Iterator[str]:
    """Yield COLOURS again and again."""
    while True:
        yield from COLOURS
