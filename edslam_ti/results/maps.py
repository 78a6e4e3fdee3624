"""A map read back from a results folder."""

from pathlib import Path

import torch

from edslam_ti.config import MappingConfig
from edslam_ti.mapping.gaussian_ply import read_gaussian_ply
from edslam_ti.mapping.gaussians import GaussianMap


def load_map(path: Path) -> GaussianMap:
    """Return the map of a `map.ply`, ready to be rendered or optimised further.

    Brightness is the mean of the file's three channels, held within 0.002 and 0.998 as maps are; what the
    optimiser knew is not in the file. Raises FileNotFoundError, or DataError where it is no splat file.
    """
    raw = {name: torch.from_numpy(values) for name, values in read_gaussian_ply(path).items()}
    gaussians, everyone = GaussianMap(MappingConfig()), torch.arange(len(raw["means"]))
    colors = raw["colors"].mean(-1, keepdim=True)
    gaussians.add(raw["means"], raw["quats"], raw["log_scales"].exp(), 0.5, colors)
    for name in ("log_scales", "logit_opacities"):
        gaussians.overwrite(name, everyone, raw[name])
    return gaussians
