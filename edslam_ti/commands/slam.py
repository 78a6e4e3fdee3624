"""edslam slam --scene office0

Track an event camera and build a 3D Gaussian map from events and depth. The results land in
results/<dataset>/<scene>/<method>/<time>/ (--out DIR replaces results), and `latest` points there.

    edslam slam --scene office0                              built-in simulated room
    edslam slam --data-dir data --scene my_room              data/my_room, EventReplica's layout
    edslam slam --dataset rpg --data-dir data --scene slider_depth
    edslam slam --scene room0 --start 1 --duration 2 --mapping.enabled false
    edslam slam --config results/builtin/office0/ed_slam/latest/config.yaml --seed 1     another seed
"""

from collections.abc import Sequence

from edslam_ti.cold_start import load_kernels
from edslam_ti.command_line import read_choices, with_presets


def main(argv: Sequence[str] | None = None) -> None:
    """Run a method on a sequence."""
    choices, differences = read_choices(argv, __doc__)
    choices.require_device()
    load_kernels()
    config = with_presets(choices, differences)
    from edslam_ti.pipeline import run  # torch and Taichi take seconds to load
    from edslam_ti.results.reading import require_tracked

    require_tracked(run(config))
