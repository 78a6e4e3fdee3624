"""DSEC, TUM-VIE, MVSEC and M3ED in their published layouts, and depth from another folder.

All show one plane through a lens, so that depth, events, images and poses can be computed by hand.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, find_sequence, open_sequence
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.identity import identity_of
from edslam_ti.lenses import Lens

W, H = 48, 36
START = 1_600_000_000_500_000  # us, where stamps are absolute
NORMAL, DISTANCE = np.array([0.1, -0.2, 1.0]), 3.0  # the plane n . p = d, m
SENSOR = Camera(W, H, 40.0, 41.0, 23.0, 18.5)
RADTAN = Lens(SENSOR, "plumb_bob", (-0.2, 0.05, 1e-3, -1e-3))
FISHEYE = Lens(SENSOR, "equidistant", (-0.05, 0.01, -0.02, 0.005))
T_A = np.eye(4)  # some motion
T_A[:3, :3], T_A[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), [0.05, 0.1, -0.02]
T_B = np.eye(4)
T_B[:3, :3], T_B[:3, 3] = Rotation.from_rotvec([-0.1, 0.4, 0.2]).as_matrix(), [-0.03, 0.02, 0.04]
R_RECT = Rotation.from_rotvec([0.02, -0.05, 0.01]).as_matrix()


def plane_depth(rays: np.ndarray, R: np.ndarray | None = None) -> np.ndarray:  # [H, W, 2] -> [H, W] m
    """Return the plane's depth along rays of a camera that R turns against the sensor."""
    n = NORMAL if R is None else R @ NORMAL
    return np.asarray(DISTANCE / (rays @ n[:2] + n[2]))


def path_poses(n: int) -> np.ndarray:  # [n, 4, 4]
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.linspace(0, 0.3, n), [0.1, 1.0, 0.2])).as_matrix()
    poses[:, :3, 3] = np.outer(np.linspace(0, 0.2, n), [1.0, 0.5, -0.3])
    return poses


def some_columns(n: int = 4000, span: int = 400_000) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    t = np.sort(random.integers(0, span, n))
    t[0], t[-1] = 0, span - 1
    return {
        "x": random.integers(0, W, n).astype("u2"),
        "y": random.integers(0, H, n).astype("u2"),
        "t": t.astype("u4"),
        "p": random.integers(0, 2, n).astype("u1"),
    }


@dataclass
class Tree:
    """A written recording and what is true of it."""

    folder: Path
    lens: Lens
    first: float  # s, of the first event, on the files' clock
    depth_times: list[float]  # s, on the files' clock
    R: np.ndarray | None = None  # of the undistorted camera against the sensor
    poses: np.ndarray | None = (
        None  # [5, 4, 4] of the undistorted camera, every 0.1 s from the first event on
    )
    tolerance: float = 0.02  # of depth; nearest measurements are half a pixel off


def write_columns(group: h5py.Group, columns: dict[str, np.ndarray]) -> None:
    for name, values in columns.items():
        group.create_dataset(name, data=values)


def write_dsec(folder: Path) -> Tree:
    (folder / "events/left").mkdir(parents=True)
    with h5py.File(folder / "events/left/events.h5", "w") as file:
        columns = some_columns()
        write_columns(file.create_group("events"), columns)
        file["t_offset"] = np.int64(START)
        file["ms_to_idx"] = np.searchsorted(columns["t"], 1000 * np.arange(400)).astype("u8")
    rectified = Camera(W, H, 36.0, 36.0, 22.0, 17.0)
    baseline = 0.6
    Q = [[1, 0, 0, -22.0], [0, 1, 0, -17.0], [0, 0, 0, 36.0], [0, 0, 1 / baseline, 0]]
    (folder / "calibration").mkdir()
    calibration = {
        "intrinsics": {
            "cam0": {
                "camera_model": "pinhole",
                "camera_matrix": list(SENSOR.intrinsics),
                "distortion_model": "radtan",
                "distortion_coeffs": list(RADTAN.coefficients),
                "resolution": [W, H],
            },
            "camRect0": {"camera_model": "pinhole", "camera_matrix": list(rectified.intrinsics)},
        },
        "extrinsics": {"R_rect0": R_RECT.tolist()},
        "disparity_to_depth": {"cams_03": Q},
    }
    (folder / "calibration/cam_to_cam.yaml").write_text(yaml.safe_dump(calibration))
    (folder / "disparity/event").mkdir(parents=True)
    disparity = 36.0 * baseline / plane_depth(rectified.rays()[..., :2], R_RECT)
    image = np.rint(256 * disparity).astype(np.uint16)
    image[0, 0] = 0
    times = [START + 100_000, START + 200_000]
    for k in range(2):
        cv2.imwrite(str(folder / f"disparity/event/{2 * k:06d}.png"), image)
    (folder / "disparity/timestamps.txt").write_text("\n".join(str(t) for t in times) + "\n")
    return Tree(folder, RADTAN, START / 1e6, [t / 1e6 for t in times], R_RECT, None, 2e-3)


def write_tum_vie(folder: Path) -> Tree:
    texts = folder / f"{folder.name}-vi_gt_data"
    texts.mkdir(parents=True)
    with h5py.File(folder / f"{folder.name}-events_left.h5", "w") as file:
        write_columns(file.create_group("events"), some_columns())

    def motion(T: np.ndarray) -> dict[str, float]:
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), (float(v) for v in numbers)))

    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    numbers = dict(zip(names, (*SENSOR.intrinsics, *FISHEYE.coefficients)))
    other = dict.fromkeys(names, 1.0)
    cameras = [{"camera_type": "kb4", "intrinsics": v} for v in (other, other, numbers, other)]
    for letter, T in (("A", T_A), ("B", np.eye(4))):
        values: dict[str, Any] = {
            "T_imu_cam": [motion(np.eye(4)), motion(np.eye(4)), motion(T), motion(np.eye(4))],
            "intrinsics": cameras,
            "resolution": [[1024, 1024], [1024, 1024], [W, H], [W, H]],
        }
        (folder.parent / f"camera-calibration{letter}.json").write_text(json.dumps({"value0": values}))
        markers = {"value0": {"T_imu_marker": motion(T_B)}}
        (folder.parent / f"mocap-imu-calibration{letter}.json").write_text(json.dumps(markers))
    poses = path_poses(5)
    body = poses @ np.linalg.inv(np.linalg.inv(T_B) @ T_A)
    rows = [[100_000 * k, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()] for k, T in enumerate(body)]
    (texts / "mocap_data.txt").write_text("\n".join(" ".join(f"{v:.12g}" for v in row) for row in rows))
    imu = [[5000 * k, 0.1, 0.2, 0.3, 0.5, 9.8, k / 10, 30] for k in range(80)]
    (texts / "imu_data.txt").write_text(
        "# t gx gy gz ax ay az temperature\n" + "\n".join(" ".join(map(str, r)) for r in imu)
    )
    return Tree(folder, FISHEYE, 0.0, [], None, poses)


def write_mvsec(folder: Path, rectified: bool = True) -> Tree:
    folder.mkdir(parents=True)
    t = some_columns()
    start = 1.5e9
    with h5py.File(folder / "indoor_flying1_data.hdf5", "w") as file:
        left = file.create_group("davis/left")
        rows = np.stack([t["x"], t["y"], start + t["t"] / 1e6, 2.0 * t["p"] - 1], -1)
        left["events"] = rows
        file["davis/right/events"] = rows[:100]
        left["image_raw"] = np.full((3, H, W), 51, np.uint8)
        left["image_raw_ts"] = start + np.array([0.05, 0.15, 0.25])
        left["imu"] = np.tile([0.1, 9.8, 0.2, 0.01, 0.02, 0.03], (40, 1))
        left["imu_ts"] = start + np.arange(40) / 100
    cam0: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": list(SENSOR.intrinsics),
        "distortion_model": "equidistant",
        "distortion_coeffs": list(FISHEYE.coefficients),
        "resolution": [W, H],
    }
    target = Camera(W, H, 38.0, 38.0, 22.5, 18.0)
    if rectified:
        cam0["projection_matrix"] = [[38.0, 0, 22.5, 0], [0, 38.0, 18.0, 0], [0, 0, 1, 0]]
        cam0["rectification_matrix"] = R_RECT.tolist()
    calibration = folder / "indoor_flying_calib"
    calibration.mkdir()
    (calibration / "camchain-imucam-indoor_flying.yaml").write_text(yaml.safe_dump({"cam0": cam0}))
    poses = path_poses(5)
    with h5py.File(folder / "indoor_flying1_gt.hdf5", "w") as file:
        left = file.create_group("davis/left")
        rect, raw = plane_depth(target.rays()[..., :2], R_RECT), plane_depth(FISHEYE.rays.astype(float))
        for name, depth in (("rect", rect), ("raw", raw)):
            depth = depth.astype("f4")
            depth[0, 0] = np.nan
            left[f"depth_image_{name}"] = np.stack([depth] * 3)
            left[f"depth_image_{name}_ts"] = start + np.array([0.1, 0.2, 0.3])
        left["pose"], left["pose_ts"] = poses, start + np.arange(5) / 10
    turned = np.eye(4)
    turned[:3, :3] = R_RECT.T
    times = [start + s for s in (0.1, 0.2, 0.3)]
    if rectified:
        return Tree(folder, FISHEYE, start, times, R_RECT, poses @ turned, 1e-5)
    return Tree(folder, FISHEYE, start, times, None, poses)


def write_m3ed(folder: Path) -> Tree:
    folder.mkdir(parents=True)
    with h5py.File(folder / "spot_indoor_data.h5", "w") as file:
        left = file.create_group("prophesee/left")
        columns = some_columns()
        write_columns(left, columns)
        left["ms_map_idx"] = np.searchsorted(columns["t"], 1000 * np.arange(400)).astype("u8")
        write_columns(file.create_group("prophesee/right"), {k: v[:50] for k, v in columns.items()})
        left["calib/intrinsics"] = np.array(SENSOR.intrinsics)
        left["calib/distortion_coeffs"] = np.array(RADTAN.coefficients)
        left["calib/distortion_model"] = "radtan"
        left["calib/camera_model"] = "pinhole"
        left["calib/resolution"] = np.array([W, H])
        file["ovc/imu/ts"] = 2500.0 * np.arange(100)
        file["ovc/imu/omega"] = np.tile([0.1, 0.2, 0.3], (100, 1))
        file["ovc/imu/accel"] = np.tile([0.0, 0.0, 9.8], (100, 1))
    poses = path_poses(5)
    with h5py.File(folder / "spot_indoor_depth_gt.h5", "w") as file:
        depth = plane_depth(RADTAN.rays.astype(float)).astype("f4")
        depth[0, 0] = np.inf
        file["depth/prophesee/left"] = np.stack([depth] * 5)
        file["ts"] = 1e5 * np.arange(5)
        file["Cn_T_C0"] = np.linalg.inv(poses)
    return Tree(folder, RADTAN, 0.0, [0.1 * k for k in range(5)], None, poses)


WRITERS = {
    "dsec": write_dsec,
    "tum_vie": write_tum_vie,
    "mvsec": write_mvsec,
    "mvsec_raw": lambda folder: write_mvsec(folder, rectified=False),
    "m3ed": write_m3ed,
}


@pytest.fixture(params=WRITERS)
def tree(request: pytest.FixtureRequest, tmp_path: Path) -> Tree:
    name = {"tum_vie": "mocap-desk2"}.get(request.param, request.param)
    return WRITERS[request.param](tmp_path / "data" / name)


def opened(tree: Tree, **settings: Any) -> EventDepthSequence:
    return open_sequence(Config(scene=tree.folder.name, data_dir=tree.folder.parent, **settings))


def write_depth_folder(folder: Path, times: list[float], camera: Camera, T: np.ndarray | None = None) -> None:
    """Write depth of the plane in a camera; T: where it is in the event camera's frame."""
    folder.mkdir()
    own = (NORMAL, DISTANCE) if T is None else (T[:3, :3].T @ NORMAL, DISTANCE - NORMAL @ T[:3, 3])
    depth = own[1] / (camera.rays() @ own[0])
    for t in times:
        cv2.imwrite(str(folder / f"{t:.6f}.png"), np.rint(1000 * depth).astype(np.uint16))


def test_every_layout_is_recognised_and_undistorted(tree: Tree, tmp_path: Path) -> None:
    dataset = find_sequence(Config(scene=tree.folder.name, data_dir=tree.folder.parent)).dataset
    assert tree.folder.name.startswith(dataset) or dataset == "tum_vie"
    settings = {}
    if dataset == "tum_vie":
        with pytest.raises(DataError, match=r"no depth: TUM-VIE has none.* --depth-dir FOLDER"):
            opened(tree)
        write_depth_folder(tmp_path / "depth", [0.1, 0.2], tree.lens.best_fit)
        settings = {"depth_dir": tmp_path / "depth"}
        tree.depth_times = [0.1, 0.2]
    sequence = opened(tree, **settings)
    offset = sequence.time_offset
    first, last = sequence.time_range
    assert (first + offset, last - first) == pytest.approx((tree.first, 0.399999), abs=2e-6)
    assert sequence.num_dropped_events == 0
    assert sequence.depth_timestamps + offset == pytest.approx(tree.depth_times, abs=1e-6)
    truth = plane_depth(sequence.camera.rays()[..., :2], tree.R)
    depth = sequence.depth(1)
    valid = depth > 0
    assert valid.mean() > 0.9
    assert (np.abs(depth - truth)[valid] / truth[valid]).max() < tree.tolerance

    raw, counts = np.zeros((H, W), np.float32), np.zeros((H, W))
    columns = some_columns()
    np.add.at(raw, (columns["y"], columns["x"]), 2.0 * columns["p"] - 1)
    events = sequence.events(first, last + 1)
    np.add.at(counts, (events.y, events.x), events.polarity)
    rays = sequence.camera.rays().reshape(-1, 3) @ (np.eye(3) if tree.R is None else tree.R)
    u, v = np.rint(tree.lens.project(rays[:, :2] / rays[:, 2:])).astype(int).T
    seen = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    expected = np.where(seen, raw[np.where(seen, v, 0), np.where(seen, u, 0)], 0).reshape(H, W)
    assert (counts != expected).mean() < 0.01  # float32 maps round differently at half pixels

    if tree.poses is not None:
        for k in (0, 2, 4):
            pose = sequence.true_pose(tree.first - offset + 0.1 * k)
            assert pose is not None
            assert np.abs(pose - tree.poses[k]).max() < 1e-6
    if dataset in ("tum_vie", "mvsec", "m3ed"):
        assert sequence.imu is not None
        assert np.linalg.norm(sequence.imu.acceleration, axis=1) == pytest.approx(9.8, rel=0.6)
        assert np.abs(sequence.imu.angular_velocity).max() < 0.4
        assert abs(sequence.imu.timestamps[0] - first) < 0.02
    if dataset == "mvsec":
        assert sequence.image_timestamps + offset == pytest.approx([1.5e9 + s for s in (0.05, 0.15, 0.25)])
        assert sequence.image(1)[H // 2, W // 2] == pytest.approx(0.2)


def test_depth_of_another_camera_is_drawn_into_the_event_camera(tmp_path: Path) -> None:
    tree = write_m3ed(tmp_path / "data/m3ed")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.03, -0.02, 0.01]).as_matrix(), [0.08, 0.01, -0.02]
    camera = Camera(64, 48, 45.0, 45.0, 31.5, 23.5)
    write_depth_folder(tmp_path / "depth", [0.05, 0.15, 0.25, 0.35], camera, T)
    values = dict(zip(("width", "height", "fx", "fy", "cx", "cy"), (64, 48, *camera.intrinsics)))
    text = json.dumps({**values, "T_events_depth": T.ravel().tolist()})
    (tmp_path / "depth/camera.json").write_text(text)
    sequence = opened(tree, depth_dir=tmp_path / "depth")
    assert "; depth of" in sequence.description
    assert sequence.depth_timestamps == pytest.approx([0.05, 0.15, 0.25, 0.35])
    truth, depth = plane_depth(sequence.camera.rays()[..., :2]), sequence.depth(2)
    valid = depth > 0
    assert valid.mean() > 0.7
    assert (np.abs(depth - truth)[valid] / truth[valid]).max() < 2e-3

    (tmp_path / "depth/camera.json").write_text(text.replace('"fy"', '"fz"'))
    with pytest.raises(DataError, match=r"camera\.json: .*expected all of|unknown key 'fz'"):
        opened(tree, depth_dir=tmp_path / "depth")
    with pytest.raises(FileNotFoundError, match="depth folder not found"):
        opened(tree, depth_dir=tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="crop: expected with vector alone"):
        opened(tree, crop=True)


def test_depth_files_may_have_numbers_and_a_list_of_times(tmp_path: Path) -> None:
    tree = write_m3ed(tmp_path / "data/m3ed")
    folder = tmp_path / "depth"
    write_depth_folder(folder, [7.0, 8.0], tree.lens.best_fit)
    (folder / "7.000000.png").rename(folder / "depth_7.png")
    (folder / "8.000000.png").rename(folder / "depth_8.png")
    (folder / "timestamps.txt").write_text("7 0.3\n8 0.1\n")
    sequence = opened(tree, depth_dir=folder)
    assert sequence.depth_timestamps == pytest.approx([0.1, 0.3])
    (folder / "timestamps.txt").write_text("7 1000.3\n8 1000.1\n")
    with pytest.raises(DataError, match="the clocks differ: depth covers"):
        opened(tree, depth_dir=folder)


@pytest.mark.parametrize(
    ("name", "file", "change", "message"),
    [
        ("dsec", "calibration/cam_to_cam.yaml", "a: 1", r"cam_to_cam\.yaml: expected intrinsics cam0"),
        ("dsec", "disparity/timestamps.txt", "5\n", "a time for each .* got 1 times and 2 files"),
        ("mocap-desk2", "../camera-calibrationA.json", '{"value0": {}}', r"A\.json: expected value0 with"),
        ("mocap-desk2", "../camera-calibrationA.json", "[]", r"A\.json: expected an object value0"),
        ("mvsec", "indoor_flying_calib/camchain-imucam-indoor_flying.yaml", "cam0: {}", "intrinsics: exp"),
        ("mvsec", "indoor_flying1_gt.hdf5", "text", r"_gt\.hdf5: not readable as HDF5"),
        ("m3ed", "spot_indoor_depth_gt.h5", "", r"_depth_gt\.h5: not readable as HDF5"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(
    tmp_path: Path, name: str, file: str, change: str, message: str
) -> None:
    tree = WRITERS[{"mocap-desk2": "tum_vie"}.get(name, name)](tmp_path / "data" / name)
    (tree.folder / file).write_text(change)
    with pytest.raises(DataError, match=message) as caught:
        opened(tree)
    assert str(caught.value).isprintable()


def test_missing_depth_is_said_with_what_can_be_done(tmp_path: Path) -> None:
    tree = write_dsec(tmp_path / "data/dsec")
    shutil.rmtree(tree.folder / "disparity")
    with pytest.raises(DataError, match=r"no depth: expected disparity/event/\*\.png .* --depth-dir FOLDER"):
        opened(tree)
    (tree.folder / "calibration/cam_to_cam.yaml").unlink()
    with pytest.raises(FileNotFoundError, match=r"calibration/cam_to_cam\.yaml not found"):
        opened(tree)


def test_a_run_depends_on_depth_folder_and_shared_calibration(tmp_path: Path) -> None:
    tree = write_tum_vie(tmp_path / "data/mocap-desk2")
    write_depth_folder(tmp_path / "depth", [0.1, 0.2], tree.lens.best_fit)
    config = Config(scene="mocap-desk2", data_dir=tmp_path / "data", depth_dir=tmp_path / "depth")
    before = identity_of(config)["inputs"]
    (tmp_path / "depth/0.100000.png").touch()
    after = identity_of(config)["inputs"]
    assert [name for name in before if before[name] != after[name]] == ["depth folder ."]
    path = tmp_path / "data/camera-calibrationA.json"
    path.write_text(path.read_text() + " ")
    assert (
        identity_of(config)["inputs"]["../camera-calibrationA.json"] != after["../camera-calibrationA.json"]
    )
