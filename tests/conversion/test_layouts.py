"""A converted recording is its original to the bit; what is not ours is not overwritten."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from written_sequences import HEIGHT, WIDTH, write_sequence

from edslam_ti.config import Config
from edslam_ti.conversion import convert
from edslam_ti.conversion.pictures import depth_units, exact_scale
from edslam_ti.datasets import EventDepthSequence, WrappedSequence, open_folder, preset_of
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError
from edslam_ti.geometry import se3_exp
from edslam_ti.trajectory import Trajectory


class Awkward(WrappedSequence):
    """A sequence with what files rarely hold exactly: other stamps, depth in no unit, a late clock."""

    def __init__(self, sequence: EventDepthSequence) -> None:
        super().__init__(sequence)
        rng = np.random.default_rng(4)
        self.time_offset = 1.6e9
        stamps = sequence.depth_timestamps
        self.depth_timestamps = stamps + rng.uniform(0, 1e-3, len(stamps))
        twists = rng.normal(0, 0.3, (9, 6))
        self.truth = Trajectory(np.linspace(0, 0.3, 9) / 3.0, np.array([se3_exp(t) for t in twists]))
        self.preset = "rpg"

    def depth(self, index: int) -> np.ndarray:
        return self._sequence.depth(index) / np.float32(3) if index == 4 else self._sequence.depth(index)

    def image(self, index: int) -> np.ndarray:
        return self._sequence.image(index) * np.float32(0.7) if index else self._sequence.image(index)


def assert_same(a: EventDepthSequence, b: EventDepthSequence) -> None:
    assert (a.camera, a.time_range, a.time_offset) == (b.camera, b.time_range, b.time_offset)
    assert (a.contrast_threshold, a.exposure) == (b.contrast_threshold, b.exposure)
    assert np.array_equal(a.depth_timestamps, b.depth_timestamps)
    assert np.array_equal(a.image_timestamps, b.image_timestamps)
    for k in range(len(a.depth_timestamps)):
        assert np.array_equal(a.depth(k), b.depth(k))
    for k in range(len(a.image_timestamps)):
        assert np.array_equal(a.image(k), b.image(k))
    first, second = a.events(-1, 1e6), b.events(-1, 1e6)
    for name in ("x", "y", "t", "polarity"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert a.truth is not None
    assert b.truth is not None
    assert np.array_equal(a.truth.timestamps, b.truth.timestamps)
    assert np.array_equal(a.truth.poses, b.truth.poses)


@pytest.mark.parametrize("layout", ["generic", "event_replica"])
@pytest.mark.parametrize("is_awkward", [False, True])
def test_a_conversion_is_the_same_to_the_bit(tmp_path: Path, layout: str, is_awkward: bool) -> None:
    original: EventDepthSequence = EventReplicaSequence(write_sequence(tmp_path / "desk"))
    original = Awkward(original) if is_awkward else original
    shares: list[float] = []
    summary = convert(original, tmp_path / "out", layout, shares.append)
    converted = open_folder(tmp_path / "out", Config())
    assert converted.dataset == layout
    assert_same(original, converted)
    assert summary.num_events == len(original.events(-1, 1e6))
    assert shares == sorted(shares)
    assert shares[-1] == 1
    # And back, over an older conversion, which may be replaced.
    other = "event_replica" if layout == "generic" else "generic"
    for _ in range(2):
        convert(converted, tmp_path / "back", other, shares.append)
    assert_same(original, open_folder(tmp_path / "back", Config()))
    if is_awkward:
        assert preset_of(Config(data_dir=tmp_path, scene="back")) == "rpg"


def test_only_a_conversion_is_replaced(tmp_path: Path) -> None:
    sequence = EventReplicaSequence(write_sequence(tmp_path / "desk"))
    with pytest.raises(DataError, match="holds something else than a converted recording"):
        convert(sequence, tmp_path / "desk", "generic", print)
    convert(sequence, tmp_path / "out", "generic", lambda share: None)
    (tmp_path / "out/notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"holds 'notes\.txt' beside a converted recording"):
        convert(sequence, tmp_path / "out", "generic", print)
    assert (tmp_path / "out/notes.txt").read_text() == "mine"


def test_an_image_that_cannot_be_read_is_left_out_and_said(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "desk")
    sequence = EventReplicaSequence(folder)
    (folder / "depth/frame000100.png").write_bytes(b"no image")
    summary = convert(sequence, tmp_path / "out", "generic", lambda share: None)
    assert summary.num_depth_images == 6
    assert "depth at 0.100000 s is left out" in summary.notes[0]
    assert len(open_folder(tmp_path / "out", Config()).depth_timestamps) == 6


def test_what_event_replica_cannot_hold_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd"
    (folder / "depth").mkdir(parents=True)
    for k in range(3):
        depth = np.full((HEIGHT, WIDTH), 700 + k, np.uint16)
        depth[0] = 900
        cv2.imwrite(str(folder / f"depth/{k}.png"), depth)
    (folder / "depth.txt").write_text("".join(f"{k}.5 depth/{k}.png\n" for k in range(3)))
    (folder / "camera.json").write_text('{"width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12}')
    sequence = open_folder(folder, Config())
    with pytest.raises(DataError, match="needs events, and this recording has none; convert it to generic"):
        convert(sequence, tmp_path / "out", "event_replica", print)
    assert not (tmp_path / "out").exists()
    assert convert(sequence, tmp_path / "out", "generic", lambda share: None).num_depth_images == 3
    assert not open_folder(tmp_path / "out", Config()).has_events


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 1234.5, 25.5])
def test_the_unit_of_depth_is_found_from_its_values(scale: float) -> None:
    units = np.random.default_rng(2).integers(0, 9000, (20, 30)).astype(np.uint16)
    depth = units.astype(np.float32) * np.float32(1 / scale)
    found = exact_scale([depth])
    assert found is not None
    written = depth_units(depth, found)
    assert written is not None
    assert np.array_equal(written.astype(np.float32) * np.float32(1 / found), depth)
    assert exact_scale([depth * np.float32(np.pi), depth]) is None
