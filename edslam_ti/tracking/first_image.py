"""The first brightness image of a segment of events, without the depth of frames that contradict it.

Image and poses are solved for in turn, from the poses that time surfaces and depth have given. Where a
frame's pose by brightness alone is then far from that with depth, some depth is wrong, the keyframe's
perhaps: sets of frames are tried without theirs, until nothing contradicts and brightness fits far better.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from edslam_ti.alignment import mean_cost
from edslam_ti.geometry import inverse
from edslam_ti.tracking.depth_check import (
    SMALLEST_FLOW,
    SMALLEST_MISFIT,
    log_ratio,
    of_other_scale,
    sets_to_try,
)
from edslam_ti.tracking.keyframes import BrightnessFrame, BrightnessKeyframe
from edslam_ti.tracking.segment import Segment
from edslam_ti.trajectory import PathDraft, Trajectory

BETTER = 0.8  # share of the misfit of all frames to which it falls at least where depth is left out
MOST_LEFT_OUT = 3  # frames whose depth is, and always less than half of them
SETTLED_FLOW = 0.25  # px: where no pose is farther from that by brightness alone, nothing contradicts
ROUNDS = 2  # in which images and poses are solved for
CAREFUL_ROUNDS = 5  # the same where the first poses are partly of wrong depth


@dataclass(frozen=True)
class FirstImage:
    """A first image, from recent frames of which some may have lost their depth."""

    keyframe: BrightnessKeyframe
    segment: Segment
    path: PathDraft
    flows: list[float]  # px, between poses with depth and by brightness alone
    left_out: frozenset[int]  # frames whose depth is

    def misfit(self) -> float:
        """Return the mean misfit of recent frames aligned by brightness alone, log brightness."""
        segment, largest = self.segment, self.segment.config.images.max_misfit
        misfits = [
            segment.align(self.keyframe, f, None, self.path.pose(f.index), self.path).misfit
            for f in segment.recent
            if f.index != self.keyframe.index
        ]
        return float(np.minimum(misfits, largest).mean())


def first_image(segment: Segment, path: PathDraft) -> FirstImage | None:
    """Return the segment's first image, None until the scene has moved enough; correct the path."""
    settings = segment.config.images
    if len(segment.recent) < settings.min_frames or not segment.with_depth:
        return None
    frame = segment.middle(segment.with_depth)
    assert frame.depth is not None
    T_now_then = inverse(path.newest) @ path.pose(frame.index)
    if segment.aligner.flow(frame.depth.small, T_now_then) < settings.min_flow:
        return None
    by_surfaces = {f.index: path.pose(f.index) for f in segment.recent}
    found = _solved(segment, path, ROUNDS, frozenset())
    other = _of_other_scale(found)
    if not other and max(found.flows) <= SMALLEST_FLOW:
        return found
    state = segment.aligner.random_state
    best = _trial(found, by_surfaces, other) if other else found
    if max(best.flows) > SMALLEST_FLOW:
        best = _without_wrong_depth(best, by_surfaces)
    if not best.left_out:
        segment.aligner.random_state = state  # as if nothing had been tried
        return found
    for frame in best.segment.recent:
        path.replace(frame.index, best.path.pose(frame.index))
    return best


def _solved(
    segment: Segment, path: PathDraft, rounds: int, left_out: frozenset[int], fixed: int = 0
) -> FirstImage:
    """Return the image of a keyframe in the middle, image and poses solved for in turn; correct the path."""
    frame = segment.middle(segment.with_depth)
    assert frame.depth is not None
    keyframe = segment.new_keyframe(frame, np.zeros_like(frame.depth.small))
    segment.solve(keyframe, path, iterations=40, is_robust=False)
    for _ in range(rounds):
        segment.solve(keyframe, path)
        segment.realign(keyframe, path, fixed)
    segment.solve(keyframe, path)
    return FirstImage(keyframe, segment, path, _contradictions(segment, keyframe, path), left_out)


def _contradictions(segment: Segment, keyframe: BrightnessKeyframe, path: PathDraft) -> list[float]:
    """Return the flow in pixels between each recent frame's pose and that by brightness alone."""
    flows = [0.0]  # the keyframe's
    for frame in segment.with_depth:
        found = None if frame.index == keyframe.index else segment.without_depth(keyframe, frame, path)
        if found is not None and frame.depth is not None:
            T_now_then = inverse(found[0]) @ path.pose(frame.index)
            flows.append(segment.aligner.flow(frame.depth.small, T_now_then))
    return flows


def _of_other_scale(found: FirstImage) -> frozenset[int]:
    """Return the frames whose depth differs from all others', seen from the poses found."""
    frames, camera = found.segment.with_depth, found.segment.aligner.camera
    ratios = np.zeros((len(frames), len(frames)))
    for (i, a), (j, b) in itertools.permutations(enumerate(frames), 2):
        assert a.depth is not None
        assert b.depth is not None
        T_b_a = inverse(found.path.pose(b.index)) @ found.path.pose(a.index)
        ratios[i, j] = log_ratio(a.depth.small, b.depth.small, T_b_a, camera)
    return frozenset(frames[k].index for k in of_other_scale(ratios))


def _without_wrong_depth(found: FirstImage, by_surfaces: dict[int, np.ndarray]) -> FirstImage:
    """Return the first image without the depth of the fewest frames that leave no contradiction.

    Brightness must fit far better without them. All depth stays where no set of frames is such, or where
    there is hardly a misfit to judge by.
    """
    misfit, with_depth = found.misfit(), [f.index for f in found.segment.with_depth]
    if misfit < SMALLEST_MISFIT:
        return found
    minority = (len(with_depth) - 1) // 2  # where more contradict, it is brightness that is in doubt
    most, promising = min(MOST_LEFT_OUT, minority), frozenset[int]()
    for number in range(1, most + 1):
        sets = sets_to_try(with_depth, number, promising)
        trials = [(trial.misfit(), trial) for trial in (_trial(found, by_surfaces, s) for s in sets)]
        settled = [t for t in trials if t[0] < BETTER * misfit and max(t[1].flows) < SETTLED_FLOW]
        if settled:
            return min(settled, key=lambda t: t[0])[1]
        promising = min(trials, key=lambda t: t[0])[1].left_out
    return found


def _trial(found: FirstImage, by_surfaces: dict[int, np.ndarray], left_out: frozenset[int]) -> FirstImage:
    """Return the first image where some frames' depth is left out."""
    recent = [replace(f, depth=None) if f.index in left_out else f for f in found.segment.recent]
    segment = replace(found.segment, recent=recent)
    path = PathDraft(found.path.trajectory)
    path.newest, path.corrections = found.path.newest, dict(found.path.corrections)
    known = _by_depth(segment, by_surfaces)
    for frame in recent:
        path.replace(frame.index, known.at(frame.timestamp))
    is_first_wrong = 0 in left_out | found.left_out
    if not is_first_wrong:
        _keep_first(path, recent, found.path.pose(0))
    all_left_out = left_out | found.left_out
    image = _solved(segment, path, CAREFUL_ROUNDS, all_left_out, fixed=-1 if is_first_wrong else 0)
    if is_first_wrong:
        _keep_first(path, recent, found.path.pose(0))
    return image


def _keep_first(path: PathDraft, recent: list[BrightnessFrame], given: np.ndarray) -> None:  # [4, 4]
    """Move all recent frames so that the very first frame has its given pose, if it is among them."""
    if recent[0].index != 0:
        return
    T = given @ inverse(path.pose(0))
    for frame in recent:
        path.replace(frame.index, T @ path.pose(frame.index))
    path.replace(0, given)


def _by_depth(segment: Segment, by_surfaces: dict[int, np.ndarray]) -> Trajectory:
    """Return poses of the recent frames with depth, aligned by depth alone to that in the middle."""
    middle = segment.middle(segment.with_depth)
    assert middle.depth is not None
    keyframe = segment.new_keyframe(middle, np.zeros_like(middle.depth.small))
    reference = segment.aligner.with_points(keyframe)
    T_world_middle, poses = by_surfaces[middle.index], []
    for frame in segment.with_depth:
        T = inverse(T_world_middle) @ by_surfaces[frame.index]
        if frame is not middle and frame.depth is not None:
            # A wrong frame before it may have led it astray: it is tried from the middle, too.
            found = [segment.aligner.align_depth(reference, frame.depth, start) for start in (T, np.eye(4))]
            T, _ = min(found, key=lambda pair: mean_cost(pair[1]))
        poses.append(T_world_middle @ T)
    return Trajectory(np.array([f.timestamp for f in segment.with_depth]), np.array(poses))
