"""Recordings without events: three layouts written as published, sampled, refused where events are needed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequences import ate_cm, settings

from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence, find_sequence
from edslam_ti.datasets.rgbd import RgbdSequence, associated
from edslam_ti.errors import DataError
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.methods import METHODS
from edslam_ti.pipeline import contrast_of, make_slam

WIDTH, HEIGHT = 32, 24
EPOCH = 1305031102.0  # s; TUM's stamps count from 1970
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}


def write_png(path: Path, value: int, kind: type[np.integer] = np.uint16) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((HEIGHT, WIDTH), value, kind)
    if kind is np.uint16:
        image[0, :2] = 0, 65535
    assert cv2.imwrite(str(path), image)


def pose(k: int) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 0.1 * k
    return T


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    """Depth at 0, 0.1, 0.2 and 0.3 s, colour 10 ms later, but none near the last depth image."""
    folder = tmp_path / "rgbd_dataset_freiburg3_tiny"
    (folder / "rgb").mkdir(parents=True)
    lists = {"depth": "# depth maps\n# timestamp filename\n", "rgb": "# color images\n"}
    for k in range(4):
        write_png(folder / f"depth/{k}.png", 5000 * (k + 1))
        lists["depth"] += f"{EPOCH + 0.1 * k:.6f} depth/{k}.png\n"
    for k in range(3):
        write_png(folder / f"rgb/{k}.png", 51 * k, np.uint8)
        lists["rgb"] += f"{EPOCH + 0.1 * k + 0.01:.6f} rgb/{k}.png\n"
    for name, text in lists.items():
        (folder / f"{name}.txt").write_text(text)
    rows = [f"{EPOCH + 0.05 * k:.4f} {0.1 * k} 0 0 0 0 0 1\n" for k in range(-1, 8)]
    (folder / "groundtruth.txt").write_text("# ground truth trajectory\n" + "".join(rows))
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    return folder


@pytest.fixture
def replica(tmp_path: Path) -> Path:
    folder = tmp_path / "Replica" / "office9"
    for k in range(4):
        write_png(folder / f"results/depth{k:06d}.png", 6554 * (k + 1))
        image = np.full((HEIGHT, WIDTH, 3), 51, np.uint8)
        assert cv2.imwrite(str(folder / f"results/frame{k:06d}.jpg"), image)
    np.savetxt(folder / "traj.txt", [pose(k).ravel() for k in range(4)])
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


@pytest.fixture(params=["3DMatch", "7-Scenes"])
def scenes(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Frames in a folder of their own beside K (3DMatch's data), or K in the folder above (7-Scenes)."""
    folder = tmp_path / "kitchen" / "seq-01"
    frames = folder / "frames" if request.param == "3DMatch" else folder
    for k in range(4):
        write_png(frames / f"frame-{k:06d}.depth.png", 1000 * (k + 1))
        write_png(frames / f"frame-{k:06d}.color.png", 51, np.uint8)
        np.savetxt(frames / f"frame-{k:06d}.pose.txt", pose(k))
    K = np.array([[30.0, 0, 15.5], [0, 31.0, 11.5], [0, 0, 1]])
    np.savetxt((folder if request.param == "3DMatch" else folder.parent) / "camera-intrinsics.txt", K)
    return folder


def check(sequence: RgbdSequence, stamps: list[float]) -> None:
    """Depth k is k + 1 metres, the first pixels are missing, and the camera stands at the true pose."""
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    assert (sequence.camera.cx, sequence.camera.cy) == (15.5, 11.5)
    assert sequence.depth_timestamps == pytest.approx(stamps, abs=1e-6)
    assert sequence.time_range == pytest.approx((stamps[0], stamps[-1]), abs=1e-6)
    for k in (0, 2):
        depth = sequence.depth(k)
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(depth[0, :2], 0)
        assert depth[5, 5] == pytest.approx(k + 1, abs=1e-3)
    assert not sequence.has_events
    assert len(sequence.events(-1, 10)) == 0


def test_tum_layout_is_read_as_written(tum: Path) -> None:
    sequence = RgbdSequence(tum)
    check(sequence, [0, 0.1, 0.2, 0.3])
    assert sequence.time_offset == pytest.approx(EPOCH)
    assert sequence.image_timestamps == pytest.approx(sequence.depth_timestamps[:3])  # depth has no more
    image = sequence.image_at(float(sequence.depth_timestamps[2]))
    assert image is not None
    assert image[5, 5] == pytest.approx(0.4)
    truth = sequence.true_pose(0.1)
    assert truth is not None
    assert truth[0, 3] == pytest.approx(0.2, abs=1e-6)


def test_replica_layout_is_read_as_written(replica: Path) -> None:
    sequence = RgbdSequence(replica)
    check(sequence, [0, 1 / 30, 2 / 30, 3 / 30])
    assert sequence.image(1)[5, 5] == pytest.approx(0.2)
    truth = sequence.true_pose(2 / 30)
    assert truth is not None
    np.testing.assert_allclose(truth, pose(2), atol=1e-9)


def test_7_scenes_layout_is_read_as_written(scenes: Path) -> None:
    (scenes / "camera.json").write_text('{"frame_rate": 20}')
    sequence = RgbdSequence(scenes)
    check(sequence, [0, 0.05, 0.1, 0.15])
    assert sequence.image(3)[5, 5] == pytest.approx(0.2)
    truth = sequence.true_pose(0.15)
    assert truth is not None
    np.testing.assert_allclose(truth, pose(3), atol=1e-9)


def test_images_and_poses_are_optional(scenes: Path) -> None:
    for path in [*scenes.rglob("*.color.png"), *scenes.rglob("*.pose.txt")]:
        path.unlink()
    sequence = RgbdSequence(scenes)
    assert sequence.truth is None
    assert len(sequence.image_timestamps) == 0
    assert len(SampledSequence(sequence, 0.0, None, 0.05)) == 4


def test_every_depth_image_is_a_sample_and_nothing_lies_between(tum: Path) -> None:
    samples = SampledSequence(RgbdSequence(tum), start=0.0, duration=None, max_interval=0.05)
    assert samples.timestamps == pytest.approx([0, 0.1, 0.2, 0.3], abs=1e-6)
    assert samples.has_depth.all()
    assert [s.image is not None for s in samples] == [True, True, True, False]
    assert all(len(s.events) == 0 for s in samples)
    with pytest.raises(DataError, match=r"at least 2 depth images .* events nothing; change --start"):
        SampledSequence(RgbdSequence(tum), start=5.0, duration=None, max_interval=0.05)


def test_every_layout_is_detected(tum: Path, replica: Path, scenes: Path) -> None:
    for folder in (tum, replica, scenes):
        assert find_sequence(Config(data_dir=folder.parent, scene=folder.name)) == ("rgbd", folder)


@pytest.mark.parametrize("method", ["ed_slam", "ed_slam_paper"])
def test_methods_of_events_refuse_in_one_line(tum: Path, method: str) -> None:
    with pytest.raises(DataError, match=f"method {method} needs events, .* open3d_icp$") as caught:
        METHODS[method].build(RgbdSequence(tum), ContrastThreshold(0.1, "default"), Config(method=method))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_recording_without_events_is_tracked(tiny_sequence: EventDepthSequence, tmp_path: Path) -> None:
    """The tiny room as NICE-SLAM would have written it, numbered from its start on, 20 images a second."""
    folder, camera = tmp_path / "tiny", tiny_sequence.camera
    (folder / "results").mkdir(parents=True)
    stamps = tiny_sequence.depth_timestamps
    for k, t in enumerate(stamps):
        image = tiny_sequence.image_at(float(t))
        assert image is not None
        millimetres = np.rint(1000 * tiny_sequence.depth(k)).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"results/depth{k:06d}.png"), millimetres)
        assert cv2.imwrite(str(folder / f"results/frame{k:06d}.png"), np.rint(255 * image).astype(np.uint8))
    assert tiny_sequence.truth is not None
    np.savetxt(folder / "traj.txt", [tiny_sequence.truth.at(float(t)).ravel() for t in stamps])
    values = dict(zip(("w", "h", "fx", "fy", "cx", "cy"), [camera.width, camera.height, *camera.intrinsics]))
    (folder / "cam_params.json").write_text(json.dumps({"camera": values | {"scale": 1000}}))
    (folder / "camera.json").write_text('{"frame_rate": 20}')
    sequence = RgbdSequence(folder)
    samples = SampledSequence(sequence, 0.0, None, 0.05)
    for method in ("open3d_rgbd", "open3d_icp"):
        config = settings(method, mapping={"enabled": False})
        slam = make_slam(config, sequence, samples, contrast_of(config, sequence, samples))
        for sample in samples:
            assert slam.process(sample).converged
        assert len(slam.trajectory) == len(stamps)
        assert ate_cm(slam, sequence) < 1.5  # of 30 cm of path, 120 x 80 pixels


def test_partners_are_the_nearest_and_serve_once() -> None:
    first, second = np.array([0.0, 0.10, 0.11, 0.5]), np.array([0.008, 0.108, 0.9])
    assert associated(first, second, 0.02) == {0: 0, 2: 1}  # 0.10 is within reach, but 0.11 is nearer
    # Both are nearest to 0.11; the farther one is left for 0.10.
    assert associated(first, np.array([0.108, 0.115]), 0.02) == {1: 1, 2: 0}


def test_freiburg_images_and_depth_are_undistorted_alike(tum: Path) -> None:
    """A step in depth and the same step in colour stay in one place."""
    (tum / "camera.json").unlink()
    folder = tum.rename(tum.with_name("rgbd_dataset_freiburg1_tiny"))
    step = np.zeros((480, 640), bool)
    step[:, 40:] = True
    for k in range(4):
        assert cv2.imwrite(str(folder / f"depth/{k}.png"), np.where(step, 10000, 5000).astype(np.uint16))
    for k in range(3):
        assert cv2.imwrite(str(folder / f"rgb/{k}.png"), np.where(step, 200, 100).astype(np.uint8))
    sequence = RgbdSequence(folder)
    assert sequence.camera.fx == 517.3
    is_far, is_bright = sequence.depth(0) > 1.5, sequence.image(0) > 150 / 255
    assert (is_far != step).sum() > 1000  # columns near the edge bend
    inside = cv2.erode((sequence.depth(0) > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert inside.mean() > 0.9
    np.testing.assert_array_equal(is_far[inside], is_bright[inside])


BAD = [
    ("tum", "camera.json", '{"fx": 300}', r"camera\.json: expected all of width"),
    ("tum", "depth.txt", "1 a.png\n1 b.png\n", r"depth\.txt: line 2: expected increasing times"),
    ("tum", "rgb.txt", "7 rgb/0.png\n", r"expected colour within 0\.02 s of depth, got none"),
    ("tum", "groundtruth.txt", "0 1 2\n", r"groundtruth\.txt: line 1: expected 8 numbers"),
    ("replica", "traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", r"traj\.txt: expected a pose for every"),
    ("replica", "../cam_params.json", "{}", r"cam_params\.json: expected .*scale.*; KeyError: 'camera'"),
    ("replica", "../cam_params.json", "[" * 100_000, r"cam_params\.json: .* nested too deeply"),
    ("replica", "../cam_params.json", '{"camera": {"w": 1e999}}', r"cam_params\.json: expected "),
]


@pytest.mark.parametrize(("layout", "name", "content", "message"), BAD)
def test_bad_data_is_refused_in_one_line(
    layout: str, name: str, content: str, message: str, request: pytest.FixtureRequest
) -> None:
    folder: Path = request.getfixturevalue(layout)
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        RgbdSequence(folder)
    assert "\n" not in str(caught.value)


def test_missing_cameras_say_where_they_are_expected(tum: Path, replica: Path, scenes: Path) -> None:
    (tum / "camera.json").unlink()
    with pytest.raises(DataError, match=r"expected freiburg1, 2 or 3 in the folder's name, or camera\.json"):
        RgbdSequence(tum.rename(tum.with_name("desk")))
    (replica.parent / "cam_params.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"Replica/cam_params\.json not found"):
        RgbdSequence(replica)
    for path in scenes.parent.rglob("camera-intrinsics.txt"):
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"camera-intrinsics\.txt not found; expected the 3x3"):
        RgbdSequence(scenes)
    with pytest.raises(DataError, match=r"no depth found; expected depth\.txt and rgb\.txt \(TUM RGB-D\) or"):
        RgbdSequence(replica.parent)


def test_red_kitchen_is_read(shared_data: Path) -> None:
    sequence = RgbdSequence(shared_data / "red_kitchen")
    assert (sequence.camera.fx, sequence.camera.shape) == (585, (480, 640))
    assert len(sequence.depth_timestamps) == len(sequence.image_timestamps) == 250
    assert sequence.truth is not None
    assert sequence.truth.length() == pytest.approx(1.716, abs=1e-3)
    assert np.median(sequence.depth(100)[sequence.depth(100) > 0]) == pytest.approx(1.7, abs=0.8)
