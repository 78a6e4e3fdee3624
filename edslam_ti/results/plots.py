"""Seeing a run: plots of trajectories and maps (matplotlib, no display) and an Open3D window."""

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError, EdSlamError
from edslam_ti.evaluation.images import trajectory_errors
from edslam_ti.mapping.gaussian_mapper import GaussianMapper
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.mapping.volume import MeshView
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.pictures import new_figure, save_figure
from edslam_ti.trajectory import Trajectory, read_tum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colour-blind safe (Okabe and Ito); the truth is black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
START, END = "#009E73", "#D55E00"
MAX_DRAWN_POINTS = 60_000
MAP_EVERY = 5  # the window fetches the map points at every n-th frame


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
    except DataError:  # too few poses to compare: there is something to draw all the same
        return AlignedPath(positions, unknown)
    unknown[compared.indices] = compared.errors_cm / 100
    T = compared.T_truth_estimate
    return AlignedPath(positions @ T[:3, :3].T + T[:3, 3], unknown)


def plot_trajectory(path: Path, estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> None:
    """Draw top and side views of estimates, aligned to the truth when there is one.

    A single estimate is coloured by its position error; several by name.
    """
    paths = {
        name: align_to_truth(estimate, truth) for name, estimate in estimates.items() if len(estimate) > 0
    }
    if not paths:
        raise DataError(f"{path.name}: expected at least one trajectory with poses, got none")
    figure = new_figure(11, 5)
    views = _top_and_side(next(e for e in estimates.values() if len(e)) if truth is None else truth)
    axes = figure.subplots(1, 2)
    for ax, view in zip(axes, views):
        if truth is not None and len(truth):
            _draw_path(ax, truth.poses[:, :3, 3], view, color="black", label="truth", linewidth=1.2)
        only = next(iter(paths.values())) if len(paths) == 1 else None
        if only is not None and np.isfinite(only.errors).sum() >= 2:
            bar = _draw_errors(ax, only, view)
            if ax is axes[-1]:
                figure.colorbar(bar, ax=list(axes), label="position error [cm]", fraction=0.03, pad=0.02)
        else:
            for (name, aligned), color in zip(paths.items(), _colours()):
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
    """Draw every value of every series as a dot, group beside group, and each series' median as a bar."""
    series = list(dict.fromkeys(name for values in groups.values() for name in values))
    figure = new_figure(max(5.0, 1.0 + 1.4 * len(groups)), 4.0)
    ax = figure.add_subplot()
    for k, (name, colour) in enumerate(zip(series, _colours())):
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
    """Draw the error (cm) over the path travelled (m) of each curve, the first poses laid together."""
    figure = new_figure(7.0, 4.0)
    ax = figure.add_subplot()
    for (name, (travelled, error)), colour in zip(curves.items(), _colours()):
        ax.plot(travelled, error, color=colour, label=name, lw=1)
    ax.set_xlabel("path travelled [m]")
    ax.set_ylabel("distance from the truth [cm]")
    ax.grid(alpha=0.3)
    _legend(ax)
    save_figure(figure, path)


# ---------------------------------------------------------------- finished runs


@dataclass(frozen=True)
class Result:
    """What can be shown of a results folder; parts a run did not make are None."""

    folder: Path
    trajectory: Trajectory
    truth: Trajectory | None
    metrics: dict[str, Any]
    points: np.ndarray | None  # [N, 3] metres
    brightness: np.ndarray | None  # [N]
    mesh: Any | None  # open3d TriangleMesh

    @property
    def title(self) -> str:
        """Scene, method and ATE, as far as metrics.json tells, else the folder's name."""
        words = [str(self.metrics[key]) for key in ("scene", "method") if self.metrics.get(key)]
        ate = self.metrics.get("ate_rmse_cm")
        name = " ".join(words) or self.folder.name
        return name if ate is None else f"{name}: ATE {ate:.2f} cm rmse"


def load_result(folder: Path) -> Result:
    """Read a results folder; it must hold `trajectory_tum.txt`, all else is optional."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: results folder not found")
    trajectory_path = folder / "trajectory_tum.txt"
    if not trajectory_path.is_file():
        raise DataError(
            f"{folder}: not a results folder (no trajectory_tum.txt); give one that `edslam slam` made"
        )
    truth_path, metrics_path = folder / "truth_tum.txt", folder / "metrics.json"
    try:
        metrics = json.loads(metrics_path.read_text()) if metrics_path.is_file() else {}
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{metrics_path}: not readable as JSON ({error})") from error
    points = brightness = mesh = None
    o3d = load_open3d()
    if (folder / "points.ply").is_file():
        cloud = o3d.io.read_point_cloud(str(folder / "points.ply"))
        if not len(cloud.points):
            raise DataError(f"{folder / 'points.ply'}: expected a point cloud, could not read any point")
        points = np.asarray(cloud.points)
        brightness = np.asarray(cloud.colors).mean(1) if cloud.has_colors() else np.full(len(points), 0.5)
    if (folder / "mesh.ply").is_file():
        mesh = o3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
        if not len(mesh.triangles):
            raise DataError(f"{folder / 'mesh.ply'}: expected a mesh, could not read any triangle")
    return Result(
        folder=folder,
        trajectory=read_tum(trajectory_path),
        truth=read_tum(truth_path) if truth_path.is_file() else None,
        metrics=metrics,
        points=points,
        brightness=brightness,
        mesh=mesh,
    )


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
            _draw_path(ax, truth.poses[:, :3, 3], view, color="black", label="truth", linewidth=1.2)
        for run, color in zip(runs, _colours()):
            _draw_path(ax, run.trajectory.poses[:, :3, 3], view, color=color, label=run.title, linewidth=2)
        _mark_ends(ax, runs[0].trajectory.poses[:, :3, 3], view)
        _finish_axes(ax, view)
        if k == 0:
            _legend(ax)
    save_figure(figure, path)


def _draw_points(ax: "Axes", runs: Sequence[Result], view: _PlanarView) -> None:
    """Draw the map points of every run that has some, in their brightness."""
    ax.set_facecolor("#dfe5ec")  # bright points show, too
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
    for run, color in zip(runs, _colours()):
        pixels, depth = _project(run.trajectory.poses[:, :3, 3], camera, T_world_view)
        pixels[depth < 0.05] = np.nan
        ax.plot(*pixels.T, color=color, linewidth=2)
        for T in run.trajectory.poses[:: max(1, len(run.trajectory) // 6)]:
            for line in frustum_lines(T, camera, size=0.08):
                corners, line_depth = _project(line, camera, T_world_view)
                if (line_depth > 0.05).all():
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
    z = np.where(p[:, 2] > 1e-6, p[:, 2], np.nan)
    pixels = np.stack([camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy], -1)
    return pixels, p[:, 2]


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
            (depth > 0.05) & (pixels >= 0).all(1) & (pixels < (camera.width - 2, camera.height - 2)).all(1)
        )
    order = np.flatnonzero(inside)[np.argsort(-depth[inside])]
    x, y = pixels[order].astype(int).T
    for dy, dx in np.ndindex(2, 2):
        image[y + dy, x + dx] = brightness[order]


# ---------------------------------------------------------------- the window


class StubViewer:
    """Shows nothing; the interface of `Viewer`."""

    def update(self, trajectory: Trajectory, mapper: Mapper | None, camera: Camera) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def check_display() -> None:
    """Raise EdSlamError where no window can be opened."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise EdSlamError(
            "no display for a window (neither DISPLAY nor WAYLAND_DISPLAY is set); run without "
            "--visualize, and draw finished runs with: edslam view RESULT --save FILE.png"
        )


class Viewer:
    """An Open3D window that follows a run: trajectory, keyframe frusta and map points."""

    def __init__(self, title: str = "ED-SLAM") -> None:
        """Open the window, or raise EdSlamError where that is impossible."""
        check_display()
        self._o3d = o3d = load_open3d()
        self._window = o3d.visualization.Visualizer()
        if not self._window.create_window(window_name=title, width=1280, height=720):
            raise EdSlamError("Open3D could not open a window (no OpenGL?); run without --visualize")
        self._path = o3d.geometry.LineSet()
        self._frusta = o3d.geometry.LineSet()
        self._cloud = o3d.geometry.PointCloud()
        self._shown: list[Any] = []
        self._num_updates = 0

    def update(self, trajectory: Trajectory, mapper: Mapper | None, camera: Camera) -> None:
        """Show the state of the run and return at once."""
        if len(trajectory) < 2:
            return
        fill_lines(self._o3d, self._path, path_lines(trajectory.poses[:, :3, 3]), COLOURS[0])
        keyframes = [trajectory.pose(k) for k in _keyframe_indices(mapper, len(trajectory))]
        frusta = [line for T in [*keyframes, trajectory.pose(-1)] for line in frustum_lines(T, camera)]
        fill_lines(self._o3d, self._frusta, frusta, COLOURS[1])
        shapes = [self._path, self._frusta]
        if mapper is not None and self._num_updates % MAP_EVERY == 0:
            points, brightness = mapper.points()
            if len(points):
                fill_cloud(self._o3d, self._cloud, points, brightness)
                shapes.append(self._cloud)
        self._num_updates += 1
        for shape in shapes:
            if any(shape is shown for shown in self._shown):
                self._window.update_geometry(shape)
            else:
                self._window.add_geometry(shape, reset_bounding_box=True)
                self._shown.append(shape)
                self._look_along(trajectory.pose(0))
        self._window.poll_events()
        self._window.update_renderer()

    def close(self) -> None:
        """Take the window away."""
        self._window.destroy_window()

    def _look_along(self, T_world_camera: np.ndarray) -> None:
        control = self._window.get_view_control()
        control.set_front(-T_world_camera[:3, 2])  # from the scene to the eye
        control.set_up(-T_world_camera[:3, 1])
        control.set_zoom(0.4)


def _keyframe_indices(mapper: Mapper | None, num_frames: int) -> list[int]:
    """Return the frames a map is built on; every tenth for a map without keyframes."""
    if isinstance(mapper, GaussianMapper):
        return [keyframe.index for keyframe in mapper.keyframes]
    return list(range(0, num_frames, 10))


def show_results(results: Sequence[Path]) -> None:
    """Show finished runs in an Open3D window until it is closed."""
    runs = [load_result(folder) for folder in results]
    check_display()
    o3d = load_open3d()
    shapes: list[Any] = []
    for run, color in zip(runs, _colours()):
        path = o3d.geometry.LineSet()
        lines = path_lines(run.trajectory.poses[:, :3, 3])
        every = max(1, len(run.trajectory) // 30)
        camera = Camera(width=4, height=3, fx=3.0, fy=3.0, cx=1.5, cy=1.0)
        lines += [line for T in run.trajectory.poses[::every] for line in frustum_lines(T, camera)]
        fill_lines(o3d, path, lines, color)
        shapes.append(path)
        if run.mesh is not None:
            run.mesh.compute_vertex_normals()
            shapes.append(run.mesh)
        elif run.points is not None and run.brightness is not None:
            cloud = o3d.geometry.PointCloud()
            fill_cloud(o3d, cloud, run.points, run.brightness)
            shapes.append(cloud)
    o3d.visualization.draw_geometries(shapes, window_name="; ".join(run.title for run in runs))


def path_lines(positions: np.ndarray) -> list[np.ndarray]:  # [F, 3] -> F - 1 lines [2, 3]
    """Return the segments of a path."""
    return [positions[k : k + 2] for k in range(len(positions) - 1)]


def frustum_lines(T_world_camera: np.ndarray, camera: Camera, size: float = 0.05) -> list[np.ndarray]:
    """Return the eight edges [2, 3] of a camera's pyramid, `size` metres deep."""
    columns, rows = (-0.5, camera.width - 0.5), (-0.5, camera.height - 0.5)
    corners = np.array(
        [
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
            for u, v in (
                (columns[0], rows[0]),
                (columns[1], rows[0]),
                (columns[1], rows[1]),
                (columns[0], rows[1]),
            )
        ]
    )  # [4, 3]
    apex = T_world_camera[:3, 3]
    base = size * corners @ T_world_camera[:3, :3].T + apex
    return [np.stack([base[k], base[(k + 1) % 4]]) for k in range(4)] + [np.stack([apex, b]) for b in base]


def fill_lines(o3d: Any, shape: Any, lines: Sequence[np.ndarray], color: str) -> None:
    """Set an Open3D LineSet to lines [2, 3] of one colour."""
    from matplotlib.colors import to_rgb

    shape.points = o3d.utility.Vector3dVector(np.concatenate(lines))
    shape.lines = o3d.utility.Vector2iVector(np.arange(2 * len(lines), dtype=np.int32).reshape(-1, 2))
    shape.paint_uniform_color(to_rgb(color))


def fill_cloud(o3d: Any, cloud: Any, points: np.ndarray, brightness: np.ndarray) -> None:
    """Set an Open3D PointCloud to points [N, 3] in grey [N]."""
    cloud.points = o3d.utility.Vector3dVector(np.asarray(points, np.float64))
    grey = np.clip(np.reshape(brightness, (-1, 1)), 0, 1)
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(grey, 3, axis=1).astype(np.float64))


# ---------------------------------------------------------------- matplotlib


def _legend(ax: "Axes") -> None:
    handles, labels = ax.get_legend_handles_labels()
    unique = dict(zip(labels, handles))
    ax.legend(list(unique.values()), list(unique), fontsize=8, framealpha=0.8)


def _colours() -> Iterator[str]:
    while True:
        yield from COLOURS
