"""python examples/01_run.py [SCENE]

Run a scene from Python and read its numbers: the first 0.6 s of the built-in room office0, with few mapping
steps, so that it takes seconds (and half a minute more the first time, when the room is simulated).
"""

import json
import sys
from pathlib import Path

import edslam_ti


def main(scene: str = "office0", data_dir: Path = Path("data"), out: Path = Path("results")) -> Path:
    """Run a scene and return its results folder."""
    config = edslam_ti.Config(
        scene=scene,  # a folder below data_dir, or a built-in room
        data_dir=data_dir,
        out=out,
        duration=0.6,  # seconds
        mapping={
            "iterations": 2,
            "final_iterations": 40,
        },  # as in `edslam slam --help`
    )
    folder = edslam_ti.run(config)
    metrics = json.loads((folder / "metrics.json").read_text())
    for name in ("ate_rmse_cm", "psnr_corrected_db", "num_gaussians", "tracking_hz"):
        print(f"{name:>20} {metrics[name]}")
    return folder


if __name__ == "__main__":
    main(*sys.argv[1:2])
