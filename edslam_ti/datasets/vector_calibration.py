"""Calibration of the VECtor benchmark: its files, and the published values where a file is absent.

Frames are named as in the files: left_event_camera, left_regular_camera, rgbd_depth_camera,
rgbd_color_camera, body (markers of the motion capture), lidar. Files are recognised by what they contain.
Older downloads have the right regular camera as cam0 and newer ones the left, so that frames are joined by
their names.
"""

from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.calibration import (
    Transforms,
    kalibr_lens,
    named_transforms,
    projection_camera,
    read_yaml,
    rigid_motion,
    ros_lens,
)
from edslam_ti.errors import DataError
from edslam_ti.lenses import Lens

FOLDERS = ("", "calibration", "calib", "0_calib", "yaml")  # in the recording's folder and the one above
EVENT, GREY = "left_event_camera", "left_regular_camera"
DEPTH, COLOUR, BODY, LIDAR = "rgbd_depth_camera", "rgbd_color_camera", "body", "lidar"
# Names of cam0, cam1, ... in files that state none.
JOINT_NAMES = (GREY, "right_regular_camera", EVENT, "right_event_camera", COLOUR)
NAMES = {"joint": JOINT_NAMES, "rgbd": (COLOUR, DEPTH), "mocap": (GREY,), "lidar": (GREY, JOINT_NAMES[1])}

# Published by the benchmark (star-datasets.github.io/vector, calibration, small scale), for absent files.
_LENSES = {
    EVENT: Lens(
        Camera(640, 480, 327.32749, 327.46184, 304.97749, 235.37621),
        "plumb_bob",
        (-0.031982, 0.041966, -0.000507, -0.001031, 0.0),
    ),
    DEPTH: Lens(
        Camera(640, 576, 504.574, 504.674, 321.848, 336.139),
        "rational",
        (5.3633, 3.35493, -1.08168e-05, -1.43868e-05, 0.163032, 5.69124, 5.13437, 0.887861),
    ),
}
_PROJECTION = Camera(640, 480, 339.69174, 340.96127, 305.8753, 235.33929)  # of the event camera
_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
_SMALL_SCALE: list[tuple[str, str, list[float]]] = [
    (GREY, EVENT, [
        0.9999407352369797, 0.009183655542749752, 0.005846920950435052, 0.0005085820608404798,
        -0.009131364645448854, 0.9999186289230431, -0.008908070070089353, -0.04081979450823404,
        -0.005928253827254812, 0.008854151768176144, 0.9999432282899994, -0.0140781304960408]),
    (GREY, COLOUR, [
        0.999967982913079, -0.006664676837457846, 0.004428908601503605, 0.1175760281910061,
        0.006555580497133642, 0.9996854763455851, 0.0242068739833534, -0.03554784200383763,
        -0.004588846597329307, -0.02417706488291339, 0.9996971601542908, -0.0005476378655976542]),
]  # fmt: skip
_LARGE_SCALE: list[tuple[str, str, list[float]]] = [
    (GREY, EVENT, [
        0.9998732356434525, 0.01166113698213495, -0.01084114976267556, -0.0007543180009142757,
        -0.01183095928451621, 0.9998062047518974, -0.01573471772912168, -0.04067615384902421,
        0.01065556410055307, 0.01586098432919285, 0.9998174273985267, -0.01466127320771003]),
]  # fmt: skip
_RGBD: list[tuple[str, str, list[float]]] = [
    (COLOUR, DEPTH, [
        0.9999983519720124, 0.0007095286521193374, -0.001671114104806111, -0.03128054306089928,
        -0.0005461132760243128, 0.995397130621369, 0.0958345141952277, -0.001701648753243945,
        0.001731419518548352, -0.09583344363966775, 0.9953958776620555, -0.01229668401143895]),
]  # fmt: skip
_MOCAP: list[tuple[str, str, list[float]]] = [
    (GREY, BODY, [
        -0.857137023976571, 0.03276713258773897, -0.5140451703406658, 0.09127742788053987,
        0.01322063096422759, -0.9962462506036175, -0.08554895133864114, -0.02255409664008403,
        -0.5149187674240416, -0.08012317505073682, 0.853486344222504, -0.02986309837992267]),
]  # fmt: skip
_LIDAR: list[tuple[str, str, list[float]]] = [
    (GREY, LIDAR, [
        0.0119197, -0.999929, 0.0000523, 0.0853154,
        -0.00648951, -0.00012969, -0.999979, -0.0684439,
        0.999908, 0.0119191, -0.0064906, -0.0958121]),
]  # fmt: skip


class VectorCalibration:
    """Lenses and transforms of one recording; `published` names what no file states."""

    def __init__(self, folder: Path, is_large_scale: bool) -> None:
        self.lenses: dict[str, Lens] = {}
        self.projections: dict[str, Camera] = {}
        self.published: list[str] = []
        self._transforms = Transforms()
        scale, other = ("large_scale", "small_scale") if is_large_scale else ("small_scale", "large_scale")
        for path in _files(folder):
            if other in path.name or "cad_readings" in path.name:
                continue
            values = read_yaml(path)
            if isinstance(values, dict):
                self._take(path, values)
        joint = _LARGE_SCALE if is_large_scale else _SMALL_SCALE
        self._complete(f"{scale}_joint_camera_extrinsic_results.yaml", joint)
        if is_large_scale:
            self._complete("camera_lidar_extrinsic_results.yaml", _LIDAR)
        else:
            self._complete("rgbd_camera_calibrated_extrinsic_results.yaml", _RGBD)
            self._complete("camera_mocap_extrinsic_results1.yaml", _MOCAP)
        for name, lens in _LENSES.items():
            if name not in self.lenses:
                self.published.append(f"{name} intrinsics")
                self.lenses[name] = lens
                if name == EVENT:
                    self.projections[name] = _PROJECTION

    def between(self, a: str, b: str) -> np.ndarray:  # [4, 4]
        """Return T_a_b."""
        T = self._transforms.between(a, b)
        if T is None:
            raise DataError(f"VECtor calibration: no chain of transforms from {a} to {b}")
        return T

    def _take(self, path: Path, values: dict[str, Any]) -> None:
        """Keep what a file states; of two files the first one counts."""
        if "camera_matrix" in values:
            name = str(values.get("camera_name") or path.name.split("_intrinsic")[0].removesuffix("_factory"))
            if name not in self.lenses:
                self.lenses[name] = ros_lens(values, path)
                projection = projection_camera(values, path)
                if projection is not None:
                    self.projections[name] = projection
            return
        kind = next((kind for kind in NAMES if kind in path.name), None)
        names = {f"cam{k}": name for k, name in enumerate(NAMES[kind])} if kind else {}
        for a, b, T in named_transforms(values, names, path):
            self._transforms.add(a, b, T)
        for key, entry in values.items():
            if isinstance(entry, dict) and "intrinsics" in entry and "resolution" in entry:
                self.lenses.setdefault(
                    str(entry.get("camera_name") or names.get(key, key)), kalibr_lens(entry, f"{path}: {key}")
                )

    def _complete(self, file: str, published: list[tuple[str, str, list[float]]]) -> None:
        """Add the published transforms that the files do not state."""
        for a, b, matrix in published:
            if self._transforms.between(a, b) is None:
                self._transforms.add(a, b, rigid_motion([*matrix, *_LAST_ROW], f"published {a} to {b}"))
                if file not in self.published:
                    self.published.append(file)


def _files(folder: Path) -> list[Path]:
    """Return the calibration files nearest to a recording, calibrated ones before those of the factory."""
    for parent in (folder, folder.resolve().parent):
        found = [p for name in FOLDERS for p in sorted((parent / name).glob("*.y*ml")) if p.is_file()]
        if found:
            return sorted(found, key=lambda path: "factory" in path.name)
    return []
