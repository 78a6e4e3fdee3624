"""ED-SLAM in Taichi: camera trajectory and 3D Gaussian map from an event stream and depth images.

The public names load on demand: `import edslam_ti` loads neither torch nor Taichi.

    config = edslam_ti.Config(scene="office0", duration=0.6)
    folder = edslam_ti.run(config)                                # what `edslam slam` does
    gaussians = edslam_ti.load_map(folder / "map.ply")            # a GaussianMap
    session = edslam_ti.Session(camera, config)                   # fed with arrays as they come, docs/live.md
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edslam_ti.config import Config
    from edslam_ti.datasets import open_sequence
    from edslam_ti.mapping.gaussians import GaussianMap
    from edslam_ti.pipeline import run
    from edslam_ti.results.maps import load_map
    from edslam_ti.session import Session
    from edslam_ti.slam import Slam

__version__ = "0.1.0"

__all__ = ["Config", "GaussianMap", "Session", "Slam", "__version__", "load_map", "open_sequence", "run"]

_HOMES = {
    "Config": "config",
    "GaussianMap": "mapping.gaussians",
    "Session": "session",
    "Slam": "slam",
    "load_map": "results.maps",
    "open_sequence": "datasets",
    "run": "pipeline",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first access (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
