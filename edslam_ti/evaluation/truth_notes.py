"""Checks a truth against an estimate, and writes one line for each likely fault of the truth.

It corrects nothing: a line names a possible cause of an error, and the error that would remain without it.
"""

from collections.abc import Sequence

import numpy as np

from edslam_ti.evaluation.conventions import apart, ate_cm, better_reading, rpe_cm_and_deg
from edslam_ti.evaluation.trajectories import TrajectoryErrors
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import TruePath, true_path

FEW_POSES = 10  # a note is made below this number of compared poses; alignment alone fits six numbers to them
MOST_POSES = 400  # evenly spaced poses that are checked; a fault concerns all of them
FULL_COVERAGE = 0.95  # share of frames: the last ones may come after the truth's end

SCALE_DIFFERS = 0.005  # smallest difference of scale, besides three times its uncertainty
SMALL_RESIDUAL = 0.2  # of the true path's extent; above, a scale only hides an estimate that is wrong
CLEARLY_BETTER = 0.5  # a cause explains an error if at most this share of it remains
HIGH_RPE = 5.0  # times the ATE; errors of positions alone give at most 2
SMALL_ATE, SMALL_RPE = 1e-3, 0.05  # cm: below these their ratio means nothing
SMALL_ERROR = 0.01  # cm; a smaller interpolation error of the truth never matters
APART = 0.05  # orientations are wrong if views differ by this share of the distance to the visible surfaces
LONGEST_SHIFT = 0.25  # s; shifts between two clocks are searched up to this
SHORTEST_SHIFT = 0.002  # s
NUM_SHIFTS = 101


def truth_notes(
    estimate: Trajectory,
    truth: Trajectory,
    errors: TrajectoryErrors,
    time_offset: float = 0.0,
    lost: Sequence[int] = (),
) -> list[str]:
    """Return one line for each likely fault of a truth; times are printed `time_offset` seconds later.

    `errors` is the result of `trajectory_errors` for the two. Clocks are judged without the `lost` poses of
    the estimate, which say nothing about the truth.
    """
    path = true_path(truth)
    notes = [*_jumps(path, time_offset), *_holes(estimate, errors, path, time_offset)]
    notes += [*_few(errors), *_slow(errors, path)]
    if errors.num_poses < FEW_POSES:
        return notes
    scaling = _scaling(errors)
    orientations = _orientations(estimate, errors, path, bool(scaling))
    if not any("inverted" in line for line in orientations):
        notes += [*scaling, *_shifted(estimate, errors, path, bool(scaling), lost)]
    return notes + orientations


# --- coverage ---


def _jumps(path: TruePath, time_offset: float) -> list[str]:
    if len(path.jumps) == 0:
        return []
    count = len(path.jumps)
    what = "1 pose jumps" if count == 1 else f"{count} poses jump"
    return [
        f"truth: {what} away from the rest of its path (the first at {path.jumps[0] + time_offset:.3f} s, by "
        f"{path.jump_lengths[0]:.3g} m) and {'is' if count == 1 else 'are'} left out"
    ]


def _holes(estimate: Trajectory, errors: TrajectoryErrors, path: TruePath, time_offset: float) -> list[str]:
    start, end = (float(t) for t in estimate.timestamps[[0, -1]])
    holes = path.holes(start, end)
    inside = [(a, b) for a, b in holes if a > path.stamps[0] - 1e-9 and b < path.stamps[-1] + 1e-9]
    if errors.coverage == 1 or not holes or (errors.coverage > FULL_COVERAGE and not inside):
        return []
    a, b = max(holes, key=lambda hole: hole[1] - hole[0])
    missing = sum(b - a for a, b in holes)
    return [
        f"truth is missing for {missing:.3g} of {end - start:.3g} s (longest from {a + time_offset:.3f} to "
        f"{b + time_offset:.3f} s): {errors.num_poses} of {errors.num_estimated} poses are compared"
    ]


def _few(errors: TrajectoryErrors) -> list[str]:
    if errors.num_poses >= FEW_POSES:
        return []
    return [
        f"only {errors.num_poses} of {errors.num_estimated} poses are compared with the truth: too few "
        "for reliable errors"
    ]


def _slow(errors: TrajectoryErrors, path: TruePath) -> list[str]:
    """Return a line if the truth's stamps are too sparse for errors this small."""
    times = errors.timestamps
    k = np.clip(np.searchsorted(path.stamps, times), 1, len(path.stamps) - 1)
    from_stamp = np.minimum(np.abs(times - path.stamps[k - 1]), np.abs(times - path.stamps[k]))
    between = float((from_stamp > 0.1 * path.median_step).mean())
    own = 100 * path.error_at_own_rate()  # cm
    if not (between > 0.2 and own > max(0.3 * errors.ate_rmse_cm, SMALL_ERROR)):
        return []
    return [
        f"truth comes every {1000 * path.median_step:.3g} ms: half way between, its interpolation is off by "
        f"about {own:.2g} cm, which is not small compared with the ATE of {errors.ate_rmse_cm:.2g} cm"
    ]


# --- causes of errors ---


def _scaling(errors: TrajectoryErrors) -> list[str]:
    """Return a line if a scale that certainly differs from 1 explains most of the error."""
    spread = 100 * _spread_m(errors)
    rigid, scaled = errors.ate_rmse_cm, errors.ate_rmse_sim3_cm
    if errors.scale <= 0 or spread == 0 or scaled > SMALL_RESIDUAL * spread:
        return []
    uncertain = max(3 * scaled / spread, SCALE_DIFFERS)
    if abs(np.log(errors.scale)) < uncertain or scaled > CLEARLY_BETTER * rigid:
        return []
    size = 1 / errors.scale
    return [
        f"a scale of {errors.scale:.4g} explains it (the estimate is {size:.4g} times as large as the "
        f"truth): ATE {rigid:.3g} cm, with scale {scaled:.2g} cm: check depth_scale, and the truth's unit"
    ]


def _shifted(
    estimate: Trajectory, errors: TrajectoryErrors, path: TruePath, with_scale: bool, lost: Sequence[int]
) -> list[str]:
    """Return a line if the truth with all times shifted equally fits much better."""
    known = ~np.isin(errors.indices, lost)
    if known.sum() < FEW_POSES:
        return []
    few = slice(None, None, -(-int(known.sum()) // MOST_POSES))
    times, estimated = errors.timestamps[known][few], estimate.poses[errors.indices[known][few]]
    span = float(np.ptp(times))
    longest = min(LONGEST_SHIFT, span / 4)
    shifts = np.linspace(-longest, longest, NUM_SHIFTS)
    usable = np.all([path.is_known(times + s) for s in (*shifts[::10], 0.0)], axis=0)
    if usable.sum() < FEW_POSES // 2:
        return []
    times, estimated = times[usable], estimated[usable]
    stamps, positions = path.stamps, path.path.poses[:, :3, 3]

    def error_cm(shift: float) -> float:
        true = np.tile(np.eye(4), (len(times), 1, 1))
        true[:, :3, 3] = np.stack([np.interp(times + shift, stamps, x) for x in positions.T], -1)
        return ate_cm(estimated, true, with_scale)

    values = np.array([error_cm(float(s)) for s in shifts])
    best = int(values.argmin())
    if not 0 < best < len(shifts) - 1:
        return []
    before, least, after = values[best - 1 : best + 2] ** 2
    curvature = before - 2 * least + after
    shift = float(shifts[best])
    if curvature > 0:
        shift += float(0.5 * (before - after) / curvature * (shifts[1] - shifts[0]))
    as_it_is, shifted = error_cm(0.0), min(error_cm(shift), float(values[best]))
    clear = max(0.02, 200 * path.error_at_own_rate())  # cm
    if abs(shift) < SHORTEST_SHIFT or shifted > CLEARLY_BETTER * as_it_is or as_it_is - shifted < clear:
        return []
    return [
        f"truth looks {1000 * abs(shift):.0f} ms {'late' if shift > 0 else 'early'}: with this shift ATE is "
        f"{shifted:.2g} instead of {as_it_is:.2g} cm: check the clocks"
    ]


# --- orientations ---


def _orientations(
    estimate: Trajectory, errors: TrajectoryErrors, path: TruePath, with_scale: bool
) -> list[str]:
    """Return a line if orientations, or whole poses, fit much better under another convention."""
    estimated, true = estimate.poses[errors.indices], path.poses_at(errors.timestamps)[0]
    if with_scale:
        estimated[:, :3, 3] *= errors.scale
    size = max(1.0, _spread_m(errors))
    few = slice(None, None, -(-errors.num_poses // MOST_POSES))
    rpe, turn = errors.rpe_trans_cm, errors.rpe_rot_deg
    ratio = rpe / max(errors.ate_rmse_cm, SMALL_ATE)
    is_high = ratio > HIGH_RPE and rpe > SMALL_RPE
    if not (is_high or apart(estimated[few], true[few], size) > APART * size):
        return []
    start = "orientations look wrong"
    if is_high:
        start = f"RPE is {ratio:.0f} times the ATE ({rpe:.3g} cm, {turn:.2g} deg a frame): {start}"
    reading = better_reading(estimated[few], true[few], size)
    if reading is None:  # without a high RPE, the estimate may simply be wrong
        conventions = "wxyz for xyzw, OpenGL axes, or the body's frame instead of the camera's"
        return [f"{start} ({conventions})"] if is_high else []
    other = reading.read(true)
    cm, degrees = rpe_cm_and_deg(estimated, other)
    so_read = f"ATE {ate_cm(estimated, other):.2g} cm, RPE {cm:.2g} cm, {degrees:.2g} deg"
    if reading.is_inverted:
        start = f"ATE {errors.ate_rmse_cm:.3g} cm, RPE {rpe:.3g} cm, {turn:.2g} deg: poses look inverted"
    return [f"{start}: the truth's look like {reading.looks}; then {so_read}"]


def _spread_m(errors: TrajectoryErrors) -> float:
    """Return the rms distance of the true positions from their mean."""
    centred = errors.true_positions - errors.true_positions.mean(0)
    return float(np.sqrt((centred**2).sum(1).mean()))
