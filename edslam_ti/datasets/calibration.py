"""Calibration files of the field: cameras and the transforms between them.

    ROS camera_info    image_width, image_height, camera_name, camera_model, camera_matrix,
                       distortion_coefficients, projection_matrix (matrices as {rows, cols, data})
    Kalibr camchain    cam0: {camera_model, intrinsics, distortion_model, distortion_coeffs, resolution,
                       T_cn_cnm1, T_cam_imu, rostopic}
    VECtor             cam0: {camera_name}, cam1: {camera_name, T_cam0_cam1}, T_cam_body, T_cam_lidar

A matrix may be 16 numbers, 4 rows of 4, or {rows, cols, data}.
"""

import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from edslam_ti.camera import Camera
from edslam_ti.datasets.files import file_bytes
from edslam_ti.errors import DataError, plain, shown
from edslam_ti.geometry import inverse, orthonormalized
from edslam_ti.lenses import Lens, model_name

RIGID = 1e-3  # entries of R R^T: factory calibrations have six digits
LARGEST_TEXT = 10_000_000  # bytes


def read_yaml(path: Path) -> Any:
    """Return the contents of a YAML file; a first line %YAML:1.0, as OpenCV writes it, is ignored."""
    data = file_bytes(path, "calibration")
    if len(data) > LARGEST_TEXT:
        raise DataError(f"{path}: calibration: expected at most {LARGEST_TEXT} bytes, got {len(data)}")
    text = data.decode("utf-8-sig", "replace")
    text = re.sub(r"^%YAML[^\n]*\n(---[^\n]*\n)?", "", text).replace("!!opencv-matrix", "")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = plain(" ".join(str(error).split()))
        raise DataError(f"{path}: calibration not readable as YAML ({reason})") from error


def numbers(value: Any, count: int | tuple[int, ...], what: str) -> np.ndarray:  # [count] float64
    """Return `count` numbers of a list, of nested lists, or of an OpenCV matrix."""
    counts = (count,) if isinstance(count, int) else count
    if isinstance(value, dict):
        value = value.get("data")
    try:
        result = np.array(value, np.float64).ravel()
    except (TypeError, ValueError):
        result = np.empty(0)
    if len(result) not in counts or not np.isfinite(result).all():
        wanted = " or ".join(str(n) for n in counts)
        raise DataError(f"{what}: expected {wanted} numbers, got {shown(value)}")
    return result


def rigid_motion(value: Any, what: str) -> np.ndarray:  # [4, 4]
    """Return a 4x4 rigid motion, orthonormal to rounding."""
    T = numbers(value, 16, what).reshape(4, 4)
    R = T[:3, :3]
    deviation = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(T[3] - (0, 0, 0, 1)).max())
    if deviation > RIGID or np.linalg.det(R) < 0:
        raise DataError(
            f"{what}: expected a rigid motion (rotation, translation in metres, last row 0 0 0 1), got "
            f"{np.array2string(T.ravel(), precision=4, max_line_width=10**6)}"
        )
    return orthonormalized(T)


def lens_of(model: str, coefficients: np.ndarray, camera: Camera, what: str) -> Lens:
    """Return a lens; its model is that of its name, unless the number of coefficients says another."""
    try:
        name = model_name(model) if model else "plumb_bob"
        values = [float(v) for v in coefficients]
        if name == "plumb_bob" and len(values) == 8:
            name = "rational"  # ROS and Kalibr call both by one name
        if name == "plumb_bob" and len(values) < 4:
            values += [0.0] * (4 - len(values))
        return Lens(camera, name, tuple(values))
    except DataError as error:
        raise DataError(f"{what}: {error}") from error


def ros_lens(values: dict[str, Any], path: Path | str) -> Lens:
    """Return the lens of ROS' camera_info."""
    K = numbers(values.get("camera_matrix"), 9, f"{path}: camera_matrix").reshape(3, 3)
    size = _size(values, path)
    D = numbers(
        values.get("distortion_coefficients", [0.0] * 5), (4, 5, 8), f"{path}: distortion_coefficients"
    )
    model = str(values.get("distortion_model") or values.get("camera_model") or "")
    model = "" if model.lower() == "pinhole" else model
    return lens_of(model, D, _camera(size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], path), str(path))


def projection_camera(values: dict[str, Any], path: Path | str) -> Camera | None:
    """Return the undistorted camera that ROS' camera_info states; None: it states none."""
    if "projection_matrix" not in values:
        return None
    P = numbers(values["projection_matrix"], 12, f"{path}: projection_matrix").reshape(3, 4)
    size = _size(values, path)
    return _camera(size, P[0, 0], P[1, 1], P[0, 2], P[1, 2], path)


def kalibr_lens(values: dict[str, Any], what: str) -> Lens:
    """Return the lens of one camera of a Kalibr camchain."""
    fx, fy, cx, cy = numbers(values.get("intrinsics"), 4, f"{what}: intrinsics")
    size = numbers(values.get("resolution"), 2, f"{what}: resolution")
    D = numbers(values.get("distortion_coeffs", [0.0] * 4), (4, 5, 8), f"{what}: distortion_coeffs")
    return lens_of(str(values.get("distortion_model", "")), D, _camera(size, fx, fy, cx, cy, what), what)


def _size(values: dict[str, Any], path: Path | str) -> np.ndarray:  # [2] px
    size = [values.get("image_width"), values.get("image_height")]
    return numbers(size, 2, f"{path}: image_width, image_height")


def _camera(size: np.ndarray, fx: float, fy: float, cx: float, cy: float, what: Path | str) -> Camera:
    try:
        return Camera(int(size[0]), int(size[1]), float(fx), float(fy), float(cx), float(cy))
    except DataError as error:
        raise DataError(f"{what}: {error}") from error


class Transforms:
    """Rigid motions between named frames, joined to chains."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, np.ndarray]] = {}

    def add(self, a: str, b: str, T_a_b: np.ndarray) -> None:
        """Add T_a_b; the first one that is added for two frames counts."""
        if b not in self._edges.setdefault(a, {}):
            self._edges[a][b] = T_a_b
            self._edges.setdefault(b, {})[a] = inverse(T_a_b)

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges

    def between(self, a: str, b: str) -> np.ndarray | None:  # [4, 4]
        """Return T_a_b by the shortest chain; None: there is none."""
        reached: dict[str, np.ndarray] = {a: np.eye(4)}
        waiting = deque([a])
        while waiting:
            frame = waiting.popleft()
            if frame == b:
                return reached[frame]
            for other, T in self._edges.get(frame, {}).items():
                if other not in reached:
                    reached[other] = reached[frame] @ T
                    waiting.append(other)
        return None


def named_transforms(
    values: dict[str, Any], names: dict[str, str], path: Path | str
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield the frames a, b and T_a_b of a VECtor file; `names` are those of cam0, ... that state none."""
    cameras = {k: v for k, v in values.items() if re.fullmatch(r"cam\d+", str(k)) and isinstance(v, dict)}
    if not cameras and "camera_name" in values:
        cameras = {"cam0": values}
    frames = {key: str(v.get("camera_name") or names.get(key, key)) for key, v in cameras.items()}
    for key, entry in cameras.items():
        for name, matrix in entry.items():
            ends = re.fullmatch(r"T_([A-Za-z]+\d*)_([A-Za-z]+\d*)", str(name))
            if ends is None:
                continue
            a, b = (frames[key] if end == "cam" else frames.get(end, end) for end in ends.groups())
            yield a, b, rigid_motion(matrix, f"{path}: {key}.{name}")
