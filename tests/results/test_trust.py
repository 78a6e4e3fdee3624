"""poses.csv, and what a run says of its own poses."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sequences import settings, tracked, without_depth, without_events

from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.results.trust import COLUMNS, Trust
from edslam_ti.slam import Slam


@pytest.fixture(scope="module")
def clean(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> Slam:
    return tracked(tiny_sequence, tiny_samples)


def test_poses_csv_has_a_line_a_frame_with_its_sigma(clean: Slam, tmp_path: Path) -> None:
    Trust.of(clean).write(tmp_path / "poses.csv", time_offset=1642650000.0)
    with (tmp_path / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    stamps = [float(row["timestamp_s"]) - 1642650000.0 for row in rows]
    np.testing.assert_allclose(stamps, clean.trajectory.timestamps, atol=1e-6)
    positions = [[float(row[f"t{axis}_m"]) for axis in "xyz"] for row in rows]
    np.testing.assert_allclose(positions, clean.trajectory.poses[:, :3, 3], atol=1e-9)
    sigma = [float(row["sigma_position_m"]) for row in rows]
    assert sigma[0] == 0
    assert all(1e-5 < s < 0.01 for s in sigma[1:])
    assert {row["lost"] for row in rows} == {"0"}
    assert any(row["message"] == "first brightness image" for row in rows)


def test_a_run_of_right_data_has_no_problem(clean: Slam) -> None:
    trust = Trust.of(clean)
    assert trust.problems == []
    metrics = trust.metrics()
    assert 0 < metrics["sigma_position_median_cm"] < 1
    assert metrics["lost_share"] == 0


def test_lost_frames_are_reported_with_their_commonest_reason(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    dark = range(8, 12)
    blind = [without_depth(without_events(s)) if k in dark else s for k, s in enumerate(tiny_samples)]
    trust = Trust.of(tracked(tiny_sequence, blind))
    assert trust.lost_share == len(dark) / len(tiny_samples)
    (line,) = trust.problems
    assert "of the frames were lost (too few events, and no depth to align instead)" in line


def test_a_path_that_is_not_determined_is_said_to_be(clean: Slam) -> None:
    results = list(clean.results)
    index = next(k for k in range(6, len(results)) if results[k].measurement is not None)
    known = results[index].measurement
    assert known is not None
    results[index] = replace(results[index], measurement=replace(known, covariance=np.eye(6)))
    (line,) = Trust(clean.trajectory, results, None).problems
    start = f"the path is not determined from {clean.trajectory.timestamps[index]:.3f} s on"
    assert line.startswith(start)


def test_a_tracker_that_does_not_measure_has_no_sigma(
    tiny_sequence: EventDepthSequence, tiny_samples: list[Sample], tmp_path: Path
) -> None:
    trust = Trust.of(tracked(tiny_sequence, tiny_samples, settings("open3d_icp")))
    assert trust.metrics()["sigma_position_median_cm"] is None
    trust.write(tmp_path / "poses.csv")
    with (tmp_path / "poses.csv").open() as file:
        assert {row["sigma_position_m"] for row in csv.DictReader(file)} == {""}
