"""edslam slam --scene office0

Track an event camera and build a 3D Gaussian map from events and depth. The results land in
results/<dataset>/<scene>/<method>/<time>/ (--out DIR replaces results), and `latest` points there.

    edslam slam --scene office0                              built-in simulated room
    edslam slam --data-dir data --scene my_room              data/my_room, EventReplica's layout
    edslam slam --dataset rpg --data-dir data --scene slider_depth
    edslam slam --scene room0 --start 1 --duration 2 --mapping.enabled false
    edslam slam --config results/builtin/office0/ed_slam/latest/config.yaml --seed 1     another seed
    edslam slam --resume results/builtin/office0/ed_slam/2026-01-31_12-00-00      go on after a crash

Exit codes: 0 done, 1 error, 2 wrong usage, 3 more than a tenth of the frames was lost (results are saved),
130 Ctrl-C, 143 SIGTERM, 129 SIGHUP (what there is, is saved).
"""

from collections.abc import Sequence

from edslam_ti.cold_start import load_kernels
from edslam_ti.command_line import read_choices, with_presets


def main(argv: Sequence[str] | None = None) -> None:
    """Run a method on a sequence."""
    choices = read_choices(argv, __doc__)
    choices.config.require_device()
    load_kernels()
    config = with_presets(choices)
    from edslam_ti.pipeline import resume, run  # torch and Taichi take seconds to load
    from edslam_ti.results.reading import require_tracked

    require_tracked(run(config) if choices.resumed is None else resume(choices.resumed, config))
