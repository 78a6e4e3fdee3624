"""Compares true poses with depth: convention, scale and clock, judged by reprojection.

Points of one depth image are moved into another by the true poses and compared with the depth there. Right
poses leave a few percent of the largest cost, and any other convention, scale or shift of the clock leaves
more. So a fault is named only where another reading of the same poses fits far better.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.camera import NEAREST, Camera
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.evaluation.conventions import READINGS, better_reading
from edslam_ti.geometry import inverse
from edslam_ti.inspection.findings import Finding
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_path

GAPS, PER_GAP, LONGEST_PAIR = (1, 2, 4, 8, 16), 9, 1.0  # images apart, pairs of each, s
POINTS = 1000  # of a depth image
LARGEST = 0.1  # of the depth; larger differences count as this much
LEAST_IN_VIEW, FEWEST = 0.2, 50  # share of the points, and number, that must land on depth
FEWEST_PAIRS = 4
NEARLY = 2.0  # times the cost of the tracked path, of poses that are right but read in another way
MIRRORED = "mirrored in"  # how names of mirrored depth begin
STATIC_SHARE, ALWAYS = 0.3, 0.05  # of the cost without motion, and a cost that is never held against poses
BETTER = 0.6  # another reading must leave less than this share of the cost
SURE = 4.0  # standard deviations
SCALES = np.exp(np.linspace(np.log(1e-4), np.log(1e4), 25))
SMALLEST_SCALE, SCALE_BETTER = 0.05, 0.92  # difference from 1 that is named, and the cost's share then
WIDE_SHIFTS, NARROW_SHIFTS = np.arange(-1.0, 1.001, 0.1), np.arange(-0.03, 0.0301, 0.01)  # s
SHARP = 1.05  # times the least cost, at shifts of 30 ms, if the cost says anything about clocks
TOLERANCE = 0.006  # s, of offsets between clocks

Poses = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # s [N] -> [N, 4, 4], known [N]


@dataclass(frozen=True)
class PoseCheck:
    """How true poses fit depth."""

    cost: float  # 0 to 1, of the poses as they are
    offset: float  # s, by which stamps of depth are late against those of the truth
    deviation: float  # s
    findings: tuple[Finding, ...]

    @property
    def is_good(self) -> bool:
        """Whether the poses fit, so that the offset means something."""
        return not self.findings


@dataclass(frozen=True)
class Reprojection:
    """Depth images in pairs, and what poses make of them."""

    camera: Camera
    stamps: np.ndarray  # [K] s
    pairs: list[tuple[int, int]]  # indices of stamps
    points: dict[int, np.ndarray]  # [P, 3] m, by index
    depths: dict[int, np.ndarray] = field(repr=False)  # [H, W] m, by index

    @staticmethod
    def of(sequence: EventDepthSequence, start: float, end: float) -> "Reprojection":
        """Return pairs of the depth images in a part of a recording."""
        stamps = sequence.depth_timestamps
        inside = np.flatnonzero((stamps >= start) & (stamps <= end))
        pairs: list[tuple[int, int]] = []
        for gap in GAPS:
            close = [
                (int(a), int(b))
                for a, b in zip(inside, inside[gap:])
                if stamps[b] - stamps[a] <= LONGEST_PAIR
            ]
            pairs += close[:: max(1, -(-len(close) // PER_GAP))]
        rng = np.random.default_rng(0)
        points, depths = {}, {}
        for k in sorted({k for pair in pairs for k in pair}):
            depth = sequence.depth_or_none(k)
            if depth is None or np.count_nonzero(depth) < FEWEST:
                continue
            v, u = np.nonzero(depth > 0)
            few = rng.choice(len(v), min(POINTS, len(v)), replace=False)
            v, u = v[few], u[few]
            depths[k] = depth
            points[k] = sequence.camera.back_project_pixels(u, v, depth[v, u].astype(np.float64))
        pairs = [(a, b) for a, b in pairs if a in points and b in points]
        return Reprojection(sequence.camera, stamps, pairs, points, depths)

    def costs(self, poses: Poses, scale: float = 1.0, shift: float = 0.0) -> np.ndarray:  # [pairs]
        """Return the mean cost of every pair, NaN where unknown; positions are divided by `scale`."""
        keys = np.array(sorted(self.points))
        T, known = poses(self.stamps[keys] + shift)
        place = {int(k): i for i, k in enumerate(keys) if known[i]}
        result = np.full(len(self.pairs), np.nan)
        for n, (a, b) in enumerate(self.pairs):
            if a in place and b in place:
                X = inverse(T[place[b]]) @ T[place[a]]
                result[n] = self._cost(a, b, X[:3, :3], X[:3, 3] / scale)
        return result

    def _cost(self, a: int, b: int, R: np.ndarray, t: np.ndarray) -> float:
        u, v, z = self.camera.project(self.points[a] @ R.T + t, NEAREST)
        with np.errstate(invalid="ignore"):
            seen = (z > NEAREST) & (u > -0.5) & (u < self.camera.width - 0.5)
            seen &= (v > -0.5) & (v < self.camera.height - 0.5)
        if seen.mean() < LEAST_IN_VIEW:
            return 1.0
        there = self.depths[b][np.rint(v[seen]).astype(int), np.rint(u[seen]).astype(int)]
        z, there = z[seen][there > 0], there[there > 0]
        if len(z) < FEWEST:
            return float("nan")
        return float(np.minimum(np.abs(z - there) / z, LARGEST).mean() / LARGEST)


def check_poses(sequence: EventDepthSequence, start: float, end: float) -> PoseCheck | None:
    """Return how the true poses fit depth; None: too few of either."""
    if sequence.truth is None:
        return None
    seen = Reprojection.of(sequence, start, end)
    poses = true_path(sequence.truth).poses_at
    own = seen.costs(poses)
    if np.isfinite(own).sum() < FEWEST_PAIRS:
        return None
    cost = float(np.nanmean(own))
    offset, deviation = _offset(seen, poses)
    finding = _better(seen, poses, own)
    return PoseCheck(cost, offset, deviation, () if finding is None else (finding,))


def fits_better(
    sequence: EventDepthSequence, tracked: Trajectory, check: PoseCheck, start: float, end: float
) -> list[Finding]:
    """Return a line if a tracked path fits depth far better than the truth does, on whichever clock.

    The tracked path also shows other axes than those that `check` has tried.
    """
    assert sequence.truth is not None
    seen, path = Reprojection.of(sequence, start, end), true_path(sequence.truth)
    own = seen.costs(path.poses_at, shift=-check.offset)
    by_tracking = seen.costs(true_path(tracked).poses_at)
    if np.isfinite(own).sum() < FEWEST_PAIRS or not _is_better(by_tracking, own):
        return []
    true, known = path.poses_at(tracked.timestamps - check.offset)
    distance = float(np.median(np.concatenate([p[:, 2] for p in seen.points.values()])))
    reading = better_reading(tracked.poses[known], true[known], max(1.0, distance))
    if reading is not None:
        so_read = seen.costs(_reading(path.poses_at, reading.read), shift=-check.offset)
        if np.nanmean(so_read) < NEARLY * np.nanmean(by_tracking) + ALWAYS:
            return [_convention(reading.looks, own, so_read)]
    return [
        Finding(
            "truth_elsewhere",
            f"the truth does not fit depth (reprojection off by {_percent(own)}, with the tracked path by "
            f"{_percent(by_tracking)}), in no usual convention: is it of this recording, of this camera, and "
            "on this clock?",
        )
    ]


# --- other readings ---


def _better(seen: Reprojection, poses: Poses, own: np.ndarray) -> Finding | None:
    """Return what other reading of the poses fits far better; None: none does."""
    scale, scaled = _best_scale(seen, poses)
    readings = {r.looks: seen.costs(_reading(poses, r.read)) for r in READINGS}
    for k, axis in enumerate("xy"):
        readings[f"{MIRRORED} {axis}"] = seen.costs(_reading(poses, _reflected(k)))
    if not any(_is_better(costs, own) for costs in (scaled, *readings.values())):
        readings |= {looks: seen.costs(turned) for looks, turned in _turned(poses)}
    static = float(np.nanmean(seen.costs(_reading(poses, lambda T: np.tile(np.eye(4), (len(T), 1, 1))))))
    enough = (
        STATIC_SHARE * static + ALWAYS
    )  # any of many readings may fit a wrong path better, but not so well
    fitting = {
        looks: costs
        for looks, costs in readings.items()
        if _is_better(costs, own) and np.nanmean(costs) < enough
    }
    looks = min(fitting, key=lambda key: float(np.nanmean(fitting[key])), default="")
    is_scaled = abs(np.log(scale)) > SMALLEST_SCALE and _is_better(scaled, own, SCALE_BETTER)
    is_scaled = is_scaled and bool(np.nanmean(scaled) < enough)
    if is_scaled and (not looks or np.nanmean(scaled) < np.nanmean(fitting[looks])):
        return _scale_finding(scale, own, scaled)
    if not looks:
        return None
    if looks.startswith(MIRRORED):
        return Finding(
            "mirrored_depth",
            f"depth looks {looks} (reprojected with the true poses it is off by {_percent(own)}, so mirrored "
            f"by {_percent(fitting[looks])}): mirror the depth images; or the truth's axes are left-handed",
        )
    return _convention(looks, own, fitting[looks])


def _reflected(axis: int) -> Callable[[np.ndarray], np.ndarray]:
    M = np.eye(4)
    M[axis, axis] = -1
    return lambda T: M @ T @ M


def _convention(looks: str, own: np.ndarray, costs: np.ndarray) -> Finding:
    return Finding(
        "truth_convention",
        f"the truth's poses look like {looks}: depth reprojected with them is off by {_percent(own)}, read "
        f"so by {_percent(costs)}: convert them to camera-to-world, x right, y down, z forward",
    )


def _reading(poses: Poses, read: Callable[[np.ndarray], np.ndarray]) -> Poses:
    def result(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        T, known = poses(times)
        return read(np.where(known[:, None, None], T, np.eye(4))), known

    return result


def _turned(poses: Poses) -> Iterator[tuple[str, Poses]]:
    """Yield the poses of a body whose axes are the camera's in another order."""
    for R in Rotation.create_group("O").as_matrix()[1:]:
        axes = np.eye(4)
        axes[:3, :3] = np.rint(R)
        angle = np.degrees(Rotation.from_matrix(axes[:3, :3]).magnitude())
        looks = f"poses of another frame, turned by {angle:.0f} deg against the camera (the body's?)"
        yield looks, _reading(poses, _after(axes))


def _after(axes: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda T: np.asarray(T @ axes)


def _is_better(costs: np.ndarray, own: np.ndarray, share: float = BETTER) -> bool:
    """Return whether a reading leaves far less cost, for certain."""
    both = np.isfinite(costs) & np.isfinite(own)
    if both.sum() < FEWEST_PAIRS:
        return False
    difference = own[both] - costs[both]
    error = float(difference.std()) / np.sqrt(both.sum())
    is_clear = float(difference.mean()) > SURE * error
    return is_clear and float(costs[both].mean()) < share * float(own[both].mean())


# --- scale ---


def _best_scale(seen: Reprojection, poses: Poses) -> tuple[float, np.ndarray]:
    """Return the scale of the positions that fits best, and its costs."""
    means = np.array([np.nanmean(seen.costs(poses, float(s))) for s in SCALES])
    k = int(means.argmin())
    low, high = np.log(SCALES[max(k - 1, 0)]), np.log(SCALES[min(k + 1, len(SCALES) - 1)])
    for _ in range(4):  # each round leaves two fifths of the interval
        logs = np.linspace(low, high, 6)
        means = np.array([np.nanmean(seen.costs(poses, float(np.exp(s)))) for s in logs])
        k = int(np.clip(means.argmin(), 1, 4))
        low, high = logs[k - 1], logs[k + 1]
    scale = float(np.exp(0.5 * (low + high)))
    return scale, seen.costs(poses, scale)


def _scale_finding(scale: float, own: np.ndarray, costs: np.ndarray) -> Finding:
    guess = ""
    for factor, meaning in ((5.0, "1/5000 m and millimetres"), (1000.0, "metres and millimetres")):
        if abs(abs(np.log(scale)) - np.log(factor)) < 0.05:
            guess = f", as if {meaning} had been confused"
    depth = "small" if scale > 1 else "large"
    times = max(scale, 1 / scale)
    return Finding(
        "truth_scale",
        f"depth is {times:.3g} times too {depth} for the truth{guess} (reprojection off by {_percent(own)}, "
        f"with this scale by {_percent(costs)}): check depth_scale in camera.json, then the truth's unit",
    )


def _percent(costs: np.ndarray) -> str:
    return f"{100 * LARGEST * float(np.nanmean(costs)):.1f} %"


# --- clock ---


def _offset(seen: Reprojection, poses: Poses) -> tuple[float, float]:
    """Return by how much depth is late against the poses, and its standard deviation (s).

    The cost grows alike to both sides of its minimum, which a parabola through five shifts finds.
    """
    wide = np.array([_mean(seen.costs(poses, shift=float(s))) for s in WIDE_SHIFTS])
    centre = 0.0
    if np.isfinite(wide).any():
        best = float(WIDE_SHIFTS[int(np.nanargmin(wide))])
        if np.nanmin(wide) < BETTER * _mean(seen.costs(poses)):
            centre = best
    for _ in range(2):
        costs = np.array([seen.costs(poses, shift=centre + float(s)) for s in NARROW_SHIFTS])  # [S, pairs]
        usable = costs[:, np.isfinite(costs).all(0)]
        if usable.shape[1] < FEWEST_PAIRS:
            return 0.0, float("inf")
        centre += float(NARROW_SHIFTS[int(usable.mean(1).argmin())])
    costs = np.array([seen.costs(poses, shift=centre + float(s)) for s in NARROW_SHIFTS])
    usable = costs[:, np.isfinite(costs).all(0)]
    if usable.shape[1] < FEWEST_PAIRS:
        return 0.0, float("inf")
    mean = usable.mean(1)
    if min(mean[0], mean[-1]) < SHARP * mean.min():  # too slow, or too even a motion to tell
        return 0.0, float("inf")
    number = usable.shape[1]
    vertices = np.array([_vertex(np.delete(usable, k, axis=1).mean(1)) for k in range(number)])
    vertex = _vertex(mean)
    deviation = float(np.sqrt((number - 1) * vertices.var())) if np.isfinite(vertices).all() else float("inf")
    return -(centre + vertex) if np.isfinite(vertex) else 0.0, deviation


def _mean(costs: np.ndarray) -> float:
    return float(np.nanmean(costs)) if np.isfinite(costs).sum() >= FEWEST_PAIRS else float("nan")


def _vertex(values: np.ndarray) -> float:  # [S] at NARROW_SHIFTS -> s
    a, b, _ = np.polyfit(NARROW_SHIFTS, values, 2)
    return float(np.clip(-b / (2 * a), *NARROW_SHIFTS[[0, -1]])) if a > 0 else float("nan")
