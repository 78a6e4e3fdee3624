"""Keyframes: frames that see enough that is new (Sec. III-E)."""

from dataclasses import dataclass

from torch import Tensor

from edslam_ti.config import KeyframeConfig


@dataclass(frozen=True)
class Keyframe:
    """A frame that sees enough that is new.

    The map is optimised for all kept frames. Keyframes are the last of them to be dropped.
    """

    index: int  # of the frame in the trajectory, where its pose is


def covisibility(
    visible: Tensor,  # [N] bool, Gaussians visible in a view
    other: Tensor,  # [N] bool, in another
) -> float:
    """Return the share of the Gaussians visible in either view that are visible in both."""
    union = int((visible | other).sum())
    return int((visible & other).sum()) / max(union, 1)


def is_keyframe(
    shared: float,  # covisibility with the last keyframe, 0 to 1
    translation: float,  # from the last keyframe, metres
    median_depth: float,  # metres
    config: KeyframeConfig,
) -> bool:
    """Return whether a frame sees enough that is new to become a keyframe."""
    is_far = translation > config.max_translation * median_depth
    return shared < config.min_covisibility or is_far
