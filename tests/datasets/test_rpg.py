"""The RPG Event Camera Dataset's text layout: parsed once, undistorted, geometrically consistent."""

import itertools
import shutil
from pathlib import Path
from typing import Any

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
        ("calib.txt", "1 2 3\n", r"calib\.txt: line 1: expected 9 numbers a line .* got 3"),
        ("calib.txt", "no calibration\n", r"calib\.txt: line 1: expected 9 numbers"),
        ("calib.txt", "0 30 19 14 0 0 0 0 0\n", r"camera: expected finite fx, fy"),
        ("calib.txt", "nan 30 19 14 0 0 0 0 0\n", r"calib\.txt: line 1: .* finite .* got nan"),
        ("images.txt", "0.1 images/frame_00000000.png\n", r"images\.txt has only 1 lines"),
        ("images.txt", "zero images/a.png\n", r"images\.txt: line 1: expected 't path'"),
        ("images.txt", "0.1 a\n0.1 b\n", r"images\.txt: line 2: expected increasing times"),
        ("images.txt", "0 x.png\n1 y.png\n2 z.png\n", r"x\.png: image not found"),
        ("groundtruth.txt", "0 1 2\n", r"groundtruth\.txt: line 1: expected 8 numbers"),
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
    folder = tmp_path / "slider_depth"  # without most of its 22 MB of events, to be quick
    folder.mkdir()
    for name in ("images", "derived_depth", "images.txt", "groundtruth.txt", "calib.txt"):
        (folder / name).symlink_to(source / name)
    with (source / "events.txt").open() as text:
        (folder / "events.txt").write_text("".join(itertools.islice(text, 0, None, 1000)))
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


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("images.txt", lambda t: t + 1642650000, r"the clocks differ: images\.txt covers 1642650000 to"),
        ("images.txt", lambda t: t * 1e9, r"images\.txt covers 0 to 80000000 s, .* in nanoseconds"),
        ("images.txt", lambda t: t * 1e3, r"images\.txt covers 0 to 80 s, .* in milliseconds"),
        ("groundtruth.txt", lambda t: t * 1e9, r"groundtruth\.txt covers 0 to 80000000 s, .* in nanoseconds"),
        ("groundtruth.txt", lambda t: t + 1642650000, r"the clocks differ: groundtruth\.txt covers 164265"),
    ],
)
def test_stamps_of_another_clock_are_refused(folder: Path, name: str, change: Any, message: str) -> None:
    rows = [line.split(maxsplit=1) for line in (folder / name).read_text().splitlines()]
    (folder / name).write_text("".join(f"{change(float(t)):.6f} {rest}\n" for t, rest in rows))
    with pytest.raises(DataError, match=message):
        RpgSequence(folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# caf\xe9\n0.0 images/frame_00000000.png\0\n", r"images\.txt: line 2: .* zero bytes"),
        ("0.0 a.png\n".encode("utf-16"), r"images\.txt: .* UTF-16"),
        (b"1e400 images/a.png\n", r"images\.txt: line 1: expected increasing times in seconds, got 1e400"),
        (b"0.0 caf\xe9.png\n0.04 b.png\n0.08 c.png\n", r"caf\\udce9\.png: image not found"),
        (b"x" * 1_000_000, r"images\.txt: line 1: expected 't path', got 'xxx.* \.\.\.'"),
    ],
)
def test_lists_of_images_that_are_no_text_are_refused(folder: Path, content: bytes, message: str) -> None:
    (folder / "images.txt").write_bytes(content)
    with pytest.raises((DataError, FileNotFoundError), match=message) as caught:
        RpgSequence(folder)
    assert str(caught.value).isprintable()


def test_lists_of_images_may_have_a_byte_order_mark_and_other_encodings_in_comments(folder: Path) -> None:
    text = (folder / "images.txt").read_bytes().replace(b"\n", b"\r\n")
    (folder / "images.txt").write_bytes(b"\xef\xbb\xbf# caf\xe9\r\n" + text)
    assert len(RpgSequence(folder).image_timestamps) == 3


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        ("1e-300 1e-300 19 14 0 0 0 0 0", r"calib\.txt: camera: expected focal lengths"),
        ("1e300 30 19 14 0 0 0 0 0", r"calib\.txt: line 1: .* below 1e\+20"),
        ("1e19 1e19 19 14 0 0 0 0 0", r"calib\.txt: camera: expected focal lengths"),
        ("30 30 1e6 1e6 0 0 0 0 0", r"calib\.txt: camera: expected the principal point near"),
        ("30 30 19 14 1e6 0 0 0 0", r"calib\.txt: expected distortion k1 k2 p1 p2 k3 within \+-1000"),
        ("30 30 19 14 900 0 0 0 0", r"calib\.txt: expected distortion .* that shows 2 % of the undistorted"),
        (
            "30 30 19 14 0 0 0 0 0\n30 30 19 14 0 0 0 0 0",
            r"calib\.txt: expected one line of 9",
        ),
    ],
)
def test_calibrations_of_no_lens_are_refused(folder: Path, calibration: str, message: str) -> None:
    (folder / "calib.txt").write_text(calibration)
    with pytest.raises(DataError, match=message):
        RpgSequence(folder)


def test_the_first_image_may_be_unreadable(folder: Path) -> None:
    for name in ("images/frame_00000000.png", "derived_depth/depth_00000000.png"):
        (folder / name).write_text("x")
    sequence = RpgSequence(folder)
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    assert sequence.depth_or_none(0) is None
    assert sequence.image_or_none(0) is None
    assert len(sequence.notes) == 2


def test_truth_out_of_order_is_sorted_and_noted(folder: Path) -> None:
    lines = (folder / "groundtruth.txt").read_text().splitlines(True)
    (folder / "groundtruth.txt").write_text("".join(lines[::-1]))
    sequence = RpgSequence(folder)
    truth = sequence.true_pose(0.03)
    assert truth is not None
    assert truth[0, 3] == pytest.approx(1.5)
    assert "4 of 5 rows are not in the order of time" in sequence.notes[0]
