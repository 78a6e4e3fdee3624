"""Finished runs in an Open3D window."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edslam_ti.camera import Camera
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.plots import colours
from edslam_ti.results.reading import load_result
from edslam_ti.viewer.shapes import frustum_lines, path_lines
from edslam_ti.viewer.window import check_display, fill_cloud, fill_lines


def show_results(results: Sequence[Path]) -> None:
    """Show finished runs in an Open3D window until it is closed."""
    runs = [load_result(folder) for folder in results]
    check_display()
    o3d = load_open3d()
    shapes: list[Any] = []
    for run, color in zip(runs, colours()):
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
