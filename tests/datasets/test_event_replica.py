"""EventReplica's layout: what is read, at what times, and what is refused in one line."""

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import psutil
import pytest
from written_sequences import CAMERA, HEIGHT, WIDTH, save_events, some_events, write_sequence

from edslam_ti.datasets import SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError
from edslam_ti.event_files.checked import EventFile


def read_all(folder: Path) -> None:
    """Open a sequence and read every sample."""
    sequence = EventReplicaSequence(folder)
    for sample in SampledSequence(sequence, 0.0, None, 0.1):
        assert sample.image is not None


def test_a_sequence_is_read_as_written(tmp_path: Path) -> None:
    sequence = EventReplicaSequence(write_sequence(tmp_path / "any_name"))
    assert (sequence.scene, sequence.contrast_threshold) == ("any_name", 0.1)
    assert sequence.depth_timestamps == pytest.approx(np.arange(7) * 0.05)
    assert sequence.depth(2)[5, 5] == pytest.approx(1.1)
    assert sequence.depth(2)[0, 0] == 0
    assert sequence.image(0)[3, 3] == pytest.approx(0.2)
    truth = sequence.true_pose(0.0375)
    assert truth is not None
    assert truth[0, 3] == pytest.approx(0.0375)
    events, expected = sequence.events(0.1, 0.2), some_events()
    expected = expected[(expected[:, 2] >= 0.1) & (expected[:, 2] < 0.2)]
    assert (events.x == expected[:, 0]).all()
    assert (events.y == expected[:, 1]).all()
    assert (events.t == expected[:, 2]).all()
    assert (events.polarity == expected[:, 3]).all()
    assert (events.x.dtype, events.t.dtype, events.polarity.dtype) == (np.int16, np.float64, np.int8)


def test_pixel_centres_at_half_move_the_principal_point(tmp_path: Path) -> None:
    assert EventReplicaSequence(write_sequence(tmp_path / "a")).camera.cx == 15.5
    centred = CAMERA | {"pixel_centres": "integer", "description": "harmless"}
    assert EventReplicaSequence(write_sequence(tmp_path / "b", camera=centred)).camera.cx == 16.0


def test_without_camera_json_the_camera_is_event_replicas(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    (folder / "camera.json").unlink()
    for path in [*folder.glob("depth/*"), *folder.glob("images/*")]:
        values = np.arange(480 * 768).reshape(480, 768)
        cv2.imwrite(str(path), values.astype(np.uint16 if "depth" in str(path) else np.uint8))
    camera = EventReplicaSequence(folder).camera
    assert (camera.width, camera.height, *camera.intrinsics) == (768, 480, 384.0, 384.0, 383.5, 239.5)


@pytest.mark.parametrize("scale", [5000, 0.0002])
def test_depth_scale_is_units_per_metre_or_metres_per_unit(tmp_path: Path, scale: float) -> None:
    folder = write_sequence(tmp_path / "s", camera=CAMERA | {"depth_scale": scale})
    assert EventReplicaSequence(folder).depth(0)[1, 1] == pytest.approx(0.2)


def test_images_and_poses_may_be_absent(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    for path in [*folder.glob("images/*"), folder / "poses_ts.txt", folder / "traj.txt"]:
        path.unlink()
    (folder / "images").rmdir()
    sequence = EventReplicaSequence(folder)
    assert sequence.truth is None
    sample = SampledSequence(sequence, 0.0, None, 0.1)[1]
    assert sample.image is None
    assert sample.T_world_camera is None


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(
        str(path)
    )


def test_depth_exr_is_metres_and_far_values_are_missing(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    (folder / "Depth_exr").mkdir()
    for path in folder.glob("depth/*"):
        path.unlink()
    depth = np.full((HEIGHT, WIDTH), 2.5, np.float32)
    depth[0, :6] = 1e10, np.nan, np.inf, -np.inf, -1, 3
    write_exr(folder / "Depth_exr/0100.exr", {"Z": depth})
    half = depth.astype(np.float64)
    half[0, 0] = 65504
    half = half.astype(np.float16)
    write_exr(folder / "Depth_exr/0250.exr", dict.fromkeys("RGB", half))
    sequence = EventReplicaSequence(folder)
    assert sequence.depth_timestamps == pytest.approx([0.1, 0.25])
    for k in range(2):
        assert sequence.depth(k)[3, 3] == 2.5
        assert sequence.depth(k)[0, :6].tolist() == [0, 0, 0, 0, 0, 3]
    (folder / "Depth_exr/0100.exr").write_text("x")
    (folder / "Depth_exr/0250.exr").write_text("x")
    with pytest.raises(DataError, match=r"0100\.exr: not readable as OpenEXR .*2 of 2 depth images"):
        EventReplicaSequence(folder)


def test_several_event_folders_are_chosen_by_threshold(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    (folder / "event_threshold_0.25").mkdir()
    np.save(folder / "event_threshold_0.25/gray_events_data.npy", some_events()[:100])
    with pytest.raises(DataError, match=r"choose one with --contrast-threshold"):
        EventReplicaSequence(folder)
    chosen = EventReplicaSequence(folder, 0.25)
    assert (chosen.contrast_threshold, len(chosen.events(0, 1))) == (0.25, 100)
    with pytest.raises(
        DataError, match=r"no events with contrast threshold 0\.3; there are event_threshold_0\.1"
    ):
        EventReplicaSequence(folder, 0.3)
    (folder / "camera.json").write_text(json.dumps(CAMERA | {"contrast_threshold": 0.25}))
    assert EventReplicaSequence(folder).contrast_threshold == 0.25


def test_locally_unsorted_stamps_are_sorted_and_complete(tmp_path: Path) -> None:
    events = some_events(20000)
    block = np.floor(events[:, 2] * 1000)
    shuffled = events[np.argsort(block + np.random.default_rng(1).random(len(events)) * 0.99)]
    assert (np.diff(shuffled[:, 2]) < 0).any()
    sequence = EventReplicaSequence(write_sequence(tmp_path / "s", shuffled))
    parts = [sequence.events(k * 0.01, (k + 1) * 0.01) for k in range(30)]
    for k, part in enumerate(parts):
        assert (part.t >= k * 0.01).all()
        assert (part.t < (k + 1) * 0.01).all()
        assert (np.diff(part.t) >= 0).all()
    assert (np.concatenate([p.t for p in parts]) == events[:, 2]).all()


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_any_floating_array_of_events_is_read(tmp_path: Path, dtype: str, order: str) -> None:
    path = tmp_path / "e.npy"
    np.save(path, np.asarray(some_events(), dtype=dtype, order=order))  # type: ignore[call-overload]
    events = EventFile(path, WIDTH, HEIGHT).between(0, 1)
    assert (events.x == some_events()[:, 0]).all()
    assert events.t == pytest.approx(some_events()[:, 2], rel=1e-6)


def test_polarity_zero_means_negative_where_the_file_says_so_throughout(tmp_path: Path) -> None:
    events = some_events()
    events[:, 3] = events[:, 3] > 0
    np.save(tmp_path / "e.npy", events)
    polarity = EventFile(tmp_path / "e.npy", WIDTH, HEIGHT).between(0, 1).polarity
    assert (polarity == np.where(events[:, 3] > 0, 1, -1)).all()
    events[1500:1600, 3] = -1
    np.save(tmp_path / "e.npy", events)
    with pytest.raises(DataError, match=r"row 15\d\d: expected polarity"):
        EventFile(tmp_path / "e.npy", WIDTH, HEIGHT)


def test_a_bad_row_is_left_out_of_a_sequence_and_counted(tmp_path: Path) -> None:
    events = some_events()
    events[1700, 1] = 33014
    folder = write_sequence(tmp_path / "s", events)
    read_all(folder)
    sequence = EventReplicaSequence(folder)
    assert (len(sequence.events(-1, 1)), sequence.num_dropped_events) == (2999, 1)


def test_large_absolute_stamps_are_shifted_together(tmp_path: Path) -> None:
    zero = 1_600_000_000
    events = some_events()
    events[:, 2] += zero
    folder = write_sequence(tmp_path / "s", events)
    for path in [*folder.glob("depth/*"), *folder.glob("images/*")]:
        path.rename(path.with_name(f"frame{zero * 1000 + int(path.stem[5:])}.png"))
    np.savetxt(folder / "poses_ts.txt", zero + np.arange(13) * 0.025, fmt="%.3f")
    sequence = EventReplicaSequence(folder)
    assert sequence.time_offset == zero
    assert sequence.time_range[0] == events[0, 2] - zero
    assert sequence.depth_timestamps.tolist() == [0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3]  # to the last bit
    assert sequence.truth is not None
    assert sequence.truth.timestamps == pytest.approx(np.arange(13) * 0.025, abs=3e-7)
    assert len(sequence.events(0.0, 0.1)) == int((events[:, 2] < zero + 0.1).sum())
    samples = SampledSequence(sequence, 0.0, None, 0.05)
    assert len(samples) == len(
        SampledSequence(EventReplicaSequence(write_sequence(tmp_path / "0")), 0, None, 0.05)
    )


def test_start_and_duration_count_from_the_first_stamp_of_a_cut_out(tmp_path: Path) -> None:
    events = some_events()
    events[:, 2] += 12
    folder = write_sequence(tmp_path / "s", events)
    for path in [*folder.glob("depth/*"), *folder.glob("images/*")]:
        path.rename(path.with_name(f"frame{12000 + int(path.stem[5:])}.png"))
    np.savetxt(folder / "poses_ts.txt", 12 + np.arange(13) * 0.025)
    sequence = EventReplicaSequence(folder)
    assert sequence.time_offset == 0
    samples = SampledSequence(sequence, start=0.1, duration=0.1, max_interval=0.1)
    assert samples.timestamps == pytest.approx([12.1, 12.15, 12.2])


def test_reading_slices_does_not_keep_the_file_in_memory(tmp_path: Path) -> None:
    count = 2_000_000  # 64 MB
    rows = np.lib.format.open_memmap(tmp_path / "e.npy", "w+", "<f8", (count, 4))
    rows[:, 2] = np.arange(count) * 1e-6
    rows[:, 3] = 1
    rows.flush()
    del rows
    events = EventFile(tmp_path / "e.npy", WIDTH, HEIGHT)
    events.between(0.0, 0.05)
    before = psutil.Process().memory_info().rss
    assert sum(len(events.between(k * 0.05, (k + 1) * 0.05)) for k in range(40)) == count
    assert psutil.Process().memory_info().rss - before < 20e6


def _set(row: int, column: int, value: float) -> Any:
    """Put a value into every fourth row from one on: too many to be left out."""

    def change(folder: Path) -> None:
        events = some_events()
        events[row::4, column] = value
        save_events(folder, events)

    return change


def _events(change: Any) -> Any:
    return lambda folder: save_events(folder, change(some_events()))


def _write(name: str, content: str) -> Any:
    return lambda folder: (folder / name).write_text(content)


def _camera(**values: Any) -> Any:
    return _write("camera.json", json.dumps(CAMERA | values))


def _truncate(folder: Path) -> None:
    path = folder / "event_threshold_0.1/gray_events_data.npy"
    path.write_bytes(path.read_bytes()[:5000])


def _remove(pattern: str) -> Any:
    def change(folder: Path) -> None:
        for path in folder.glob(pattern):
            path.unlink()

    return change


def _bytes(name: str, content: bytes) -> Any:
    return lambda folder: (folder / name).write_bytes(content)


def _each(name: str, image: np.ndarray | bytes) -> Any:
    """Write one image over every image of a folder."""
    data = image if isinstance(image, bytes) else cv2.imencode(".png", image)[1].tobytes()
    return lambda folder: [path.write_bytes(data) for path in (folder / name).glob("*")]


def png_header(width: int, height: int) -> bytes:
    """Return the beginning of a grey PNG of 16 bits that promises a size, and an end."""
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", b""),
        (b"IEND", b""),
    )
    parts = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


EVENTS_FILE = "event_threshold_0.1/gray_events_data.npy"
IDENTITY_LINE = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"

REFUSED: dict[str, tuple[Any, str]] = {
    "no events": (lambda f: save_events(f, np.empty((0, 4))), r"npy: expected events, got an empty array"),
    "events file of 0 bytes": (_write(EVENTS_FILE, ""), r"npy: the file is empty"),
    "not a npy": (_write(EVENTS_FILE, "hello, not numpy"), r"not readable as a NumPy \.npy file"),
    "truncated": (_truncate, r"truncated: the header states 3000 events"),
    "wrong shape": (_events(lambda e: e[:, :3]), r"\(N, 4\) array .* got shape \(3000, 3\)"),
    "x outside": (_set(1700, 0, WIDTH), r"row 1700: expected x in 0 to 31 .* = 32, "),
    "y negative": (_set(1700, 1, -1), r"row 1700: expected x in 0 to 31 and y in 0 to 23"),
    "x between pixels": (_set(1700, 0, 1.5), r"row 1700: expected x in 0 to 31"),
    "x huge": (_set(1700, 0, 1e12), r"row 1700: expected x in 0 to 31"),
    "x nan": (_set(1700, 0, np.nan), r"row 1700: expected x .* = nan,"),
    "time nan": (_set(1700, 2, np.nan), r"row 1700: expected a finite time"),
    "time inf": (_set(1700, 2, np.inf), r"row 1700: expected a finite time"),
    "polarity 2": (_set(1700, 3, 2), r"row 1700: expected polarity"),
    "polarity nan": (_set(1700, 3, np.nan), r"row 1700: expected polarity"),
    "microseconds": (_events(lambda e: e * [1, 1, 1e6, 1]), r"expected times in seconds"),
    "milliseconds": (_events(lambda e: e * [1, 1, 1e3, 1]), r"expected the same clock"),
    "reversed": (_events(lambda e: e[::-1].copy()), r"expected (stamps|times) in order"),
    "integers": (
        _events(lambda e: e.astype(np.int64)),
        r"expected times in seconds, which int64 cannot hold",
    ),
    "other clock": (
        _events(lambda e: e + [0, 0, 500, 0]),
        r"clocks differ: depth .* 0 to 0\.3 s, events 500",
    ),
    "no event folder": (_remove(EVENTS_FILE), r"event file not found"),
    "no depth": (_remove("depth/*"), r"no depth found"),
    "depth of another size": (
        _each("depth", np.ones((HEIGHT, WIDTH + 1), np.uint16)),
        r"frame000000\.png: depth: expected the camera's 32x24 pixels, got 33x24.* \(7 of 7 depth images",
    ),
    "depth of 8 bits": (
        _each("depth", np.ones((HEIGHT, WIDTH), np.uint8)),
        r"frame000000\.png: expected a 16-bit single-channel depth PNG, got uint8",
    ),
    "depth of 3 channels": (
        _each("depth", np.ones((HEIGHT, WIDTH, 3), np.uint16)),
        r"frame000000\.png: expected a 16-bit single-channel depth PNG, got uint16 of shape \(24, 32, 3\)",
    ),
    "depth unreadable": (_each("depth", b"x"), r"frame000000\.png: not readable as an image"),
    "depth saturated": (
        _each("depth", np.full((HEIGHT, WIDTH), 65535, np.uint16)),
        r"depth has no variation: every pixel is missing \(0 or the largest value\) in 7 of the 7",
    ),
    "no depth in depth": (_each("depth", np.zeros((HEIGHT, WIDTH), np.uint16)), r"depth has no variation"),
    "depth constant": (
        _each("depth", np.full((HEIGHT, WIDTH), 1234, np.uint16)),
        r"depth has no variation: every pixel is missing or 1\.234 m in 7 of the 7 depth images looked at",
    ),
    "depth a bomb": (
        _each("depth", png_header(60000, 60000)),
        r"expected the camera's 32x24 pixels, got 6",
    ),
    "depth unnamed": (_write("depth/frame.png", "x"), r"expected a number in the file name"),
    "number in a name too large": (
        lambda f: (f / "depth/frame000300.png").rename(f / f"depth/frame{'9' * 100}.png"),
        r"png: expected a time or an index in the file name, got 9{26} \.\.\.",
    ),
    "image of another size": (
        _each("images", np.ones((HEIGHT + 1, WIDTH), np.uint8)),
        r"frame000000\.png: image: expected the camera's 32x24 pixels, got 32x25",
    ),
    "poses without times": (_remove("poses_ts.txt"), r"traj\.txt is there but poses_ts\.txt is not"),
    "fewer poses than times": (_write("traj.txt", IDENTITY_LINE), r"got 13 times .* and 1 poses"),
    "empty poses": (_write("traj.txt", ""), r"traj\.txt: expected lines .* got an empty file"),
    "pose of 15 numbers": (_write("traj.txt", "1 " * 15), r"expected 16 numbers a line .* got 15"),
    "pose not a number": (
        _write("traj.txt", "a " * 16),
        r"traj\.txt: line 1: expected 16 numbers .*, got 'a'",
    ),
    "pose nan": (
        _write("traj.txt", "nan " * 16),
        r"traj\.txt: line 1: expected 16 .* finite .* got nan",
    ),
    "pose not rigid": (
        _write("traj.txt", ("2" + IDENTITY_LINE[1:]) * 13),
        r"line 1: expected a rigid motion",
    ),
    "times not increasing": (
        _write("poses_ts.txt", "0\n" * 13),
        r"poses_ts\.txt: line 4: a second pose for 0 s, 0\.075 m from that in line 1",
    ),
    "pose times in ms": (
        lambda f: np.savetxt(f / "poses_ts.txt", np.arange(13) * 25),
        r"poses_ts\.txt covers 0 to 300 s, events .* poses_ts\.txt looks as if it were in milliseconds",
    ),
    "calibration not JSON": (_write("camera.json", "{"), r"calibration not readable as JSON"),
    "calibration a list": (_write("camera.json", "[1]"), r"camera\.json: expected an object"),
    "width a word": (_camera(width="wide"), r"camera\.json: width: .* got 'wide'"),
    "focal length zero": (_camera(fx=0), r"camera\.json: fx: .* greater than 0"),
    "focal length nan": (_camera(fx=float("nan")), r"camera\.json: fx: .*finite"),
    "centres elsewhere": (_camera(pixel_centres="corner"), r"pixel_centres: .*'integer' or 'half'"),
    "misspelt key": (_camera(depth_scal=5000), r"unknown key 'depth_scal'; did you mean 'depth_scale'"),
    "centre outside": (
        _camera(cx=40.0),
        r"camera\.json: expected the principal point inside the 32x24",
    ),
    "centre far outside": (
        _write("camera.json", '{"width": 32, "height": 24}'),
        r"principal point near",
    ),
    "focal length tiny": (
        _camera(fx=1e-300),
        r"camera\.json: camera: expected focal lengths in pixels, 0",
    ),
    "focal length huge": (_camera(fy=1e19), r"camera\.json: camera: expected focal lengths in pixels"),
    "threshold tiny": (_camera(contrast_threshold=1e-300), r"contrast_threshold: .*greater than or equal"),
    "scale huge": (_camera(depth_scale=1e300), r"depth_scale: .*less than or equal to 1000000"),
    "width of 30 digits": (_camera(width=10**30), r"width: .*less than or equal to 32767, got 1000"),
    "key twice": (_write("camera.json", '{"fx": 30, "fx": 31}'), r"the key 'fx' occurs twice"),
    "nested deeply": (
        _write("camera.json", "[" * 100_000),
        r"not readable as JSON: nested",
    ),
    "objects nested": (
        _write("camera.json", '{"a":' * 50_000),
        r"not readable as JSON: nested",
    ),
    "number of 1 MB": (
        _write("camera.json", '{"fx": 1' + "0" * 1_000_000 + "}"),
        r"not readable as JSON",
    ),
    "string of 1 MB": (_camera(width="9" * 1_000_000), r"camera\.json: width: .* got '999.*\.\.\.999"),
    "not UTF-8": (_bytes("camera.json", b'{"description": "caf\xe9"}'), r"JSON: not in UTF-8"),
    "distortion nested": (
        _camera(distortion=[[1], [2, 3]]),
        r"json: distortion\.0: .* valid number, got \[1\]",
    ),
    "distortion a word": (_camera(k1="abc"), r"json: k1: .* valid number, got 'abc'"),
    "distortion too short": (_camera(distortion=[0.1, 0.2]), r"json: .* expected 4 or 5 coefficients"),
    "distortion unknown": (
        _camera(distortion_model="fov"),
        r"json: distortion model: expected one of .* got 'fov'",
    ),
    "distortion of no lens": (
        _camera(k1=500.0),
        r"json: expected distortion .* that shows 1 % of the undistorted",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_data_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    change, message = REFUSED[case]
    folder = write_sequence(tmp_path / "s")
    change(folder)
    with pytest.raises((DataError, FileNotFoundError), match=message) as caught:
        read_all(folder)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 1000


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("x" * 1_000_000, "x" * 196 + " ..."),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\nb: c\r\n", r"a\nb: c\r\n"),
        ("a\0b", r"a\x00b"),
        ("\ud800", r"\ud800"),
        ("[/nope] [bold]x", "[/nope] [bold]x"),
        ("Büro, 2.5 m", "Büro, 2.5 m"),
    ],
)
def test_a_description_is_one_short_line_of_text(tmp_path: Path, text: str, shown: str) -> None:
    folder = write_sequence(tmp_path / "s", camera=CAMERA | {"description": text})
    assert EventReplicaSequence(folder).description == shown


def test_camera_json_may_have_a_byte_order_mark_and_unknown_keys(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s")
    values = CAMERA | {"k1": 0.0, "distortion": [0, 0], "serial": "x" * 100_000, "nested": {"a": [1]}}
    (folder / "camera.json").write_text("\ufeff" + json.dumps(values), encoding="utf-8")
    assert EventReplicaSequence(folder).camera.fx == 30


DISTORTIONS = {
    "keys": {"k1": -0.25, "k2": 0.05, "p1": 0.001},
    "list": {"distortion": [-0.25, 0.05, 0.001, 0.0]},
    "other name": {"distortion_coefficients": [-0.25, 0.05, 0.001, 0.0, 0.0]},
    "fisheye": {"distortion_model": "equidistant", "k1": -0.1, "k2": 0.01},
}


@pytest.mark.parametrize("name", DISTORTIONS)
def test_a_distorted_camera_is_undistorted(tmp_path: Path, name: str) -> None:
    folder = write_sequence(tmp_path / "s", camera=CAMERA | {"pixel_centres": "integer"} | DISTORTIONS[name])
    random = np.random.default_rng(3)
    grey = random.integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    depth = random.integers(1000, 3000, (HEIGHT, WIDTH)).astype(np.uint16)
    cv2.imwrite(str(folder / "images/frame000000.png"), grey)
    cv2.imwrite(str(folder / "depth/frame000000.png"), depth)
    sequence = EventReplicaSequence(folder)
    K, size = sequence.camera.matrix, (WIDTH, HEIGHT)
    if name == "fisheye":
        D = np.array([-0.1, 0.01, 0, 0])
        maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    else:
        D = np.array([-0.25, 0.05, 0.001, 0, 0])
        maps = cv2.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    expected = cv2.remap(grey.astype(np.float32) / 255, *maps, cv2.INTER_LINEAR)
    assert np.abs(sequence.image(0) - expected).max() < 1e-6
    nearest = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
    assert np.abs(sequence.depth(0) - nearest / 1000).max() < 1e-3
    rows = np.load(folder / "event_threshold_0.1/gray_events_data.npy")
    raw, counts = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH))
    np.add.at(raw, (rows[:, 1].astype(int), rows[:, 0].astype(int)), 1)
    events = sequence.events(0, 1)
    np.add.at(counts, (events.y, events.x), 1)
    assert (counts == cv2.remap(raw, np.rint(maps[0]), np.rint(maps[1]), cv2.INTER_NEAREST)).all()
    (folder / "camera.json").write_text(
        json.dumps(CAMERA | {"pixel_centres": "integer", "depth_undistorted": True} | DISTORTIONS[name])
    )
    assert np.abs(EventReplicaSequence(folder).depth(0) - depth / 1000).max() < 1e-3
