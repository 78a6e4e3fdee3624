"""A finished run for other programs: splats, meshes and camera paths in their files."""

from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.mapping.rendering import render_view
from edslam_ti.output import atomic_file
from edslam_ti.results.camera_paths import image_names, write_colmap, write_kitti, write_nerfstudio
from edslam_ti.results.gltf import write_glb
from edslam_ti.results.maps import load_map
from edslam_ti.results.reading import Result, load_result, read_camera_of
from edslam_ti.results.splat_file import write_splat
from edslam_ti.viewer.shapes import up_direction

MOST_POINTS = 100_000  # in points3D.txt: programs start from them
BACKGROUND = 0.5  # brightness where a rendered image shows nothing

Progress = Callable[[float], None]  # receives the share done, 0 to 1


class Exporter:
    """Writes a results folder in other formats; each method returns the files it has written."""

    def __init__(self, folder: Path, out: Path) -> None:
        self.result: Result = load_result(folder)
        self._folder = folder
        self._out = out

    @cached_property
    def camera(self) -> Camera:
        """The camera of the run."""
        return read_camera_of(self._folder)

    def splat(self) -> list[Path]:
        """Write map.splat."""
        path = self._out / "map.splat"
        write_splat(path, self._folder / "map.ply")
        return [path]

    def glb(self) -> list[Path]:
        """Write mesh.glb, upright where the camera was held upright."""
        mesh, path = self.result.mesh, self._out / "mesh.glb"
        if mesh is None:
            raise DataError(f"{self._folder}: no mesh.ply in it; a run without a map makes none")
        vertices, colors = np.asarray(mesh.vertices), np.asarray(mesh.vertex_colors)
        colors = colors if len(colors) else np.full((len(vertices), 3), 0.5)
        write_glb(
            path, vertices, np.asarray(mesh.triangles), colors, up_direction(self.result.trajectory.poses)
        )
        return [path]

    def kitti(self) -> list[Path]:
        """Write trajectory_kitti.txt and times.txt."""
        paths = [self._out / "trajectory_kitti.txt", self._out / "times.txt"]
        write_kitti(self.result.trajectory, *paths)
        return paths

    def colmap(self) -> list[Path]:
        """Write a COLMAP model of the cameras and some of the map's points."""
        folder = self._out / "colmap"
        points, brightness = self.result.points, self.result.brightness
        if points is None or brightness is None:
            points, brightness = np.empty((0, 3)), np.empty(0)
        step = max(1, -(-len(points) // MOST_POINTS))
        write_colmap(folder, self.result.trajectory, self.camera, points[::step], brightness[::step])
        return [folder]

    def nerfstudio(self) -> list[Path]:
        """Write transforms.json."""
        path = self._out / "transforms.json"
        write_nerfstudio(path, self.result.trajectory, self.camera, "images")
        return [path]

    def images(self, progress: Progress) -> list[Path]:
        """Render the map at every pose, for colmap and nerfstudio; the kernels must have been started."""
        gaussians, folder = load_map(self._folder / "map.ply"), self._out / "images"
        names = image_names(self.result.trajectory)
        for k, (T, name) in enumerate(zip(self.result.trajectory.poses, names)):
            view = render_view(gaussians, self.camera, T, BACKGROUND)
            _write_grey(folder / name, view.intensity)
            progress((k + 1) / len(names))
        return [folder]


# By the name on the command line.
FORMATS: dict[str, Callable[[Exporter], list[Path]]] = {
    "splat": Exporter.splat,
    "glb": Exporter.glb,
    "kitti": Exporter.kitti,
    "colmap": Exporter.colmap,
    "nerfstudio": Exporter.nerfstudio,
}


def export_all(exporter: Exporter) -> Iterator[tuple[list[Path], str]]:
    """Write every format for which the run has what is needed; yield the files, or why there are none."""
    for name, write in FORMATS.items():
        try:
            yield write(exporter), ""
        except (DataError, FileNotFoundError) as error:
            yield [], f"left out: {name}: {error}"


def _write_grey(path: Path, image: np.ndarray) -> None:  # [H, W] in [0, 1]
    done, data = cv2.imencode(".png", np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))
    if not done:
        raise DataError(f"{path}: could not be encoded")
    with atomic_file(path) as temporary:
        temporary.write_bytes(data.tobytes())
