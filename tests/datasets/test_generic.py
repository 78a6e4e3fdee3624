"""The layout `generic`, on small recordings written file by file from its description in docs/data.md."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edslam_ti.config import Config
from edslam_ti.datasets import find_sequence, open_folder
from edslam_ti.datasets.generic import GenericSequence
from edslam_ti.errors import DataError

WIDTH, HEIGHT = 32, 24
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 16.0, "cy": 12.0}
EPOCH = 1_600_000_000.0  # s


def write_recording(folder: Path, start: float = 0.0, **camera: Any) -> Path:
    """Write 0.3 s: columns of events, depth and images every 50 ms in millimetres, a path along x."""
    rng = np.random.default_rng(1)
    number = 2000
    (folder / "events").mkdir(parents=True)
    (folder / "depth").mkdir()
    (folder / "images").mkdir()
    np.save(folder / "events/x.npy", rng.integers(0, WIDTH, number).astype(np.uint16))
    np.save(folder / "events/y.npy", rng.integers(0, HEIGHT, number).astype(np.uint16))
    np.save(folder / "events/t.npy", start + np.sort(rng.uniform(0, 0.3, number)))
    np.save(folder / "events/p.npy", rng.integers(0, 2, number).astype(np.uint8))
    (folder / "camera.json").write_text(json.dumps(CAMERA | camera))
    depth_lines, image_lines, truth = ["# stamp path"], [], []
    for k in range(7):
        depth = np.full((HEIGHT, WIDTH), 1000 + k, np.uint16)
        depth[0, 0] = 0
        cv2.imwrite(str(folder / f"depth/{k}.png"), depth)
        cv2.imwrite(str(folder / f"images/{k}.png"), np.full((HEIGHT, WIDTH), 51, np.uint8))
        t = start + 0.05 * k
        depth_lines.append(f"{t!r} depth/{k}.png")
        image_lines.append(f"{t!r} images/{k}.png")
        truth.append(f"{t!r} {0.1 * k} 0 0 0 0 0 1")
    (folder / "depth.txt").write_text("\n".join(depth_lines))
    (folder / "images.txt").write_text("\n".join(image_lines))
    (folder / "truth.txt").write_text("\n".join(truth))
    return folder


def test_a_recording_is_recognised_and_read(tmp_path: Path) -> None:
    write_recording(tmp_path / "desk", contrast_threshold=0.2, exposure=0.01)
    assert find_sequence(Config(data_dir=tmp_path, scene="desk")).dataset == "generic"
    sequence = open_folder(tmp_path / "desk", Config())
    stored = np.load(tmp_path / "desk/events/t.npy")
    events = sequence.events(0.0, 1.0)
    assert np.array_equal(events.t, stored)
    assert np.array_equal(events.polarity > 0, np.load(tmp_path / "desk/events/p.npy") == 1)
    assert sequence.time_range == (stored[0], stored[-1])
    assert (sequence.camera.cx, sequence.camera.cy) == (16.0, 12.0)  # centres at integers unless stated
    assert sequence.depth(3)[0, 0] == 0
    assert sequence.depth(3)[1, 1] == np.float32(1003) * np.float32(0.001)
    assert sequence.image(2)[0, 0] == np.float32(51) / 255
    assert (sequence.contrast_threshold, sequence.exposure) == (0.2, 0.01)
    assert sequence.truth is not None
    assert sequence.truth.pose(2)[0, 3] == pytest.approx(0.2)


def test_stamps_since_the_epoch_are_kept(tmp_path: Path) -> None:
    sequence = GenericSequence(write_recording(tmp_path / "desk", start=EPOCH))
    assert sequence.time_offset == EPOCH
    assert sequence.depth_timestamps[1] == (EPOCH + 0.05) - EPOCH
    assert sequence.time_range[0] == np.load(tmp_path / "desk/events/t.npy")[0] - EPOCH


def test_a_stated_offset_is_that_of_the_recordings_own_clock(tmp_path: Path) -> None:
    sequence = GenericSequence(write_recording(tmp_path / "desk", time_offset=EPOCH))
    assert sequence.time_offset == EPOCH
    assert sequence.depth_timestamps[1] == 0.05


def test_events_or_depth_may_be_missing(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "desk")
    (folder / "depth.txt").unlink()
    without_depth = GenericSequence(folder)
    assert len(without_depth.depth_timestamps) == 0
    assert "there is no depth: expected lines 'stamp path'" in " ".join(without_depth.notes)
    folder = write_recording(tmp_path / "shelf")
    (folder / "events/x.npy").unlink()
    assert not GenericSequence(folder).has_events


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "camera.json").write_text('{"width": 900}'), "expected .* got no height, fx"),
        (lambda f: (f / "events.txt").write_text("0 1 1 1\n"), r"events in events\.txt and in events; keep"),
        (lambda f: (f / "traj.txt").rename(f / "poses_ts.txt"), "true poses twice"),
        (lambda f: (f / "depth.txt").write_text("5000.0 depth/0.png\n"), "the clocks differ"),
    ],
)
def test_faults_are_named(tmp_path: Path, change: Any, message: str) -> None:
    folder = write_recording(tmp_path / "desk")
    (folder / "traj.txt").write_text("")
    change(folder)
    with pytest.raises(DataError, match=message):
        GenericSequence(folder)
