"""python apps/evaluate.py EST.txt TRUTH.txt

Print the absolute and relative pose errors of a trajectory, both files in TUM format (t tx ty tz qx qy qz qw,
seconds and metres): the numbers of evo_ape and evo_rpe. The truth is interpolated at the estimate's times.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from edslam_ti.command_line import launch, parse_arguments


def evaluate(
    estimate: Annotated[Path, tyro.conf.Positional],
    truth: Annotated[Path, tyro.conf.Positional],
) -> None:
    """Compare two trajectories.

    Args:
        estimate: estimated trajectory, TUM format
        truth: true trajectory, TUM format
    """
    from edslam_ti.evaluation import statistics, trajectory_errors
    from edslam_ti.trajectory import read_tum

    errors = trajectory_errors(read_tum(estimate), read_tum(truth))
    print(f"{errors.num_poses} poses compared over {errors.timestamps[-1] - errors.timestamps[0]:.3f} s")
    tables = {
        "APE w.r.t. translation part (m)\n(with SE(3) Umeyama alignment)": errors.errors_cm / 100,
        "APE w.r.t. translation part (m)\n(with Sim(3) Umeyama alignment)": errors.errors_sim3_cm / 100,
        "RPE w.r.t. translation part (m)\nfor delta = 1 (frames)": errors.motion_errors_cm / 100,
        "RPE w.r.t. rotation angle in degrees (deg)\nfor delta = 1 (frames)": errors.motion_errors_deg,
    }
    for title, values in tables.items():
        print(f"\n{title}\n")
        for name, value in statistics(values).items():
            print(f"{name:>10}\t{value:.6f}")
    print(f"\nSim(3) scale {errors.scale:.6f}; ATE rmse {errors.ate_rmse_cm:.3f} cm")


def main(argv: Sequence[str] | None = None) -> None:
    parse_arguments(evaluate, argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
