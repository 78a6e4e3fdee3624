"""The RPG Event Camera Dataset's text layout: parsed once, undistorted, geometrically consistent."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from edslam_ti.datasets.rpg import RpgSequence
from edslam_ti.errors import DataError

WIDTH, HEIGHT = 40, 30
CALIBRATION = "30.0 30.0 19.5 14.5 -0.2 0.05 0 0 0\n"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small distorted recording: 3 images and depth images, 500 events."""
    result = tmp_path / "tiny"
    (result / "images").mkdir(parents=True)
    (result / "derived_depth").mkdir()
    (result / "calib.txt").write_text(CALIBRATION)
    lines = []
    for k in range(3):
        cv2.imwrite(str(result / f"images/frame_{k:08d}.png"), np.full((HEIGHT, WIDTH), 100, np.uint8))
        depth = np.full((HEIGHT, WIDTH), 5000 * (k + 1), np.uint16)
        cv2.imwrite(str(result / f"derived_depth/depth_{k:08d}.png"), depth)
        lines.append(f"{0.04 * k:.6f} images/frame_{k:08d}.png\n")
    (result / "images.txt").write_text("".join(lines))
    (result / "groundtruth.txt").write_text("".join(f"{0.02 * k} {k} 0 0 0 0 0 1\n" for k in range(5)))
    random = np.random.default_rng(0)
    t = np.sort(random.uniform(0, 0.1, 500))
    x, y, p = random.integers(0, WIDTH, 500), random.integers(0, HEIGHT, 500), random.integers(0, 2, 500)
    rows = [f"{a:.9f} {b} {c} {d}\n" for a, b, c, d in zip(t, x, y, p)]
    (result / "events.txt").write_text("".join(rows))
    return result


def test_a_sequence_is_read_as_written(folder: Path) -> None:
    sequence = RpgSequence(folder)
    assert (sequence.camera.width, sequence.camera.height, sequence.camera.cx) == (WIDTH, HEIGHT, 19.5)
    assert sequence.depth_timestamps == pytest.approx([0, 0.04, 0.08])
    assert sequence.depth(1)[3, 3] == pytest.approx(2.0)
    assert "not measured" in sequence.description
    assert sequence.image(0)[15, 20] == pytest.approx(100 / 255)
    truth = sequence.true_pose(0.03)
    assert truth is not None
    assert truth[0, 3] == pytest.approx(1.5)
    assert set(sequence.events(0, 1).polarity) == {-1, 1}


def test_an_image_of_events_is_undistorted_as_an_image(folder: Path) -> None:
    sequence = RpgSequence(folder)
    rows = np.loadtxt(folder / "events.txt")
    raw = np.zeros((HEIGHT, WIDTH), np.float32)
    np.add.at(raw, (rows[:, 2].astype(int), rows[:, 1].astype(int)), 1)
    K = sequence.camera.matrix
    columns, lines = cv2.initUndistortRectifyMap(
        K, np.array([-0.2, 0.05, 0, 0, 0]), np.eye(3), K, (WIDTH, HEIGHT), cv2.CV_32FC1
    )
    expected = cv2.remap(raw, np.rint(columns), np.rint(lines), cv2.INTER_NEAREST)
    events = sequence.events(0, 1)
    count = np.zeros((HEIGHT, WIDTH), np.float32)
    np.add.at(count, (events.y, events.x), 1)
    assert (count == expected).all()
    assert (expected != raw).any()
    assert (np.diff(events.t) >= 0).all()
    assert set(events.t) <= set(rows[:, 0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("events.txt", "", r"events\.txt: the file is empty"),
        ("events.txt", "0.1 1 1\n", r"events\.txt: line 1: expected 4 numbers 't x y p', got '0\.1 1 1'"),
        ("events.txt", "0.1 1 1 1\n0.2 40 1 1\n", r"events\.txt: line 2: expected x in 0 to 39"),
        ("calib.txt", "1 2 3\n", r"calib\.txt: expected 9 numbers a line .* got 3"),
        ("calib.txt", "no calibration\n", r"calib\.txt: expected 9 numbers"),
        ("calib.txt", "0 30 19 14 0 0 0 0 0\n", r"camera: expected finite fx, fy"),
        ("calib.txt", "nan 30 19 14 0 0 0 0 0\n", r"calib\.txt: row 1 .* not finite"),
        ("images.txt", "0.1 images/frame_00000000.png\n", r"images\.txt has only 1 lines"),
        ("images.txt", "zero images/a.png\n", r"images\.txt: line 1: expected 't path'"),
        ("images.txt", "0.1 a\n0.1 b\n", r"images\.txt: line 2: expected increasing times"),
        ("images.txt", "0 x.png\n1 y.png\n2 z.png\n", r"x\.png: image not found"),
        ("groundtruth.txt", "0 1 2\n", r"groundtruth\.txt: expected 8 numbers"),
        ("derived_depth/depth_00000000.png", "x", r"depth_00000000\.png: not readable as an image"),
    ],
)  # fmt: skip
def test_bad_data_is_refused_in_one_line(
    folder: Path, cache: Path, name: str, content: str, message: str
) -> None:
    (folder / name).write_text(content)
    with pytest.raises((DataError, FileNotFoundError), match=message) as caught:
        RpgSequence(folder)
    assert "\n" not in str(caught.value)
    assert not list(cache.glob("events/.*"))


def test_depth_poses_and_camera_of_slider_depth_agree(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "slider_depth"
    folder = tmp_path / "slider_depth"  # without its 22 MB of events, to be quick
    folder.mkdir()
    for name in ("images", "derived_depth", "images.txt", "groundtruth.txt", "calib.txt"):
        (folder / name).symlink_to(source / name)
    with (source / "events.txt").open() as text:
        (folder / "events.txt").write_text("".join(next(text) for _ in range(1000)))
    sequence = RpgSequence(folder)

    def warp_error(a: int, b: int, depth_factor: float) -> float:
        """Mean brightness difference of image a and image b seen through the depth of a."""
        T_b, T_a = (sequence.true_pose(float(sequence.image_timestamps[k])) for k in (b, a))
        assert T_a is not None
        assert T_b is not None
        depth = depth_factor * sequence.depth(a)
        points = (depth[..., None] * sequence.camera.rays()) @ T_a[:3, :3].T + T_a[:3, 3] - T_b[:3, 3]
        points = points @ T_b[:3, :3]
        fx, fy, cx, cy = sequence.camera.intrinsics
        z = np.where(depth > 0, points[..., 2], 1)
        u = (fx * points[..., 0] / z + cx).astype(np.float32)
        v = (fy * points[..., 1] / z + cy).astype(np.float32)
        seen = cv2.remap(sequence.image(b), u, v, cv2.INTER_LINEAR, borderValue=-1)
        valid = (depth > 0) & (seen >= 0)
        return float(np.abs(seen - sequence.image(a))[valid].mean())

    pairs = [(20, 28), (40, 32), (60, 68)]
    right = np.mean([warp_error(a, b, 1.0) for a, b in pairs])
    assert right < 0.035  # of the brightness range; measured 0.027
    assert np.mean([warp_error(a, b, 2.0) for a, b in pairs]) > 2.5 * right
    assert np.mean([warp_error(b, a, 1.1) for a, b in pairs]) > 1.3 * right


def test_folder_without_depth_is_refused(folder: Path) -> None:
    shutil.rmtree(folder / "derived_depth")
    with pytest.raises(DataError, match="no depth found"):
        RpgSequence(folder)
