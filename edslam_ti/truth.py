"""Where a true path is known: at its stamps, and between them where interpolation is accurate enough.

A true path has gaps (markers hidden, a logger that stalls) and sometimes an impossible pose. Between two
stamps, h apart, the error of Eq. 9 at a fraction u of the way is at most a u (1 - u) h^2 / 2, with a the
acceleration. To estimate a h^2 / 8 inside a gap, artificial gaps ("holes") of the same length are tried where
the path is known: at many places near the real one and over the whole path.
"""

import itertools
import weakref

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.trajectory import Trajectory

AT_A_STAMP = 1e-6  # s: stamps are microseconds in most files
OWN_RATE = 1.5  # median steps: longer steps are holes
LONGEST_STEP = 0.5  # s: motion of hands and vehicles cannot be interpolated over longer steps
POSSIBLE_ERROR = 2e-4  # m; accepted poses are usually wrong by half of it: a tenth of an ATE of 0.1 cm
POSSIBLE_TURN = np.radians(0.05)
TRIED_BESIDE, TRIED_IN_ALL = 16, 512  # number of tried holes for one hole, on each side and over the path
CONSIDERED = 3.0  # lengths of the hole: up to this distance holes are tried on each side
NEARLY_ALL = 90  # percentile of the errors of nearby tried holes: one in ten may be noise
USUAL = 75  # percentile of the errors over the whole path: motion may start or change inside a hole

FARTHEST = 1e7  # m from the origin: map coordinates (UTM) end there
SMALLEST_JUMP, SMALLEST_FLIP = (
    0.02,
    np.radians(10.0),
)  # m, rad: smaller steps are never jumps
HARDEST_PUSH, HARDEST_TWIST = 100.0, 2000.0  # m/s^2, rad/s^2: cameras on robots and in hands stay below
UNUSUAL = 30.0  # times the usual change of motion between stamps
FASTER = 10.0  # times the usual speed


def true_poses_at(truth: Trajectory, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the true poses [N, 4, 4] at times [N] (s), NaN where unknown, and whether they are known [N].

    A pose is known at a stamp of the truth, and between two where `TruePath` says so.
    """
    return true_path(truth).poses_at(times)


def true_path(truth: Trajectory) -> "TruePath":
    """Return the `TruePath` of a truth; it is cached until the number of poses changes."""
    kept = _KEPT.get(truth)
    if kept is None or kept[0] != len(truth):
        kept = _KEPT[truth] = (len(truth), TruePath(truth))
    return kept[1]


_KEPT: "weakref.WeakKeyDictionary[Trajectory, tuple[int, TruePath]]" = weakref.WeakKeyDictionary()


class TruePath:
    """A true path without impossible poses, and the times between its stamps at which it is known.

    It is known between stamps at most 1.5 median steps apart: its own rate is assumed to suffice. In a longer
    step it is known where interpolation is wrong by at most `POSSIBLE_ERROR` and `POSSIBLE_TURN`, estimated
    from holes of that length tried nearby. It is unknown in steps of more than 0.5 s.
    """

    def __init__(self, truth: Trajectory) -> None:
        is_jump = impossible_poses(truth)
        stamps, poses = truth.timestamps, truth.poses
        self.jumps = stamps[is_jump]  # [J] s, stamps with impossible poses
        self.jump_lengths = _jump_lengths(poses[:, :3, 3], is_jump)  # [J] m
        self.path = Trajectory(stamps[~is_jump], poses[~is_jump]) if is_jump.any() else truth
        self.stamps = self.path.timestamps  # [T] s
        self.steps = np.diff(self.stamps)  # [T - 1] s
        self.median_step = float(np.median(self.steps)) if len(self.steps) else 0.0
        # Stamps since the epoch are rounded: equal steps differ by microseconds.
        self.own_rate = min(OWN_RATE * self.median_step, LONGEST_STEP) + AT_A_STAMP
        self._positions = self.path.poses[:, :3, 3]
        self._quaternions = _continuous_quaternions(self.path.poses)
        self._errors: dict[int, tuple[float, float]] = {}  # m and rad in the middle of a hole, by its step

    def poses_at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses [N, 4, 4] at times [N], NaN where unknown, and whether they are known [N]."""
        times = np.asarray(times, np.float64)
        is_known = self.is_known(times)
        poses = np.full((len(times), 4, 4), np.nan)
        if is_known.any():
            poses[is_known] = self.path.resampled(times[is_known]).poses
        return poses, is_known

    def pose_at(self, time: float) -> np.ndarray | None:  # [4, 4]
        """Return the pose at one time; None: unknown."""
        return self.path.at(time) if self.is_known(np.array([time]))[0] else None

    def likely_pose_at(self, time: float) -> np.ndarray:  # [4, 4]
        """Return a pose even inside a hole: interpolated across it, or the first or last pose."""
        return self.path.at(float(np.clip(time, *self.stamps[[0, -1]])))

    def is_known(self, times: np.ndarray) -> np.ndarray:  # [N] s -> [N] bool
        """Return whether the pose is known at each time."""
        stamps, steps = self.stamps, self.steps
        if len(stamps) == 0 or len(times) == 0:
            return np.zeros(len(times), bool)
        if len(stamps) == 1:
            at_it: np.ndarray = np.abs(times - stamps[0]) < AT_A_STAMP
            return at_it
        k = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(steps) - 1)
        known = np.minimum(np.abs(times - stamps[k]), np.abs(times - stamps[k + 1])) < AT_A_STAMP
        inside = (times >= stamps[0]) & (times <= stamps[-1])
        known |= inside & (steps[k] <= self.own_rate)
        for n in np.flatnonzero(inside & ~known & (steps[k] <= LONGEST_STEP)):
            u = (times[n] - stamps[k[n]]) / steps[k[n]]
            metres, radians = self._error_in(int(k[n]))
            known[n] = 4 * u * (1 - u) * max(metres / POSSIBLE_ERROR, radians / POSSIBLE_TURN) <= 1
        return known

    def error_at_own_rate(self) -> float:  # m
        """Return the usual error of the interpolated position midway between two stamps.

        In a hole of two steps the error in the middle is four times as large, and the stamp there shows it.
        """
        metres, _ = self._errors_of_holes(self._spread(2 * self.median_step), 2 * self.median_step)
        return float(np.median(metres)) / 4 if len(metres) else float("nan")

    def holes(self, start: float, end: float) -> list[tuple[float, float]]:  # s
        """Return the holes (start, end) between `start` and `end`, where the path is unknown."""
        stamps = self.stamps[(self.stamps > start) & (self.stamps < end)]
        bounds = np.concatenate([[start], stamps, [end]])
        found = [(float(a), float(b)) for a, b in itertools.pairwise(bounds) if b - a > self.own_rate]
        return [(a, b) for a, b in found if not self.is_known(np.array([(a + b) / 2]))[0]]

    # --- holes that are tried ---

    def _error_in(self, step: int) -> tuple[float, float]:
        """Return the error (m, rad) that interpolation may have in the middle of a step."""
        if step not in self._errors:
            self._errors[step] = self._tried(step)
        return self._errors[step]

    def _tried(self, step: int) -> tuple[float, float]:
        start, length = self.stamps[step], self.steps[step]
        offsets = length * np.linspace(0.5, CONSIDERED, TRIED_BESIDE)
        beside = self._errors_of_holes(np.concatenate([start - offsets, start + length + offsets]), length)
        if len(beside[0]) == 0:
            return np.inf, np.inf  # the path is nowhere known around it
        usual = self._errors_of_holes(self._spread(length), length)
        metres, radians = (
            float(max(np.percentile(near, NEARLY_ALL), np.percentile(far, USUAL) if len(far) else 0))
            for near, far in zip(beside, usual)
        )
        return metres, radians

    def _spread(self, length: float) -> np.ndarray:  # s
        """Return evenly spaced stamps of the path, at which holes of a length can be tried."""
        chosen = np.linspace(0, len(self.stamps) - 1, min(len(self.stamps), TRIED_IN_ALL)).round()
        times: np.ndarray = self.stamps[chosen.astype(int)]
        return times[(times >= self.stamps[0] + length / 2) & (times <= self.stamps[-1] - length / 2)]

    def _errors_of_holes(self, middles: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors (m, rad) in the middle of holes of a length, for the middles that can be tried.

        A hole can be tried if the path is known at its own rate at both ends and in the middle.
        """
        around = middles + length * np.array([[-0.5], [0.0], [0.5]])  # [3, N]
        k = np.clip(np.searchsorted(self.stamps, around - AT_A_STAMP, side="right") - 1, 0, None)
        k = np.minimum(k, len(self.steps) - 1)
        inside = (around >= self.stamps[0] - AT_A_STAMP) & (around <= self.stamps[-1] + AT_A_STAMP)
        at_a_stamp = (
            np.minimum(np.abs(around - self.stamps[k]), np.abs(around - self.stamps[k + 1])) < 2 * AT_A_STAMP
        )
        around = around[:, ((inside & (self.steps[k] <= self.own_rate)) | at_a_stamp).all(0)]
        before, middle, after = self._interpolated(self._positions, around)
        metres = np.linalg.norm((before + after) / 2 - middle, axis=1)
        before, middle, after = self._interpolated(self._quaternions, around)
        radians = 2 * np.linalg.norm(_unit(before + after) - _unit(middle), axis=1)
        return metres, radians

    def _interpolated(
        self, values: np.ndarray, times: np.ndarray
    ) -> np.ndarray:  # [T, C], [3, N] -> [3, N, C]
        return np.stack([np.interp(times, self.stamps, column) for column in values.T], -1)


# --- impossible poses ---


@np.errstate(over="ignore")  # whatever a file holds
def impossible_poses(truth: Trajectory) -> np.ndarray:  # [T] bool
    """Return which poses of a truth are impossible: far from where the poses before and after them lead.

    Steps that no motion explains cut the path into pieces. Starting at the longest piece, forwards and
    backwards, a piece belongs to the path if the camera can get there from the last piece that does.
    """
    stamps, positions = truth.timestamps, truth.poses[:, :3, 3]
    far = ~(np.abs(positions) <= FARTHEST).all(1)
    left = np.flatnonzero(~far)
    if len(left) < 4:
        return far
    times, positions, rotations = stamps[left], positions[left], truth.poses[left, :3, :3]
    steps = np.diff(times)
    moved = np.diff(positions, axis=0)
    turned = _turns(rotations[:-1], rotations[1:])
    limits = (
        _Limit(moved, steps, SMALLEST_JUMP, HARDEST_PUSH),
        _Limit(turned, steps, SMALLEST_FLIP, HARDEST_TWIST),
    )
    cuts = np.flatnonzero(limits[0].is_passed | limits[1].is_passed) + 1
    if len(cuts) == 0:
        return far
    pieces = np.split(np.arange(len(left)), cuts)
    longest = max(range(len(pieces)), key=lambda n: len(pieces[n]))

    def can_come(before: np.ndarray, after: np.ndarray) -> bool:  # indices of poses of two pieces
        i, j = before[-1], after[0]
        gap = times[j] - times[i]
        ways = (positions[j] - positions[i], _turns(rotations[i][None], rotations[j][None])[0])
        inside = [int(pair[0]) for pair in (before[-2:], after[:2]) if len(pair) > 1 and np.ptp(pair) == 1]
        for way, steps_of, limit in zip(ways, (moved, turned), limits):
            surprises = [np.linalg.norm(way - steps_of[k] / steps[k] * gap) for k in inside]
            if min(surprises, default=np.linalg.norm(way)) > limit.at(gap):
                return False
        return True

    kept = pieces[longest]
    for piece in pieces[longest + 1 :]:
        if can_come(kept, piece):
            kept = np.concatenate([kept, piece])
    for piece in reversed(pieces[:longest]):
        if can_come(piece, kept):
            kept = np.concatenate([piece, kept])
    is_jump = np.ones(len(stamps), bool)
    is_jump[left[kept]] = False
    return is_jump


class _Limit:
    """The largest difference between successive steps that motion can explain, as a function of time."""

    def __init__(
        self,
        moved: np.ndarray,  # [S, 3] m or rad
        steps: np.ndarray,  # [S] s
        smallest: float,  # m or rad
        hardest: float,  # m/s^2 or rad/s^2
    ) -> None:
        surprise, length = _surprise(moved, steps), np.linalg.norm(moved, axis=1)
        # A pose elsewhere makes up to three steps unusual: they must not define what is usual.
        usually = max(0.0, min(NEARLY_ALL, 100 * (1 - 3 / len(steps))))
        usual = UNUSUAL * float(np.percentile(surprise / steps**2, usually))
        self._smallest, self._acceleration = smallest, max(hardest, 2 * usual)
        fastest = FASTER * float(np.percentile(length / steps, usually))
        # Two successive turns by 180 degrees do not differ, but are too fast.
        self.is_passed = (surprise > self.at(steps)) | (length > fastest * steps + self.at(steps))  # [S] bool

    def at(self, step: np.ndarray | float) -> np.ndarray:
        """Return the limit for steps in seconds."""
        return np.maximum(self._smallest, self._acceleration / 2 * np.square(step))


def _turns(before: np.ndarray, after: np.ndarray) -> np.ndarray:  # [S, 3, 3] each -> [S, 3] rad
    return np.asarray(Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec())


def _surprise(moved: np.ndarray, steps: np.ndarray) -> np.ndarray:  # [S, 3], [S] -> [S]
    """Return how far each motion is from that of the step before or after, whichever is nearer."""
    velocity = moved / steps[:, None]
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)  # [S - 1]
    edge = np.array([np.inf])
    surprise: np.ndarray = steps * np.minimum(np.r_[edge, change], np.r_[change, edge])
    return surprise


def _jump_lengths(positions: np.ndarray, is_jump: np.ndarray) -> np.ndarray:  # [T, 3], [T] -> [J] m
    """Return the distance of impossible poses from the last possible pose before them (else the first)."""
    kept = np.flatnonzero(~is_jump)
    if len(kept) == 0:
        return np.full(int(is_jump.sum()), np.inf)
    before = kept[np.clip(np.searchsorted(kept, np.flatnonzero(is_jump)) - 1, 0, None)]
    moved = positions[is_jump] - positions[before]
    largest = np.maximum(np.abs(moved).max(1, initial=0), 1e-12)  # squares of 1e200 are infinite
    with np.errstate(invalid="ignore"):
        lengths = largest * np.linalg.norm(moved / largest[:, None], axis=1)
    return np.where(np.isfinite(lengths), lengths, np.inf)


def _continuous_quaternions(poses: np.ndarray) -> np.ndarray:  # [T, 4, 4] -> [T, 4]
    if len(poses) == 0:
        return np.empty((0, 4))
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    signs = np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)
    return np.asarray(q * np.r_[1.0, np.cumprod(signs)][:, None])


def _unit(q: np.ndarray) -> np.ndarray:  # [N, 4]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
