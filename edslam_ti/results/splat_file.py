"""A map as a .splat file, which most web viewers of Gaussian splats open: 32 bytes a Gaussian.

The layout is that of antimatter15/splat: position and scale as six float32, colour and opacity as four
bytes, the quaternion w x y z as four bytes around 128. The Gaussians that cover most come first, so that a
viewer that is still loading shows them.
"""

from pathlib import Path

import numpy as np

from edslam_ti.mapping.gaussian_ply import read_gaussian_ply
from edslam_ti.output import atomic_file

SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, map_path: Path) -> None:
    """Write the Gaussians of a map.ply; raises what `read_gaussian_ply` raises."""
    gaussians = read_gaussian_ply(map_path)
    opacities = 1 / (1 + np.exp(-gaussians["logit_opacities"]))
    order = np.argsort(-opacities * np.exp(gaussians["log_scales"].sum(1)), kind="stable")
    splats = np.zeros(len(order), SPLAT)
    splats["mean"] = gaussians["means"][order]
    splats["scale"] = np.exp(gaussians["log_scales"][order])
    colours = np.concatenate([gaussians["colors"], opacities[:, None]], axis=1)[order]
    splats["rgba"] = np.rint(255 * np.clip(colours, 0, 1))
    quats = gaussians["quats"][order]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    splats["quat"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    with atomic_file(path) as temporary:
        temporary.write_bytes(splats.tobytes())
