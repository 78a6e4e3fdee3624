"""VECtor's layout, simulated through its own calibration: events, depth and poses meet in one camera."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from sequences import tiny_room, tracked
from vector_tree import EPOCH, T_BODY_EVENT, T_EVENT_DEPTH, LensRenderer, Rig, stamp, write_vector_tree

from edslam_ti.config import Config
from edslam_ti.datasets import find_sequence, open_sequence
from edslam_ti.datasets.base import SampledSequence
from edslam_ti.datasets.vector import VectorSequence
from edslam_ti.errors import DataError
from edslam_ti.simulation import HandHeldPath, SimulationConfig
from edslam_ti.simulation.renderer import Renderer

RIG = Rig(0.25)  # 160x120 and 160x144
SETTINGS = SimulationConfig(width=160, height=120, focal_length=82, duration=0.5, depth_rate=20)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("vector") / "desk_normal"
    room = tiny_room()
    write_vector_tree(folder, room.scene, HandHeldPath(room, 3.0), SETTINGS, RIG)
    return folder


@pytest.fixture(scope="module")
def sequence(tree: Path) -> VectorSequence:
    return VectorSequence(tree)


def test_the_layout_is_recognised(tree: Path) -> None:
    config = Config(scene=tree.name, data_dir=tree.parent)
    assert find_sequence(config).dataset == "vector"
    opened = open_sequence(config)
    assert "published" not in opened.description
    assert opened.camera == RIG.projection
    assert opened.time_offset == EPOCH // 1_000_000


def test_events_are_those_of_the_undistorted_camera(sequence: VectorSequence) -> None:
    first, last = sequence.time_range
    assert 0.75 <= first < 0.80
    assert last == pytest.approx(1.25, abs=0.01)
    events = sequence.events(first, last)
    counts = np.zeros(sequence.camera.shape)
    np.add.at(counts, (events.y, events.x), events.polarity)
    room = tiny_room()
    renderer, path = Renderer(room.scene, sequence.camera), HandHeldPath(room, 3.0)
    a, b = (
        np.log(renderer.render(path.pose(t)).grey + SETTINGS.log_epsilon) for t in (0.0, SETTINGS.duration)
    )
    inner = np.s_[8:-8, 8:-8]
    change = (b - a) / SETTINGS.contrast_threshold
    assert np.corrcoef(counts[inner].ravel(), change[inner].ravel())[0, 1] > 0.93


def test_depth_is_the_true_one_in_the_event_camera(sequence: VectorSequence) -> None:
    room = tiny_room()
    renderer, path = Renderer(room.scene, sequence.camera), HandHeldPath(room, 3.0)
    assert len(sequence.depth_timestamps) == 10
    num_hidden = 0
    for k in (0, 5, 9):
        t = sequence.depth_timestamps[k] - (EPOCH / 1e6 - sequence.time_offset)
        truth, drawn = renderer.render(path.pose(t)).depth, sequence.depth(k)
        valid = drawn > 0
        error = np.abs(drawn - truth)[valid] / truth[valid]
        assert valid.mean() > 0.6
        assert (error < 0.01).mean() > 0.95
        # what the Kinect does not see is left out: those pixels are hidden there behind something nearer
        points = sequence.camera.back_project(truth)
        own = (points - T_EVENT_DEPTH[:3, 3]) @ T_EVENT_DEPTH[:3, :3]
        kinect = LensRenderer(room.scene, RIG.depth_lens).render(path.pose(t) @ T_EVENT_DEPTH).depth
        pixels = np.rint(RIG.depth_lens.project(own[:, :2] / own[:, 2:])).astype(int)
        height, width = kinect.shape
        inside = (own[:, 2] > 0) & (pixels >= 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        nearest = cv2.dilate(kinect, np.ones((3, 3)))  # the farthest around, so that outlines do not count
        hidden = np.zeros(len(own), bool)
        hidden[inside] = nearest[pixels[inside, 1], pixels[inside, 0]] < 0.9 * own[inside, 2]
        assert not valid.ravel()[hidden].any()
        num_hidden += int(hidden.sum())
    assert num_hidden > 20


def test_poses_of_the_body_are_carried_to_the_event_camera(sequence: VectorSequence) -> None:
    path = HandHeldPath(tiny_room(), 3.0)
    t = 0.25
    pose = sequence.true_pose(EPOCH / 1e6 - sequence.time_offset + t)
    assert pose is not None
    assert np.abs(pose - path.pose(t)).max() < 1e-4
    body = np.loadtxt(sequence._folder / "desk_normal1.synced.gt.txt")[0, 1:4]
    assert np.linalg.norm(body - path.pose(0.0)[:3, 3]) == pytest.approx(
        np.linalg.norm(T_BODY_EVENT[:3, 3]), abs=1e-6
    )


def test_inertial_measurements_are_kept(sequence: VectorSequence) -> None:
    assert sequence.imu is not None
    assert len(sequence.imu) == 100
    assert sequence.imu.timestamps[0] == pytest.approx(0.75)
    assert sequence.imu.angular_velocity[3] == pytest.approx([0.1, 0.2, 0.3])
    assert sequence.imu.acceleration[3] == pytest.approx([0, 9.81, 0.03])


def test_tracking_follows_the_true_path(sequence: VectorSequence) -> None:
    sequence.contrast_threshold = SETTINGS.contrast_threshold
    samples = list(SampledSequence(sequence, 0.0, None, 0.1))
    slam = tracked(sequence, samples)
    truth = sequence.true_pose(float(slam.trajectory.timestamps[-1]))
    moved = np.linalg.norm(truth[:3, 3] - samples[0].T_world_camera[:3, 3])
    assert moved > 0.05
    assert np.linalg.norm(slam.trajectory.poses[-1][:3, 3] - truth[:3, 3]) < 0.1 * moved


@pytest.fixture
def copy(tree: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tree, tmp_path / "set" / tree.name))


def test_absent_calibration_is_replaced_by_the_published_one_and_said_so(copy: Path) -> None:
    for name in ("small_scale_joint_camera_extrinsic_results", "camera_mocap_extrinsic_results1"):
        (copy / "calibration" / f"{name}.yaml").unlink()
    sequence = VectorSequence(copy)
    assert "published calibration" in sequence.description
    assert "small_scale_joint_camera_extrinsic_results.yaml" in sequence.description
    pose = sequence.true_pose(EPOCH / 1e6 - sequence.time_offset)
    assert np.abs(pose - HandHeldPath(tiny_room(), 3.0).pose(0.0)).max() < 1e-3


def test_calibration_without_names_and_of_older_downloads_is_read(copy: Path) -> None:
    mocap = copy / "calibration/camera_mocap_extrinsic_results1.yaml"
    mocap.write_text(yaml.safe_dump(yaml.safe_load(mocap.read_text())["cam0"]))
    for name in ("small_scale_joint_camera", "rgbd_camera_calibrated"):
        path = copy / f"calibration/{name}_extrinsic_results.yaml"
        values = yaml.safe_load(path.read_text())
        cameras = {key: v for key, v in values.items() if key != "camera_number"}
        path.write_text(
            yaml.safe_dump(
                {k: {n: m for n, m in v.items() if n != "camera_name"} for k, v in cameras.items()}
            )
        )
    shutil.move(copy / "calibration", copy.parent / "0_calib")
    sequence = VectorSequence(copy)
    assert "published" not in sequence.description
    pose = sequence.true_pose(EPOCH / 1e6 - sequence.time_offset)
    assert np.abs(pose - HandHeldPath(tiny_room(), 3.0).pose(0.0)).max() < 1e-4


def test_reprojected_depth_is_used_where_the_raw_is_missing(copy: Path, sequence: VectorSequence) -> None:
    drawn = copy / "desk_normal1.synced.left_event_depth"
    drawn.mkdir()
    for k in range(10):
        name = f"{stamp(round(1e9 * (0.011 + k / 20)))}.png"
        cv2.imwrite(str(drawn / name), np.rint(1000 * sequence.depth(k)).astype(np.uint16))
    shutil.rmtree(copy / "desk_normal1.synced.kinect_depth")
    other = VectorSequence(copy)
    assert np.abs(other.depth(4) - sequence.depth(4)).max() < 0.6e-3
    assert any("k4a_projector" in text for text in other.notes)
    shutil.rmtree(drawn)
    with pytest.raises(DataError, match=r"no depth found; expected desk_normal1.* --depth-dir FOLDER"):
        VectorSequence(copy)
    assert len(VectorSequence(copy, needs_depth=False).depth_timestamps) == 0


def test_a_crop_leaves_out_what_evaluations_leave_out(copy: Path) -> None:
    stamps = copy / "desk_normal1.synced.left_camera/timestamp.txt"
    lines = [f"{stamp(k * 5_000_000)} {stamp(k * 5_000_000 + 2_000_000)}" for k in range(101)]
    stamps.write_text("# a\n# b\n" + "\n".join(lines) + "\n")
    sequence = VectorSequence(copy, crop=True)
    first, last = sequence.time_range  # images 65 to 99, at the middle of their exposure
    assert (first - 0.75, last - 0.75) == pytest.approx((0.326, 0.496), abs=1e-6)
    assert ((sequence.depth_timestamps >= first) & (sequence.depth_timestamps <= last)).all()
    assert len(sequence.depth_timestamps) == 3
    full = VectorSequence(copy)
    assert (sequence.depth(0) == full.depth(7)).all()
    assert len(sequence.events(0, 9)) == len(full.events(first, np.nextafter(last, 9)))
    stamps.write_text("# a\n1642689268.75 1642689268.76\n")
    with pytest.raises(DataError, match="crop: expected more than 66 images, got 1"):
        VectorSequence(copy, crop=True)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("camera_mocap_extrinsic_results1", "cam0: {T_cam_body: [1, 2]}", "T_cam_body: expected 16 numbers"),
        (
            "small_scale_joint_camera_extrinsic_results",
            f"cam2: {{T_cam0_cam2: {np.diag([2, 2, 2, 1]).ravel().tolist()}}}",
            "T_cam0_cam2: expected a rigid motion",
        ),
        ("left_event_camera_intrinsic_results", "camera_matrix: {data: [1]}", "expected 9 numbers"),
        ("left_event_camera_intrinsic_results", "a: [", "calibration not readable as YAML"),
    ],
)  # fmt: skip
def test_bad_calibration_is_refused_in_one_line(copy: Path, name: str, text: str, message: str) -> None:
    (copy / "calibration" / f"{name}.yaml").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        VectorSequence(copy)
    assert name in str(caught.value)
    assert str(caught.value).isprintable()


def test_bags_are_read_instead_of_unpacked_files(copy: Path, sequence: VectorSequence) -> None:
    from event_files.written_bags import BagWriter

    raw = copy / "desk_normal1.synced.kinect_depth"
    with BagWriter(copy / "desk_normal1.synced.kinect_depth.x", "bag") as bag:
        for path in sorted(raw.glob("*.png")):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            bag.image("/kinect/depth_image", round(float(path.stem) * 1e6) * 1000, image, "16UC1")
    shutil.rmtree(raw)
    other = VectorSequence(copy)
    assert other.depth_timestamps == pytest.approx(sequence.depth_timestamps, abs=1e-6)
    assert (other.depth(3) == sequence.depth(3)).all()


def test_headers_need_no_comment_sign(copy: Path, sequence: VectorSequence) -> None:
    for name in ("gt", "imu"):
        path = copy / f"desk_normal1.synced.{name}.txt"
        path.write_text(path.read_text().replace("# ", ""))
    other = VectorSequence(copy)
    assert (other.truth.timestamps == sequence.truth.timestamps).all()
    assert other.imu is not None
    assert len(other.imu) == 100
