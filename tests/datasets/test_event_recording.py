"""Files of events alone: what they hold besides events is kept, what they do not state is asked for."""

import json
from pathlib import Path

import numpy as np
import pytest

from edslam_ti.config import Config
from edslam_ti.conversion import convert
from edslam_ti.datasets import open_folder
from edslam_ti.datasets.event_recording import EventRecording
from edslam_ti.errors import DataError


def test_a_file_without_a_size_is_refused(tmp_path: Path) -> None:
    events = np.array([[1, 2, 0.1, 1], [3, 4, 0.2, -1]])
    np.save(tmp_path / "events.npy", events)
    with pytest.raises(DataError, match="does not state the size of its image"):
        EventRecording(tmp_path / "events.npy")


def test_a_davis_file_keeps_frames_and_imu(tmp_path: Path, shared_data: Path) -> None:
    pytest.importorskip("aedat")
    path = shared_data / "aedat4/davis346_test_data.aedat4"
    recording = EventRecording(path)
    assert (recording.camera.width, recording.camera.height) == (346, 260)
    assert len(recording.image_timestamps) == 59
    assert recording.imu is not None
    last, first = recording.image(58), recording.image(0)  # in any order
    assert first.shape == (260, 346)
    assert not np.array_equal(first, last)
    summary = convert(recording, tmp_path / "davis", "generic", lambda share: None)
    assert (summary.num_events, summary.num_images) == (78830, 59)
    assert any("the lens is not known" in note for note in summary.notes)
    with pytest.raises(DataError, match="fx"):
        open_folder(tmp_path / "davis", Config())
    stated = json.loads((tmp_path / "davis/camera.json").read_text())
    stated |= {"fx": 250.0, "fy": 250.0, "cx": 172.0, "cy": 130.0}
    (tmp_path / "davis/camera.json").write_text(json.dumps(stated))
    converted = open_folder(tmp_path / "davis", Config())
    own = recording.events(*recording.time_range)
    assert np.array_equal(converted.events(*recording.time_range).t, own.t)
    assert converted.time_offset == recording.time_offset
    assert np.array_equal(converted.image(58), last)
    assert converted.imu is not None
    assert np.array_equal(converted.imu.acceleration, recording.imu.acceleration)
