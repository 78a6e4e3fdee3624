"""Depth as sensors give it, and images that cannot be used: left out and noted, or refused on opening."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from written_sequences import CAMERA, HEIGHT, WIDTH, write_sequence

from edslam_ti.camera import Camera
from edslam_ti.datasets import SampledSequence, WrappedSequence
from edslam_ti.datasets.depth import DepthFormat, has_variation, read_depth
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError

PINHOLE = Camera(WIDTH, HEIGHT, 30.0, 30.0, 15.5, 11.5)
SLOPE = (1000 + 10 * np.arange(WIDTH) + np.zeros((HEIGHT, 1))).astype(np.uint16)
BROKEN: dict[str, Any] = {
    "of 65535": np.full((HEIGHT, WIDTH), 65535, np.uint16),
    "of 0": np.zeros((HEIGHT, WIDTH), np.uint16),
    "constant": np.full((HEIGHT, WIDTH), 1234, np.uint16),
    "of 8 bits": np.ones((HEIGHT, WIDTH), np.uint8),
    "of 3 channels": np.ones((HEIGHT, WIDTH, 3), np.uint16),
    "of another size": np.ones((HEIGHT, WIDTH + 1), np.uint16),
    "empty": b"",
    "a page": b"<html>404 Not Found</html>",
    "cut off": cv2.imencode(".png", SLOPE)[1].tobytes()[:-60],
    "with a flipped bit": bytes(
        byte ^ (k == 70) for k, byte in enumerate(cv2.imencode(".png", SLOPE)[1].tobytes())
    ),
}


def write(path: Path, content: np.ndarray | bytes) -> None:
    path.write_bytes(content if isinstance(content, bytes) else cv2.imencode(".png", content)[1].tobytes())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Depth that varies, every 50 ms from 0 to 300."""
    result = write_sequence(tmp_path / "s")
    for path in result.glob("depth/*"):
        write(path, SLOPE)
    return result


def test_zero_the_largest_value_and_a_stated_one_are_missing(tmp_path: Path) -> None:
    raw = SLOPE.copy()
    raw[0, :4] = 0, 65535, 7, 65534
    write(tmp_path / "d.png", raw)
    depth = read_depth(tmp_path / "d.png", PINHOLE, DepthFormat(1 / 1000, invalid=7))
    assert depth[0, :4].tolist() == [0, 0, 0, np.float32(65534) * np.float32(0.001)]
    assert (depth[1:] == SLOPE[1:].astype(np.float32) * np.float32(0.001)).all()
    assert read_depth(tmp_path / "d.png", PINHOLE, DepthFormat(1 / 1000))[0, 2] == np.float32(0.007)


def test_camera_json_states_what_is_invalid(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s", camera=CAMERA | {"invalid": 1010})
    write(folder / "depth/frame000050.png", SLOPE)
    depth = EventReplicaSequence(folder).depth(1)
    assert (depth[:, 1] == 0).all()
    assert (np.delete(depth, 1, axis=1) > 0).all()


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("broken", [0, 50, 150, 300])
def test_one_useless_depth_image_is_a_frame_without_depth(
    folder: Path, kind: str, broken: int, capfd: pytest.CaptureFixture
) -> None:
    write(folder / f"depth/frame{broken:06d}.png", BROKEN[kind])
    sequence = EventReplicaSequence(folder)
    shown = WrappedSequence(sequence)
    samples = list(SampledSequence(shown, 0.0, None, 0.05))
    missing = [round(1000 * s.timestamp) for s in samples if s.depth is None]
    assert missing == ([broken] if broken > 50 else [])  # 0: no events before; 50: begins later
    assert samples[0].timestamp == (0.1 if broken == 50 else 0.05)
    if broken == 0:
        return
    [note] = shown.notes
    assert note.startswith(f"no depth at {broken / 1000:.6f} s: ")
    assert sequence.notes == shown.notes
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")  # nothing of libpng's


@pytest.mark.parametrize("kind", ["of another size", "empty", "cut off", "with a flipped bit"])
@pytest.mark.parametrize("broken", [0, 150])
def test_one_unreadable_grey_image_is_a_frame_without_it(
    folder: Path, kind: str, broken: int, capfd: pytest.CaptureFixture
) -> None:
    write(folder / f"images/frame{broken:06d}.png", BROKEN[kind])
    sequence = EventReplicaSequence(folder)
    assert sequence.image_at(broken / 1000) is None
    assert sequence.image_at(0.2) is not None
    [note] = sequence.notes
    assert note.startswith(f"no image at {broken / 1000:.6f} s: ")
    sequence.image_at(broken / 1000)
    assert len(sequence.notes) == 1
    assert capfd.readouterr().err == ""


def test_flat_images_of_a_wall_are_kept(tmp_path: Path) -> None:
    """A wall seen at right angles, from distances that change: what the written sequence shows."""
    sequence = EventReplicaSequence(write_sequence(tmp_path / "s"))
    assert not has_variation(sequence.depth(1))
    assert all(s.depth is not None for s in SampledSequence(sequence, 0.0, None, 0.05))
    assert sequence.notes == []


def test_unreadable_first_images_are_skipped(folder: Path) -> None:
    for ms in (50, 100):
        (folder / f"depth/frame{ms:06d}.png").write_bytes(b"x")
    sequence = EventReplicaSequence(folder)
    samples = SampledSequence(sequence, 0.0, None, 0.05)
    assert samples.timestamps == pytest.approx([0.15, 0.2, 0.25, 0.3])
    assert len(sequence.notes) == 2


def test_names_that_are_not_utf_8_are_read(folder: Path) -> None:
    old = os.fsencode(folder / "depth/frame000150.png")
    os.rename(old, old.replace(b"000150", b"\xff000150"))
    sequence = EventReplicaSequence(folder)
    assert (sequence.depth(3) == sequence.depth(2)).all()
    os.truncate(old.replace(b"000150", b"\xff000150"), 20)
    assert sequence.depth_or_none(3) is None
    assert sequence.notes[0].isprintable()
    assert "\\udcff000150.png" in sequence.notes[0]


@pytest.mark.parametrize(
    "make",
    [lambda p: p.mkdir(), lambda p: p.symlink_to(p.name), lambda p: os.mkfifo(p),
     lambda p: p.symlink_to("/dev/zero"), lambda p: p.symlink_to("/nonexistent/x")],
)  # fmt: skip
def test_only_regular_files_are_read_as_images(folder: Path, make: Callable[[Path], Any]) -> None:
    path = folder / "depth/frame000150.png"
    path.unlink()
    make(path)
    sequence = EventReplicaSequence(folder)
    assert sequence.depth_or_none(3) is None
    assert "not found" in sequence.notes[0]


@pytest.mark.parametrize("corner", [2**31 - 2, 20000, -5])
def test_an_exr_that_promises_another_size_is_not_decoded(tmp_path: Path, corner: int) -> None:
    import OpenEXR

    path = tmp_path / "0100.exr"
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
        {"Z": SLOPE.astype(np.float32)},
    ).write(str(path))
    data = path.read_bytes()
    at = data.find(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4 + 8
    path.write_bytes(data[:at] + 2 * corner.to_bytes(4, "little", signed=True) + data[at + 8 :])
    with pytest.raises(DataError, match=r"0100\.exr: (not readable as OpenEXR|depth: expected the camera's)"):
        read_depth(path, PINHOLE, DepthFormat(1 / 1000))


def test_stderr_may_be_closed(folder: Path) -> None:
    saved = os.dup(2)
    os.close(2)
    try:
        assert has_variation(EventReplicaSequence(folder).depth(0))
    finally:
        os.dup2(saved, 2)
        os.close(saved)
