"""python apps/slam.py --scene office0

Track an event camera and build a 3D Gaussian map from events and depth. The results land in
results/<dataset>/<scene>/<method>/<time>/ (--out DIR replaces results), and `latest` points there.

    python apps/slam.py --scene office0                              built-in simulated room
    python apps/slam.py --data-dir data --scene my_room              data/my_room, EventReplica's layout
    python apps/slam.py --dataset rpg --data-dir data --scene slider_depth
    python apps/slam.py --scene room0 --start 1 --duration 2 --mapping.enabled false
    python apps/slam.py --config results/builtin/office0/ed_slam/latest/config.yaml --seed 1     another seed
"""

from collections.abc import Sequence
from pathlib import Path

from edslam_ti.cold_start import load_kernels
from edslam_ti.command_line import launch, parse_config

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


def main(argv: Sequence[str] | None = None) -> None:
    config = parse_config(argv, CONFIGS, description=__doc__)
    load_kernels()
    from edslam_ti.pipeline import run  # after the settings: torch and Taichi take seconds to load

    run(config)


if __name__ == "__main__":
    launch(main)
