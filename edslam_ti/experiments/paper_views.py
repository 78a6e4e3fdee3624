"""Paths, errors over time and rendered views of finished runs, read from their folders."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from edslam_ti.experiments.jobs import Outcome
from edslam_ti.results.pictures import read_panels
from edslam_ti.results.plots import align_to_truth
from edslam_ti.trajectory import Trajectory, read_tum


@dataclass(frozen=True)
class ShownView:
    """A held-out view of a run: a time and the picture of truth and render."""

    timestamp: float  # seconds
    psnr_db: float | None  # corrected; None: no true image
    picture: Path

    def panels(self) -> tuple[np.ndarray, np.ndarray]:  # [h, w, 3] uint8 each
        """Return truth and render."""
        return read_panels(self.picture)


@dataclass(frozen=True)
class ShownRun:
    """A finished run and its folder."""

    outcome: Outcome
    folder: Path

    @property
    def method(self) -> str:
        name: str = self.outcome["job"]["method"]
        return name

    @cached_property
    def trajectory(self) -> Trajectory:
        """The estimated path."""
        return read_tum(self.folder / "trajectory_tum.txt")

    @cached_property
    def truth(self) -> Trajectory | None:
        """The true path at the tracked times, None where the recording has none."""
        file = self.folder / "truth_tum.txt"
        return read_tum(file) if file.is_file() else None

    def aligned(self) -> tuple[np.ndarray, np.ndarray]:  # [F, 3] metres, [F] cm, NaN where unknown
        """Return positions moved rigidly onto the truth, and their errors."""
        path = align_to_truth(self.trajectory, self.truth)
        return path.positions, 100 * path.errors

    def views(self) -> list[ShownView]:
        """Return the held-out views in the order of time; none without a map."""
        table = self.folder / "renders" / "views.csv"
        if not table.is_file():
            return []
        with table.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["views"] == "held out"]
        views = []
        for row in rows:
            t, psnr = float(row["timestamp_s"]), row["psnr_corrected_db"]
            picture = self.folder / "renders" / f"{round(1000 * t):06d}.png"
            if picture.is_file():
                views.append(ShownView(t, float(psnr) if psnr else None, picture))
        return views


@dataclass(frozen=True)
class ShownGroup:
    """Runs of all methods on one recording with one kind of depth, of one seed."""

    scene: str
    data: str
    dataset: str
    runs: tuple[ShownRun, ...]

    @property
    def truth(self) -> Trajectory | None:
        """The true path, None where the recording has none."""
        return next((run.truth for run in self.runs if run.truth is not None), None)

    @property
    def kind(self) -> str:
        """What sets the group apart from others of the same scene."""
        return self.data.partition(", ")[2] if self.dataset == "builtin" else self.data

    def plane(self) -> tuple[np.ndarray, np.ndarray]:  # [3] metres, [3, 3]
        """Return the middle of the path and its main axes, the longest first, as rows."""
        path = self.truth or self.runs[0].trajectory
        positions = path.poses[:, :3, 3]
        middle = positions.mean(0)
        _, _, axes = np.linalg.svd(positions - middle, full_matrices=False)
        if len(axes) < 3:  # fewer than three poses
            axes = np.eye(3)
        return middle, axes

    def times(self) -> list[float]:
        """Return the times (s) of held-out views that some run shows."""
        return sorted({view.timestamp for run in self.runs for view in run.views()})


def groups_of(outcomes: Sequence[Outcome], out: Path) -> list[ShownGroup]:
    """Return the finished runs by recording and kind of depth; of several seeds the first that finished."""
    groups: dict[tuple[str, str, str], dict[str, ShownRun]] = {}
    for outcome in sorted((o for o in outcomes if "metrics" in o), key=lambda o: o["job"]["seed"]):
        job, folder = outcome["job"], out / "runs" / outcome["name"]
        if not (folder / "trajectory_tum.txt").is_file():
            continue
        key = (job["dataset"], job["scene"], outcome["data"])
        groups.setdefault(key, {}).setdefault(job["method"], ShownRun(outcome, folder))
    return [
        ShownGroup(scene, data, dataset, tuple(runs.values()))
        for (dataset, scene, data), runs in groups.items()
    ]
