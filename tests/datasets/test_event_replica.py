"""EventReplica's layout: what is read, at what times, and what is refused in one line."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import psutil
import pytest
from written_sequences import CAMERA, HEIGHT, WIDTH, save_events, some_events, write_sequence

from edslam_ti.datasets import SampledSequence
from edslam_ti.datasets.event_file import EventFile
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError


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
        cv2.imwrite(str(path), np.ones((480, 768), np.uint16 if "depth" in str(path) else np.uint8))
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
    depth[0, 0] = 1e10
    write_exr(folder / "Depth_exr/0100.exr", {"Z": depth})
    half = np.minimum(depth, 65504).astype(np.float16)
    write_exr(folder / "Depth_exr/0250.exr", dict.fromkeys("RGB", half))
    sequence = EventReplicaSequence(folder)
    assert sequence.depth_timestamps == pytest.approx([0.1, 0.25])
    for k in range(2):
        assert sequence.depth(k)[3, 3] == 2.5
        assert sequence.depth(k)[0, 0] == 0
    depth[2, 3] = np.nan
    write_exr(folder / "Depth_exr/0100.exr", {"Z": depth})
    with pytest.raises(DataError, match=r"0100\.exr: expected finite depth .* column 3, row 2"):
        EventReplicaSequence(folder)
    (folder / "Depth_exr/0100.exr").write_text("x")
    with pytest.raises(DataError, match=r"0100\.exr: not readable as OpenEXR"):
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


def test_locally_unsorted_stamps_come_out_sorted_and_complete(tmp_path: Path) -> None:
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
    first = events[0, 2]
    assert sequence.time_offset == first
    assert sequence.time_range[0] == 0
    assert sequence.depth_timestamps[1] == pytest.approx(zero + 0.05 - first, abs=1e-6)
    assert sequence.truth is not None
    assert sequence.truth.timestamps[0] == pytest.approx(zero - first, abs=1e-6)
    assert len(sequence.events(0.0, 0.1)) == int((events[:, 2] < first + 0.1).sum())


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


EVENTS_FILE = "event_threshold_0.1/gray_events_data.npy"
IDENTITY_LINE = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"

REFUSED: dict[str, tuple[Any, str]] = {
    "no events": (lambda f: save_events(f, np.empty((0, 4))), r"npy: expected events, got an empty array"),
    "events file of 0 bytes": (_write(EVENTS_FILE, ""), r"npy: the file is empty"),
    "not a npy": (_write(EVENTS_FILE, "hello, not numpy"), r"not readable as a NumPy \.npy file"),
    "truncated": (_truncate, r"truncated: the header promises 3000 events"),
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
    "other clock": (_events(lambda e: e + [0, 0, 500, 0]), r"events cover 500.* expected the same clock"),
    "no event folder": (_remove(EVENTS_FILE), r"event file not found"),
    "no depth": (_remove("depth/*"), r"no depth found"),
    "depth of another size": (
        lambda f: cv2.imwrite(str(f / "depth/frame000100.png"), np.ones((HEIGHT, WIDTH + 1), np.uint16)),
        r"frame000100\.png: depth: expected the camera's 32x24 pixels, got 33x24",
    ),
    "depth of 8 bits": (
        lambda f: cv2.imwrite(str(f / "depth/frame000100.png"), np.ones((HEIGHT, WIDTH), np.uint8)),
        r"frame000100\.png: expected a 16-bit single-channel depth PNG, got uint8",
    ),
    "depth unreadable": (_write("depth/frame000100.png", "x"), r"frame000100\.png: not readable as an image"),
    "depth unnamed": (_write("depth/frame.png", "x"), r"expected a number in the file name"),
    "image of another size": (
        lambda f: cv2.imwrite(str(f / "images/frame000100.png"), np.ones((HEIGHT + 1, WIDTH), np.uint8)),
        r"frame000100\.png: image: expected the camera's 32x24 pixels, got 32x25",
    ),
    "poses without times": (_remove("poses_ts.txt"), r"traj\.txt is there but poses_ts\.txt is not"),
    "fewer poses than times": (_write("traj.txt", IDENTITY_LINE), r"got 13 times .* and 1 poses"),
    "empty poses": (_write("traj.txt", ""), r"traj\.txt: expected lines .* got an empty file"),
    "pose of 15 numbers": (_write("traj.txt", "1 " * 15), r"expected 16 numbers a line .* got 15"),
    "pose not a number": (_write("traj.txt", "a " * 16), r"traj\.txt: expected 16 numbers a line"),
    "pose nan": (_write("traj.txt", "nan " * 16), r"row 1 of the table holds a value that is not finite"),
    "pose not rigid": (
        _write("traj.txt", ("2" + IDENTITY_LINE[1:]) * 13),
        r"line 1: expected a rigid motion",
    ),
    "times not increasing": (
        _write("poses_ts.txt", "0\n" * 13),
        r"expected increasing times, got 0\.0 then 0\.0",
    ),
    "pose times in ms": (
        lambda f: np.savetxt(f / "poses_ts.txt", np.arange(13) * 25),
        r"poses_ts\.txt \(s\) 0 to 300 s; expected the same clock",
    ),
    "calibration not JSON": (_write("camera.json", "{"), r"calibration not readable as JSON"),
    "calibration a list": (_write("camera.json", "[1]"), r"camera\.json: expected an object"),
    "width a word": (_camera(width="wide"), r"camera\.json: width: .* got 'wide'"),
    "focal length zero": (_camera(fx=0), r"camera\.json: fx: .* greater than 0"),
    "focal length nan": (_camera(fx=float("nan")), r"camera\.json: fx: .*finite"),
    "centres elsewhere": (_camera(pixel_centres="corner"), r"pixel_centres: .*'integer' or 'half'"),
    "misspelt key": (_camera(depth_scal=5000), r"unknown key 'depth_scal'; did you mean 'depth_scale'"),
    "distorted": (_camera(k1=-0.3), r"'k1': expected an undistorted camera"),
    "centre outside": (_write("camera.json", '{"width": 32, "height": 24}'), r"principal point inside"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_data_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    change, message = REFUSED[case]
    folder = write_sequence(tmp_path / "s")
    change(folder)
    with pytest.raises((DataError, FileNotFoundError), match=message) as caught:
        read_all(folder)
    assert "\n" not in str(caught.value)
