"""A pose graph of keyframes and revisits, optimised by Open3D."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edslam_ti.geometry import inverse, orthonormalized, se3_exp, se3_log
from edslam_ti.open3d_loader import load_open3d

# Standard deviations in metres and radians: of the motion over one frame (they accumulate), and of a revisit.
DRIFT = (3e-4, 3e-4)
REVISIT = (1e-3, 1e-3)


@dataclass(frozen=True)
class Revisit:
    """A frame aligned to a much older one."""

    old: int  # frame
    new: int  # frame
    T_old_new: np.ndarray  # [4, 4]


def corrections(
    nodes: Sequence[int],  # frames, ascending; the first stays where it is
    poses: Sequence[np.ndarray],  # [4, 4] T_world_camera of each
    revisits: Sequence[Revisit],  # between frames that are nodes
) -> list[np.ndarray]:  # [4, 4] each, T_new T_old^-1
    """Return every node's correction, in the world frame, that best agrees with neighbours and revisits.

    Least squares of the differences between measured and corrected relative poses, weighted by the inverse
    of their variance (Choi, Zhou and Koltun 2015, without their line process).
    """
    registration = load_open3d().pipelines.registration
    graph = registration.PoseGraph()
    for T in poses:
        graph.nodes.append(registration.PoseGraphNode(T))

    def connect(a: int, b: int, T_a_b: np.ndarray, deviations: tuple[float, float], count: int) -> None:
        metres, radians = deviations
        information = np.diag([1 / radians**2] * 3 + [1 / metres**2] * 3) / count  # Open3D: rotation first
        edge = registration.PoseGraphEdge(b, a, T_a_b, information, uncertain=False)
        graph.edges.append(edge)

    for k in range(len(nodes) - 1):
        T_a_b = inverse(poses[k]) @ poses[k + 1]
        connect(k, k + 1, T_a_b, DRIFT, nodes[k + 1] - nodes[k])
    place = {frame: k for k, frame in enumerate(nodes)}
    for revisit in revisits:
        connect(place[revisit.old], place[revisit.new], revisit.T_old_new, REVISIT, 1)
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    return [orthonormalized(np.asarray(node.pose) @ inverse(T)) for node, T in zip(graph.nodes, poses)]


def spread(
    frame: int,
    nodes: Sequence[int],  # frames, ascending
    corrections: Sequence[np.ndarray],  # [4, 4] of the nodes
) -> np.ndarray:  # [4, 4]
    """Return a frame's correction: interpolated between two nodes, constant beyond the first and last."""
    k = int(np.searchsorted(nodes, frame, side="right")) - 1
    if k < 0 or k >= len(nodes) - 1:
        return corrections[max(k, 0)]
    share = (frame - nodes[k]) / (nodes[k + 1] - nodes[k])
    change = inverse(corrections[k]) @ corrections[k + 1]
    return np.asarray(corrections[k] @ se3_exp(share * se3_log(change)))
