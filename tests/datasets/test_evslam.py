"""EvSLAM's layout: a bag with events, IMU and the depth of a RealSense, Kalibr's calibration, TUM poses."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from event_files.written_bags import BagWriter
from scipy.spatial.transform import Rotation

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import find_sequence, open_sequence
from edslam_ti.errors import DataError
from edslam_ti.lenses import Lens

W, H = 48, 36
START = 1_700_000_000_250_000_000  # ns
LENS = Lens(Camera(W, H, 40.0, 41.0, 23.0, 18.5), "plumb_bob", (-0.2, 0.05, 1e-3, -1e-3))
DEPTH = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
T_EVENT_IMU, T_DEPTH_IMU = np.eye(4), np.eye(4)
T_EVENT_IMU[:3, :3], T_EVENT_IMU[:3, 3] = (
    Rotation.from_rotvec([0.4, 0.1, -0.2]).as_matrix(),
    [0.02, 0.0, 0.01],
)
T_DEPTH_IMU[:3, :3], T_DEPTH_IMU[:3, 3] = (
    Rotation.from_rotvec([0.42, 0.12, -0.19]).as_matrix(),
    [-0.04, 0.05, 0.01],
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path / "cache"))
    root = tmp_path / "EvSLAM"
    result = root / "arm_hdr"
    (root / "calibration").mkdir(parents=True)
    (root / "groundtruth").mkdir()
    result.mkdir()
    cameras = {}
    for k, (topic, T, lens, shift) in enumerate(
        (
            ("/dvxplorer_left/events", T_EVENT_IMU, LENS, 0.002),
            (
                "/camera/infra1/image_rect_raw/compressed",
                T_DEPTH_IMU,
                Lens(DEPTH, "plumb_bob", (0.0,) * 4),
                0.005,
            ),
        )
    ):
        cameras[f"cam{3 * k}"] = {
            "T_cam_imu": T.tolist(),
            "cam_overlaps": [1, 2],
            "camera_model": "pinhole",
            "distortion_coeffs": list(lens.coefficients),
            "distortion_model": "radtan",
            "intrinsics": list(lens.pinhole.intrinsics),
            "resolution": [lens.pinhole.width, lens.pinhole.height],
            "rostopic": topic,
            "timeshift_cam_imu": shift,
        }
    (root / "calibration/calib_results_cam.txt").write_text(yaml.safe_dump(cameras))
    poses = [f"{(START + k * 10**8) / 1e9:.6f} {0.01 * k} 0 0 0 0 0 1" for k in range(5)]
    (root / "groundtruth/arm_hdr.tum").write_text("\n".join(poses) + "\n")
    T = T_EVENT_IMU @ np.linalg.inv(T_DEPTH_IMU)
    normal, distance = np.array([0.1, -0.2, 1.0]), 2.0  # a plane in the event camera's frame
    own = T[:3, :3].T @ normal
    depth = (distance - normal @ T[:3, 3]) / (DEPTH.rays() @ own)
    random = np.random.default_rng(0)
    with BagWriter(result / "arm_hdr", "bag") as bag:
        for k in range(4):
            n = 300
            t = START + 10**8 * k + np.sort(random.integers(0, 10**8, n))
            rows = np.stack(
                [random.integers(0, W, n), random.integers(0, H, n), t, random.integers(0, 2, n)], -1
            )
            bag.events("/dvxplorer_left/events", "dvs_msgs", rows, (W, H))
            bag.events("/dvxplorer_right/events", "dvs_msgs", rows[:5], (W, H))
            bag.imu(
                "/dvxplorer_left/imu", START + 10**8 * k, np.array([0.1, 0.2, 0.3]), np.array([0, 0, 9.8])
            )
            stamp = START + 10**8 * k + 10**7
            bag.image("/camera/depth/image_rect_raw", stamp, np.rint(1000 * depth).astype(np.uint16), "16UC1")
            bag.image("/camera/infra1/image_rect_raw", stamp, np.zeros((48, 64), np.uint8), "mono8")
    return result


def test_a_recording_is_read_as_written(folder: Path, tmp_path: Path) -> None:
    config = Config(scene="arm_hdr", data_dir=folder.parent)
    assert find_sequence(config).dataset == "evslam"
    sequence = open_sequence(config)
    first, last = sequence.time_range
    assert len(sequence.events(first, last + 1)) > 0.8 * 1200
    assert 0.25 <= first < 0.26
    # the depth camera's clock is 3 ms behind the event camera's
    assert sequence.depth_timestamps == pytest.approx([0.263, 0.363, 0.463, 0.563], abs=1e-6)
    truth = 2.0 / (sequence.camera.rays() @ np.array([0.1, -0.2, 1.0]))
    depth = sequence.depth(1)
    valid = depth > 0
    assert valid.mean() > 0.6
    assert (np.abs(depth - truth)[valid] / truth[valid]).max() < 2e-3
    assert sequence.true_pose(0.45)[0, 3] == pytest.approx(0.02)
    assert sequence.imu.timestamps == pytest.approx([0.248, 0.348, 0.448, 0.548], abs=1e-6)
    assert sequence.imu.angular_velocity[1] == pytest.approx([0.1, 0.2, 0.3])
    [kept] = (tmp_path / "cache/depth").iterdir()
    assert len(list(kept.iterdir())) == 4
    stamp = kept.stat().st_mtime_ns
    assert (open_sequence(config).depth(1) == depth).all()
    assert kept.stat().st_mtime_ns == stamp  # not written again


def test_bad_calibration_and_several_bags_are_refused(folder: Path) -> None:
    config = Config(scene="arm_hdr", data_dir=folder.parent)
    path = folder.parent / "calibration/calib_results_cam.txt"
    text = path.read_text()
    path.write_text(text.replace("/camera/infra1", "/camera/other"))
    with pytest.raises(
        DataError, match=r"calib_results_cam\.txt: expected a camera with rostopic /camera/infra1/"
    ):
        open_sequence(config)
    path.write_text("Camera-system parameters: none")
    with pytest.raises(DataError, match="expected a Kalibr camchain"):
        open_sequence(config)
    path.write_text(text)
    (folder / "other.bag").write_bytes(b"")
    with pytest.raises(
        DataError, match=r"expected one bag, here or in rosbag/, got arm_hdr\.bag and other\.bag"
    ):
        open_sequence(config)
