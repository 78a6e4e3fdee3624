"""Errors of an estimated path against the true one, computed by evo, and the alignments that they need.

Publications use the name ATE for different measures, so every variant has its own name here: SE(3) or Sim(3)
alignment; rmse, mean, median or maximum.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.geometry import orthonormalized
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import FARTHEST, true_path, true_poses_at

FEWEST_POSES = 3  # needed for an alignment
NO_TRANSLATION = 1e-6  # m from the mean; true positions this close together determine no scale
UNITS = {"nanoseconds": 1e9, "microseconds": 1e6, "milliseconds": 1e3}  # of time stamps, per second
ACROSS_A_HOLE = 1.5  # a step longer than this many usual steps between compared poses crosses a hole


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an estimated path at its own times, where `true_poses_at` knows the truth.

    ATE: distance of positions after Umeyama alignment of all poses, with rotation and translation (SE(3)) or
    also scale (Sim(3)). RPE: error of the motion between consecutive poses of the unscaled path; pairs with a
    hole of the truth between them are left out.
    """

    timestamps: np.ndarray  # [P] s, the poses compared
    indices: np.ndarray  # [P] indices of the compared poses in the estimate
    T_truth_estimate: np.ndarray  # [4, 4] SE(3) alignment
    aligned_positions: np.ndarray  # [P, 3] m, estimate in the truth's frame, SE(3)
    true_positions: np.ndarray  # [P, 3] m
    errors_cm: np.ndarray  # [P] SE(3)
    errors_sim3_cm: np.ndarray  # [P]
    motion_errors_cm: np.ndarray  # [P - 1 or fewer] RPE, translation
    motion_errors_deg: np.ndarray  # [P - 1 or fewer] RPE, rotation angle
    scale: float  # by which Sim(3) alignment multiplies the estimate
    num_estimated: int  # poses of the estimate, compared or not

    @property
    def num_poses(self) -> int:
        return len(self.timestamps)

    @property
    def coverage(self) -> float:
        """Share of the estimate's poses that were compared."""
        return self.num_poses / self.num_estimated

    @property
    def ate_rmse_cm(self) -> float:
        return _rms(self.errors_cm)

    @property
    def ate_mean_cm(self) -> float:
        return float(self.errors_cm.mean())

    @property
    def ate_median_cm(self) -> float:
        return float(np.median(self.errors_cm))

    @property
    def ate_max_cm(self) -> float:
        return float(self.errors_cm.max())

    @property
    def ate_rmse_sim3_cm(self) -> float:
        return _rms(self.errors_sim3_cm)

    @property
    def rpe_trans_cm(self) -> float:
        """Rmse between consecutive poses."""
        return _rms(self.motion_errors_cm)

    @property
    def rpe_rot_deg(self) -> float:
        """Rmse between consecutive poses."""
        return _rms(self.motion_errors_deg)


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compare an estimate with the truth, at the poses whose times the truth covers.

    Raises `DataError` if there are fewer than three such poses, or positions are not in metres.
    """
    from evo.core.metrics import APE, RPE, PoseRelation
    from evo.core.trajectory import PosePath3D

    _check_positions(estimate, truth)
    poses, common = true_poses_at(truth, estimate.timestamps)
    if common.sum() < FEWEST_POSES:
        raise DataError(_too_few(estimate, truth, int(common.sum())))
    timestamps = estimate.timestamps[common]
    estimated = np.array([orthonormalized(T) for T in estimate.poses[common]])
    true = poses[common]
    reference = PosePath3D(poses_se3=list(true))
    aligned, errors, rigid = [], [], np.eye(4)
    for with_scale in (False, True):
        R, t, scale = align(estimated, true, with_scale)
        if not with_scale:
            rigid[:3, :3], rigid[:3, 3] = R, t
        moved = np.tile(np.eye(4), (len(estimated), 1, 1))
        moved[:, :3, :3] = R @ estimated[:, :3, :3]
        moved[:, :3, 3] = scale * estimated[:, :3, 3] @ R.T + t
        ape = APE(PoseRelation.translation_part)
        ape.process_data((reference, PosePath3D(poses_se3=list(moved))))
        aligned.append(moved[:, :3, 3])
        errors.append(100 * np.asarray(ape.error))
    motion = {}
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        rpe = RPE(relation)  # over one frame
        rpe.process_data((reference, PosePath3D(poses_se3=list(estimated))))
        motion[relation] = np.asarray(rpe.error)
    indices = np.flatnonzero(common)
    steps = np.diff(indices)
    is_step = steps <= ACROSS_A_HOLE * np.median(steps)
    return TrajectoryErrors(
        timestamps=timestamps,
        indices=indices,
        T_truth_estimate=rigid,
        aligned_positions=aligned[0],
        true_positions=true[:, :3, 3],
        errors_cm=errors[0],
        errors_sim3_cm=errors[1],
        motion_errors_cm=100 * motion[PoseRelation.translation_part][is_step],
        motion_errors_deg=motion[PoseRelation.rotation_angle_deg][is_step],
        scale=scale,
        num_estimated=len(estimate),
    )


def ate_rmse_cm(estimate: Trajectory, truth: Trajectory, with_scale: bool = False) -> float | None:
    """Return the ATE of `TrajectoryErrors` alone, 20 times as fast; None below three common poses."""
    poses, common = true_poses_at(truth, estimate.timestamps)
    if common.sum() < FEWEST_POSES:
        return None
    estimated, true = estimate.poses[common], poses[common]
    R, t, scale = align(estimated, true, with_scale)
    distances = np.linalg.norm(scale * estimated[:, :3, 3] @ R.T + t - true[:, :3, 3], axis=1)
    return 100 * _rms(distances)


def align(
    estimated: np.ndarray,  # [P, 4, 4]
    true: np.ndarray,  # [P, 4, 4]
    with_scale: bool = False,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return R [3, 3], t [3], s that bring the estimated positions closest to the true ones: s R p + t.

    Umeyama 1991, computed by evo. Positions on a line (a slider) or at one point do not determine R, and evo
    refuses them. Then, among the rotations that fit the positions equally well, the one that best fits the
    orientations is returned. Without translation in the truth (a turn on the spot), s is 1.
    """
    from evo.core.geometry import GeometryException, umeyama_alignment

    p, q = estimated[:, :3, 3], true[:, :3, 3]
    if np.linalg.norm(q - q.mean(0), axis=1).max() < NO_TRANSLATION:
        with_scale = False
    try:
        R, t, scale = umeyama_alignment(p.T, q.T, with_scale)
        if np.isfinite(scale):
            return R, t, float(scale)
    except GeometryException:
        pass
    centred_p, centred_q = p - p.mean(0), q - q.mean(0)
    covariance = centred_q.T @ centred_p
    orientations = np.einsum("nij,nkj->ik", true[:, :3, :3], estimated[:, :3, :3])
    tie_break = 1e-6 * (np.linalg.norm(covariance) + 1e-12) / len(p)
    U, _, Vt = np.linalg.svd(covariance + tie_break * orientations)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    spread = float((centred_p**2).sum())
    scale = float((R * covariance).sum()) / spread if with_scale and spread > 1e-12 else 1.0
    return R, q.mean(0) - scale * R @ p.mean(0), scale


def align_views(
    estimated: np.ndarray,  # [P, 4, 4]
    true: np.ndarray,  # [P, 4, 4]
    distance: float = 1.0,  # metres to what the cameras see
) -> np.ndarray:  # [4, 4]
    """Return the rigid motion from the estimate's frame to the truth's under which the cameras' views agree.

    If the path is short, positions alone determine the rotation poorly: 1 mm over 10 cm is half a degree, two
    pixels. Therefore the points `distance` metres along the axes of every camera are aligned, too: Procrustes
    with the orientations added to the covariance of the positions.
    """
    p, q = estimated[:, :3, 3], true[:, :3, 3]
    covariance = (q - q.mean(0)).T @ (p - p.mean(0))
    covariance += distance**2 * np.einsum("nij,nkj->ik", true[:, :3, :3], estimated[:, :3, :3])
    U, _, Vt = np.linalg.svd(covariance)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = q.mean(0) - T[:3, :3] @ p.mean(0)
    return T


def statistics(errors: np.ndarray) -> dict[str, float]:
    """Return the seven numbers that evo prints, in its order."""
    return {
        "max": float(errors.max()),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "min": float(errors.min()),
        "rmse": _rms(errors),
        "sse": float((errors**2).sum()),
        "std": float(errors.std()),
    }


def _check_positions(estimate: Trajectory, truth: Trajectory) -> None:
    """Refuse positions that are not in metres; a few such poses of the truth are left out instead."""
    for name, path, allowed in (("estimate", estimate, 0.0), ("truth", truth, 0.5)):
        far = ~(np.abs(path.poses[:, :3, 3]) <= FARTHEST).all(1)
        if far.sum() > allowed * len(path):
            k = int(far.argmax())
            x, y, z = path.poses[k, :3, 3]
            raise DataError(
                f"trajectory: {name}: expected positions in metres, got {x:.6g}, {y:.6g}, {z:.6g} at "
                f"{path.timestamps[k]:.9g} s (pose {k + 1}, and {int(far.sum()) - 1} more such poses)"
            )


def _too_few(estimate: Trajectory, truth: Trajectory, num_common: int) -> str:
    """Return a message that says why two paths cannot be compared."""
    times, stamps = estimate.timestamps, truth.timestamps
    line = (
        f"trajectory: expected at least {FEWEST_POSES} poses at times that the truth covers, got "
        f"{num_common} of {len(estimate)} ({_span(times)}; truth {_span(stamps)}); are both in seconds, on "
        "one clock?"
    )
    if len(times) < 2 or len(stamps) < 2:
        return line
    for unit, factor in UNITS.items():
        for name, odd, other in (("truth", stamps, times), ("estimate", times, stamps)):
            ratio = np.ptp(odd) / factor / np.ptp(other)
            meets = odd[0] / factor <= other[-1] and odd[-1] / factor >= other[0]
            if 0.1 < ratio < 30 and (meets or 0.7 < ratio < 1.5):
                return f"{line} The {name} looks as if it were in {unit}"
    if stamps[0] > times[-1] or times[0] > stamps[-1]:
        return f"{line} They begin {abs(stamps[0] - times[0]):.9g} s apart"
    inside = int(((stamps >= times[0]) & (stamps <= times[-1])).sum())
    step = true_path(truth).median_step
    return f"{line} The truth has {inside} poses in that time (one in {step:.3g} s)"


def _span(times: np.ndarray) -> str:
    return f"{times[0]:.9g} to {times[-1]:.9g} s" if len(times) else "empty"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


# Slices of EventReplica's scenes on which IncEventGS evaluates, as (first, end) of every second written pose
# (configs/SimuEvent/replica_*.yaml of WU-CVGL/IncEventGS at 28d070f).
INCEVENTGS_SLICES = {
    "office0": (10, 60),
    "office2": (350, 400),
    "office3": (100, 150),
    "room0": (90, 140),
    "room2": (20, 70),
}


def inceventgs_slice(
    scene: str, truth: Trajectory, estimate: Trajectory
) -> tuple[float, float] | None:  # seconds
    """Return IncEventGS's slice of an EventReplica scene; None: the estimate does not cover it."""
    first, end = (2 * k for k in INCEVENTGS_SLICES.get(scene, (0, 0)))
    if end == 0 or end >= len(truth):
        return None
    start, stop = float(truth.timestamps[first]), float(truth.timestamps[end])
    tolerance = 0.1  # seconds; the first sample is a little later than the first event
    covered = estimate.timestamps[0] <= start + tolerance and estimate.timestamps[-1] >= stop - tolerance
    return (start, stop) if covered else None
