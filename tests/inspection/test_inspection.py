"""An inspection names the fault in spoiled copies of a good recording, and none in the good one."""

from pathlib import Path

import numpy as np
import pytest
from sequences import ate_cm, record_tiny_room, settings, tracked
from spoiled import FAULTY, spoiled

from edslam_ti.commands.inspect import FAULTY as FAULTY_EXIT
from edslam_ti.commands.inspect import main
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.base import SampledSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import DataError
from edslam_ti.inspection.calibration import ShiftedDepth, calibrate_depth
from edslam_ti.inspection.clock_offsets import Offset, clock_findings
from edslam_ti.inspection.edge_check import check_edges
from edslam_ti.inspection.event_volume import EventVolume, liveliest_part
from edslam_ti.inspection.findings import FAULTS
from edslam_ti.inspection.image_check import check_images
from edslam_ti.inspection.pose_check import check_poses
from edslam_ti.inspection.report import Checks, check, offsets_of


def quick_check(sequence: EventDepthSequence) -> Checks:
    """Return what is found without tracking."""
    return check(sequence, lambda what: None)


def test_nothing_is_wrong_in_a_good_recording(tiny_sequence: EventDepthSequence) -> None:
    checks = quick_check(tiny_sequence)
    assert checks.findings == ()
    assert clock_findings(offsets_of(checks)) == []
    assert checks.images is not None
    assert checks.images.correlation > 0.9
    assert checks.poses is not None
    assert checks.poses.cost < 0.15
    assert abs(checks.poses.offset) < 0.005


@pytest.mark.parametrize("fault", [name for name in FAULTY if "late" not in name])
def test_the_fault_is_named(tiny_sequence: EventDepthSequence, fault: str) -> None:
    expected = FAULTY[fault][0]
    assert expected in FAULTS
    checks = quick_check(spoiled(tiny_sequence, fault))
    assert {finding.fault for finding in checks.findings} == {expected}


def test_a_late_stream_is_named(tiny_sequence: EventDepthSequence) -> None:
    sequence = spoiled(tiny_sequence, "images late")
    check = check_images(sequence, EventVolume(sequence, *liveliest_part(sequence)))
    assert check is not None
    assert check.offset == pytest.approx(-0.03, abs=0.006)
    sequence = spoiled(tiny_sequence, "depth late")
    poses = check_poses(sequence, *liveliest_part(sequence))
    assert poses is not None
    assert poses.offset == pytest.approx(0.03, abs=0.006)


def test_the_stream_that_disagrees_with_most_is_off() -> None:
    measured = [
        Offset("events", "images", 0.031, 0.004),
        Offset("depth", "truth", 0.001, 0.002),
        Offset("depth", "events", -0.028, 0.004),
    ]
    (images,) = clock_findings([Offset("events", "images", 0.03, 0.004), *measured[1:2]])
    assert images.fault == "images_clock"  # as many for the one as for the other: events are believed
    findings = clock_findings([*measured, Offset("images", "truth", 0.0, 0.002)])
    assert [f.fault for f in findings] == ["events_clock"]
    assert "30 ms" in findings[0].text
    assert "too late against images and truth and depth" in findings[0].text
    assert clock_findings([Offset("depth", "events", 0.004, 0.004)]) == []


def test_edges_of_depth_lie_on_events(tiny_sequence: EventDepthSequence) -> None:
    check = check_edges(tiny_sequence, EventVolume(tiny_sequence, *liveliest_part(tiny_sequence)))
    assert check is not None
    assert check.here > 2
    assert np.abs(check.displacement).max() <= 2


def test_a_delay_of_depth_is_found(tiny_sequence: EventDepthSequence) -> None:
    found = calibrate_depth(ShiftedDepth(tiny_sequence, -0.02), Config(), lambda what: None)
    # In 0.7 s only a few frames are compared; on 2 s it comes out to a millisecond.
    assert found.delay == pytest.approx(0.02, abs=0.008)
    assert found.after < 0.5 * found.before
    assert "late and perhaps turned (too few frames to tell)" in found.text


def test_depth_at_its_own_stamps_tracks_as_depth_in_step_and_an_offset_is_found(
    tiny_sequence: EventDepthSequence, tmp_path: Path
) -> None:
    errors = {"in step": _tracking_error(tiny_sequence)}
    for name, offset in (("out of step", 0.0), ("early", -0.01)):
        own = {"rate": 30.0, "phase": 0.017, "time_offset": offset}
        folder = record_tiny_room(tmp_path / name, max_motion=4.0, pose_rate=200.0, depth_sensor=own)
        sequence = EventReplicaSequence(folder)
        samples = SampledSequence(sequence, 0, None, 0.05)
        stamps = sequence.depth_timestamps[1:]  # the first has no events before it
        np.testing.assert_array_equal(samples.timestamps[samples.has_depth], stamps)
        errors[name] = _tracking_error(sequence)
    assert errors["out of step"] < 1.5 * errors["in step"] < 0.1  # cm; 0.040 and 0.036 were measured
    assert errors["early"] > 1.2 * errors["out of step"]  # 10 ms are seen in the path
    found = calibrate_depth(sequence, settings(), lambda what: None)
    assert found.delay == pytest.approx(-0.01, abs=0.004)


def _tracking_error(sequence: EventDepthSequence) -> float:  # cm
    return ate_cm(tracked(sequence, list(SampledSequence(sequence, 0, None, 0.05))), sequence)


def test_what_cannot_be_calibrated_is_said(tiny_sequence: EventDepthSequence) -> None:
    short = ShiftedDepth(tiny_sequence, 0.0)
    short.depth_timestamps = tiny_sequence.depth_timestamps[:3]
    with pytest.raises(DataError, match="too little to compare the two; leave --calibrate out"):
        calibrate_depth(short, Config(), lambda what: None)


def test_the_command_prints_and_draws(
    tmp_path: Path, tiny_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import cv2

    main([str(tiny_folder), "--sheet", str(tmp_path / "sheet.png")])
    printed = capsys.readouterr().out
    assert "camera: 120x80 pixels" in printed
    assert "nothing looks wrong" in printed
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape[1] > 5 * 300
    assert sheet.std() > 30


def test_a_refused_recording_is_explained(
    tmp_path: Path, tiny_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    folder = tmp_path / "swapped"
    shutil.copytree(tiny_folder, folder)
    (file,) = folder.glob("event_threshold_*/*.npy")
    np.save(file, np.load(file)[:, [1, 0, 2, 3]])
    with pytest.raises(SystemExit) as stopped:
        main([str(folder), "--sheet", str(tmp_path / "sheet.png")])
    assert stopped.value.code == FAULTY_EXIT
    assert "WARNING swapped_axes: x and y look swapped" in capsys.readouterr().out
