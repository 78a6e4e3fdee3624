"""How far a run's poses can be trusted: sigmas, lost frames, and what contradicts itself in the recording."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.output import atomic_file
from edslam_ti.slam import Slam
from edslam_ti.tracking.consistency import Consistency
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.tracking.uncertainty import absolute_covariances, sigmas
from edslam_ti.trajectory import Trajectory

UNCERTAIN_SHARE, UNCERTAIN = 0.25, 0.03  # of the path's extent, and metres: larger sigmas are named
MOST_LOST = 0.1  # share of the frames: beyond, the path cannot be relied on
COLUMNS = (
    *("timestamp_s", "tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"),
    *("sigma_position_m", "sigma_rotation_deg", "lost", "message"),
)


@dataclass(frozen=True)
class Trust:
    """What is known of the errors of a path without any truth."""

    trajectory: Trajectory
    results: Sequence[TrackingResult]  # one for each pose
    consistency: Consistency | None  # None: the tracker does not compare its data

    @staticmethod
    def of(slam: Slam) -> "Trust":
        """Return it for a run."""
        return Trust(slam.trajectory, slam.results, slam.tracker.consistency(slam.trajectory))

    @staticmethod
    def unknown(slam: Slam) -> "Trust":
        """Return it for a run whose data could not be compared."""
        return Trust(slam.trajectory, slam.results, None)

    @cached_property
    def sigmas(self) -> tuple[np.ndarray, np.ndarray]:  # [F] metres, [F] degrees
        """Standard deviations of every pose's position and rotation, about the first pose."""
        return sigmas(absolute_covariances(self.results, self.trajectory))

    @property
    def is_measured(self) -> bool:
        """Whether the tracker says how exact its poses are."""
        return any(r.measurement is not None for r in self.results)

    @property
    def lost_share(self) -> float:
        """Share of the frames whose pose is only predicted."""
        return float(np.mean([not r.converged for r in self.results])) if self.results else 0.0

    @property
    def problems(self) -> list[str]:
        """Return a line for each thing that is likely wrong, and what to do."""
        lines = [] if self.consistency is None else list(self.consistency.problems)
        if self.lost_share > MOST_LOST:
            reasons: dict[str, int] = {}
            for r in self.results:
                if not r.converged:
                    reasons[r.message] = reasons.get(r.message, 0) + 1
            commonest = max(reasons, key=lambda reason: reasons[reason])
            lines.append(
                f"{self.lost_share:.0%} of the frames were lost ({commonest}); their poses are predicted, "
                "not measured"
            )
        return lines + self._uncertain()

    def _uncertain(self) -> list[str]:
        """Return a line where what was seen does not determine the path."""
        if not self.is_measured:
            return []
        position, positions = self.sigmas[0], self.trajectory.poses[:, :3, 3]
        extent = float(np.linalg.norm(positions - positions[0], axis=1).max())
        is_tracked = np.array([r.converged for r in self.results])
        uncertain = np.flatnonzero(is_tracked & (position > max(UNCERTAIN_SHARE * extent, UNCERTAIN)))
        if len(uncertain) == 0:
            return []
        first, largest = self.trajectory.timestamps[uncertain[0]], position.max()
        size = f"{largest:.2g} m" if largest < extent else "more than the whole path"
        return [
            f"the path is not determined from {first:.3f} s on (standard deviation up to {size}): too little "
            "texture or structure was in view"
        ]

    def metrics(self) -> dict[str, Any]:
        """Return what metrics.json says of it; None where nothing is known."""
        position, rotation = self.sigmas if self.is_measured else (np.zeros(0), np.zeros(0))
        c = self.consistency
        return {
            "sigma_position_median_cm": _rounded(100 * np.median(position)) if len(position) else None,
            "sigma_position_end_cm": _rounded(100 * position[-1]) if len(position) else None,
            "sigma_rotation_median_deg": _rounded(np.median(rotation)) if len(rotation) else None,
            "depth_delay_ms": None if c is None else _rounded(1000 * c.depth_delay_s),
            "depth_delay_sigma_ms": None if c is None else _rounded(1000 * c.depth_delay_sigma_s),
            "event_depth_disagreement": None if c is None else _rounded(float(np.sqrt(c.disagreement))),
            "lost_share": _rounded(self.lost_share),
            "problems": self.problems,
        }

    def write(self, path: Path, time_offset: float = 0.0) -> None:
        """Write poses.csv: a line a frame, stamps on the recording's own clock, poses camera to world."""
        position, rotation = self.sigmas
        with atomic_file(path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for k, (t, T, r) in enumerate(
                zip(self.trajectory.timestamps, self.trajectory.poses, self.results)
            ):
                q = Rotation.from_matrix(T[:3, :3]).as_quat()
                pose = [f"{value:.9f}" for value in (*T[:3, 3], *q)]
                sigma = [f"{position[k]:.6f}", f"{rotation[k]:.5f}"] if self.is_measured else ["", ""]
                stamp = f"{t + time_offset:.6f}"
                writer.writerow([stamp, *pose, *sigma, int(not r.converged), r.message])


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
