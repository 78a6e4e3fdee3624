"""Finished runs in an Open3D window."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import EdSlamError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.results.plots import colours
from edslam_ti.results.reading import load_result
from edslam_ti.viewer.shapes import frustum_lines, path_lines
from edslam_ti.viewer.window import HEIGHT, WIDTH, check_display, fill_cloud, fill_lines, look_from


def show_results(results: Sequence[Path]) -> None:
    """Show finished runs in an Open3D window until it is closed."""
    runs = [load_result(folder) for folder in results]
    check_display()
    o3d = load_open3d()
    window = o3d.visualization.Visualizer()
    title = "; ".join(run.title for run in runs)
    if not window.create_window(window_name=title, width=WIDTH, height=HEIGHT):
        raise EdSlamError("Open3D could not open a window (no OpenGL?); draw with --save FILE.png")
    for run, color in zip(runs, colours()):
        path = o3d.geometry.LineSet()
        lines = path_lines(run.trajectory.poses[:, :3, 3])
        every = max(1, len(run.trajectory) // 30)
        camera = Camera(width=4, height=3, fx=3.0, fy=3.0, cx=1.5, cy=1.0)
        lines += [line for T in run.trajectory.poses[::every] for line in frustum_lines(T, camera)]
        fill_lines(o3d, path, lines, color)
        window.add_geometry(path, reset_bounding_box=True)
        if run.mesh is not None:
            run.mesh.compute_vertex_normals()
            window.add_geometry(run.mesh, reset_bounding_box=True)
        elif run.points is not None and run.brightness is not None:
            cloud = o3d.geometry.PointCloud()
            fill_cloud(o3d, cloud, run.points, run.brightness)
            window.add_geometry(cloud, reset_bounding_box=True)
    look_from(o3d, window, np.concatenate([run.trajectory.poses for run in runs]))
    window.run()
    window.destroy_window()
