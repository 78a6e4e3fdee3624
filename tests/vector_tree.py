"""A tree in VECtor's published layout, simulated through a calibration of its kind.

The event camera has its lens, the Kinect its own lens and place beside it, and the poses are those of a body
with markers. The layout is written from its description, not with the loader.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.kernels.event_simulation import EventSensorState, simulate_events
from edslam_ti.lenses import Lens
from edslam_ti.ray_casting import Hits
from edslam_ti.simulation import CameraPath, Scene, SimulationConfig
from edslam_ti.simulation.recording import _FrameTimes
from edslam_ti.simulation.renderer import Render, Renderer

EPOCH = 1642689268_750000  # us of the first event's clock
DEPTH_PHASE = 0.011  # s: the Kinect's stamps are its own
# The published numbers, rounded; T_a_b maps points of b to a.
T_GREY_EVENT = np.eye(4)
T_GREY_EVENT[:3] = [
    [0.99994, 0.0091837, 0.0058469, 0.00050858],
    [-0.0091314, 0.99992, -0.0089081, -0.04082],
    [-0.0059283, 0.0088542, 0.99994, -0.014078],
]
T_GREY_COLOUR = np.eye(4)
T_GREY_COLOUR[:3] = [
    [0.99997, -0.0066647, 0.0044289, 0.11758],
    [0.0065556, 0.99969, 0.024207, -0.035548],
    [-0.0045888, -0.024177, 0.9997, -0.00054764],
]
T_COLOUR_DEPTH = np.eye(4)
T_COLOUR_DEPTH[:3] = [
    [1.0, 0.00070953, -0.0016711, -0.031281],
    [-0.00054611, 0.9954, 0.095835, -0.0017016],
    [0.0017314, -0.095833, 0.9954, -0.012297],
]
T_GREY_BODY = np.eye(4)
T_GREY_BODY[:3] = [
    [-0.85714, 0.032767, -0.51405, 0.091277],
    [0.013221, -0.99625, -0.085549, -0.022554],
    [-0.51492, -0.080123, 0.85349, -0.029863],
]
for _T in (T_GREY_EVENT, T_GREY_COLOUR, T_COLOUR_DEPTH, T_GREY_BODY):
    _U, _, _Vt = np.linalg.svd(_T[:3, :3])
    _T[:3, :3] = _U @ _Vt
T_EVENT_DEPTH = np.linalg.inv(T_GREY_EVENT) @ T_GREY_COLOUR @ T_COLOUR_DEPTH
T_BODY_EVENT = np.linalg.inv(T_GREY_BODY) @ T_GREY_EVENT


@dataclass(frozen=True)
class Rig:
    """Sensors at a size; 1: VECtor's own, 640x480 and 640x576."""

    scale: float = 1.0

    @property
    def event_lens(self) -> Lens:
        camera = _scaled(Camera(640, 480, 327.32749, 327.46184, 304.97749, 235.37621), self.scale)
        return Lens(camera, "plumb_bob", (-0.031982, 0.041966, -0.000507, -0.001031, 0.0))

    @property
    def projection(self) -> Camera:
        return _scaled(Camera(640, 480, 339.69174, 340.96127, 305.8753, 235.33929), self.scale)

    @property
    def depth_lens(self) -> Lens:
        camera = _scaled(Camera(640, 576, 504.574, 504.674, 321.848, 336.139), self.scale)
        k = (5.3633, 3.35493, -1.08168e-05, -1.43868e-05, 0.163032, 5.69124, 5.13437, 0.887861)
        return Lens(camera, "rational", k)


class LensRenderer(Renderer):
    """Renders what a camera with a lens sees."""

    def __init__(self, scene: Scene, lens: Lens, samples: int = 6) -> None:
        super().__init__(scene, lens.pinhole, samples)
        rays = lens.rays.astype(np.float64)
        self._rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1).reshape(-1, 3)
        self._steps = [np.gradient(rays, axis=axis).reshape(-1, 2) for axis in (1, 0)]

    def _cast(
        self, T_world_camera: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, scale: float
    ) -> tuple[np.ndarray, Hits, np.ndarray, np.ndarray]:
        directions = np.repeat(self._rays[pixels], len(offsets), 0)
        for k, step in enumerate(self._steps):
            directions[:, :2] += (
                np.repeat(step[pixels], len(offsets), 0) * np.tile(offsets[:, k], len(pixels))[:, None]
            )
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = T_world_camera[:3, 3]
        rays[:, 3:] = directions @ T_world_camera[:3, :3].T
        return self._shaded(T_world_camera, rays, scale)


def write_vector_tree(
    folder: Path,
    scene: Scene,
    path: CameraPath,
    config: SimulationConfig,
    rig: Rig,
    phase: float = DEPTH_PHASE,
) -> None:
    """Write the recording of a path of the event camera; rates, duration and thresholds are the settings'."""
    name = folder.name + "1"
    folder.mkdir(parents=True)
    write_calibration(folder / "calibration", rig)
    duration = min(config.duration, path.duration)
    end = round(duration * 1e9)
    depth_times = [
        round(1e6 * (phase + k / config.depth_rate)) * 1000 for k in range(int(duration * config.depth_rate))
    ]
    depth_times = [t for t in depth_times if t <= end]
    depth_folder = folder / f"{name}.synced.kinect_depth"
    depth_folder.mkdir()
    kinect = LensRenderer(scene, rig.depth_lens)
    for t in depth_times:
        depth = kinect.render(path.pose(t / 1e9) @ T_EVENT_DEPTH).depth
        cv2.imwrite(str(depth_folder / f"{stamp(t)}.png"), np.rint(1000 * depth).astype(np.uint16))
    write_events(folder / f"{name}.synced.left_event.hdf5", *_events(scene, path, config, rig, end))
    rows = ["# ground truth", "# timestamp tx ty tz qx qy qz qw"]
    for k in range(int(120 * duration) + 1):
        t = min(round(k / 120 * 1e6) * 1000, end)
        T = path.pose(t / 1e9) @ np.linalg.inv(T_BODY_EVENT)
        numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
        rows.append(" ".join([f"{EPOCH / 1e6 + t / 1e9:.9f}", *(f"{v:.9f}" for v in numbers)]))
    (folder / f"{name}.synced.gt.txt").write_text("\n".join(rows) + "\n")
    imu = [
        f"{stamp(k * 5_000_000)} 0.1 0.2 0.3 0.0 9.81 {k / 100:.3f} 0 0 0 1"
        for k in range(int(200 * duration))
    ]
    header = ["# IMU data", "# gyroscope, accelerometer", "# timestamp gx gy gz ax ay az qx qy qz qw"]
    (folder / f"{name}.synced.imu.txt").write_text("\n".join([*header, *imu]) + "\n")
    grey = folder / f"{name}.synced.left_camera"
    grey.mkdir()
    starts = [k * 33_333_333 for k in range(int(30 * duration))]
    lines = [f"{stamp(t)} {stamp(t + 10_000_000)}" for t in starts]
    head = [
        "# Left Regular Camera's timestamp data",
        "# start and end of the exposure time[s] for each image",
    ]
    (grey / "timestamp.txt").write_text("\n".join([*head, *lines]) + "\n")
    cv2.imwrite(str(grey / f"{stamp(0)}.png"), np.full((1024, 1224), 90, np.uint8))


def stamp(t: int) -> str:
    """Return ns since the first event as seconds since the epoch with six digits, as the files have them."""
    us = EPOCH + t // 1000
    return f"{us // 1_000_000}.{us % 1_000_000:06d}"


def _events(scene: Scene, path: CameraPath, config: SimulationConfig, rig: Rig, end: int) -> list[np.ndarray]:
    """Return x, y, t (us), p of the event camera behind its lens."""
    renderer = LensRenderer(scene, rig.event_lens, config.samples_per_pixel)
    times = _FrameTimes(config, path, [end])

    def log_intensity(render: Render) -> np.ndarray:
        return np.log(render.grey + np.float32(config.log_epsilon))

    now, render = 0, renderer.render(path.pose(0.0))
    log_now = log_intensity(render)
    state, parts = EventSensorState.start(log_now), []
    while now < end:
        following = times.after(now, render.depth)
        render = renderer.render(path.pose(following / 1e9))
        log_next = log_intensity(render)
        C = config.contrast_threshold
        fired = simulate_events(log_now, log_next, now, following, state, C, C, 0.0, 0, config.seed)
        parts.append((fired.x, fired.y, fired.t // 1000, fired.polarity > 0))
        now, log_now = following, log_next
    x, y, t, p = (np.concatenate(column) for column in zip(*parts))
    order = np.argsort(t, kind="stable")
    return [x[order], y[order], t[order], p[order]]


def write_events(path: Path, x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray) -> None:
    """Write DSEC's layout; t in us from 0."""
    with h5py.File(path, "w") as file:
        for key, values, dtype in (("x", x, "u2"), ("y", y, "u2"), ("t", t, "u4"), ("p", p, "u1")):
            file.create_dataset(f"events/{key}", data=np.asarray(values).astype(dtype), chunks=True)
        ms = np.arange(int(t[-1]) // 1000 + 1)
        file.create_dataset("ms_to_idx", data=np.searchsorted(t, 1000 * ms).astype("u8"))
        file.create_dataset("t_offset", data=np.int64(EPOCH))


def write_calibration(folder: Path, rig: Rig) -> None:
    """Write the benchmark's YAML files."""
    folder.mkdir()
    event, depth = rig.event_lens, rig.depth_lens
    _write_intrinsics(
        folder / "left_event_camera_intrinsic_results.yaml", "left_event_camera", event, rig.projection
    )
    _write_intrinsics(
        folder / "rgbd_depth_camera_factory_intrinsic_results.yaml", "rgbd_depth_camera", depth, depth.pinhole
    )
    joint = {
        "camera_number": 5,
        "cam0": {"camera_name": "left_regular_camera"},
        "cam1": {"camera_name": "right_regular_camera", "T_cam0_cam1": np.eye(4).ravel().tolist()},
        "cam2": {"camera_name": "left_event_camera", "T_cam0_cam2": T_GREY_EVENT.ravel().tolist()},
        "cam3": {"camera_name": "right_event_camera", "T_cam0_cam3": np.eye(4).ravel().tolist()},
        "cam4": {"camera_name": "rgbd_color_camera", "T_cam0_cam4": T_GREY_COLOUR.ravel().tolist()},
    }
    rgbd = {
        "camera_number": 2,
        "cam0": {"camera_name": "rgbd_color_camera"},
        "cam1": {"camera_name": "rgbd_depth_camera", "T_cam0_cam1": T_COLOUR_DEPTH.ravel().tolist()},
    }
    mocap = {
        "camera_number": 1,
        "cam0": {
            "camera_name": "left_regular_camera",
            "T_body_cam": np.linalg.inv(T_GREY_BODY).ravel().tolist(),
            "T_cam_body": T_GREY_BODY.ravel().tolist(),
        },
    }
    for name, values in (
        ("small_scale_joint_camera_extrinsic_results", joint),
        ("rgbd_camera_calibrated_extrinsic_results", rgbd),
        ("camera_mocap_extrinsic_results1", mocap),
    ):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(values, default_flow_style=None, sort_keys=False))


def _write_intrinsics(path: Path, name: str, lens: Lens, projection: Camera) -> None:
    P = np.zeros((3, 4))
    P[:, :3] = projection.matrix
    camera = lens.pinhole
    values = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.matrix.ravel().tolist()},
        "camera_model": "plumb_bob",
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(lens.coefficients),
            "data": list(lens.coefficients),
        },
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": P.ravel().tolist()},
    }
    path.write_text(yaml.safe_dump(values, default_flow_style=None, sort_keys=False))


def _scaled(camera: Camera, scale: float) -> Camera:
    """Return a camera with fewer pixels of the same field of view."""
    shift = 0.5 * (1 - scale)
    return Camera(
        round(camera.width * scale),
        round(camera.height * scale),
        camera.fx * scale,
        camera.fy * scale,
        camera.cx * scale - shift,
        camera.cy * scale - shift,
    )
