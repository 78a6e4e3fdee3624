"""edslam evaluate EST.txt TRUTH.txt [--mesh MESH.ply --recording DIR]

Print the absolute and relative pose errors of a trajectory, both files in TUM format (t tx ty tz qx qy qz qw,
seconds and metres): the numbers of evo_ape and evo_rpe. The truth is interpolated at the estimate's times,
not across its holes. Lines at the end say what looks wrong with the truth.
With --mesh and --recording also the accuracy and completion of a mesh against the true surfaces that the
camera of a simulated recording (`edslam simulate`) saw at the estimate's times.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from edslam_ti.arguments import Shown, UsageError, read_options
from edslam_ti.config import Stage


class EvaluateOptions(Stage):
    """What to compare."""

    estimate: Annotated[Path, Shown("EST.txt", is_positional=True)]
    """Estimated trajectory, TUM format; or the journal.csv of a run that was cut off."""
    truth: Annotated[Path, Shown("TRUTH.txt", is_positional=True)]
    """True trajectory, TUM format."""
    mesh: Path | None = None
    """Mesh made with the estimated trajectory, in its frame."""
    recording: Path | None = None
    """Folder of the simulated recording it was made from."""


def main(argv: Sequence[str] | None = None) -> None:
    """Compare two trajectories, and a mesh with the true surfaces."""
    options = read_options(EvaluateOptions, argv, "edslam evaluate", __doc__)
    if (options.mesh is None) != (options.recording is None):
        raise UsageError("--mesh and --recording: expected both or neither; give the missing one")
    from rich.console import Console

    from edslam_ti.evaluation.trajectories import statistics, trajectory_errors
    from edslam_ti.evaluation.truth_notes import truth_notes
    from edslam_ti.journal import read_journal
    from edslam_ti.trajectory import Trajectory, read_tum

    notes: list[str] = []
    is_journal = options.estimate.suffix == ".csv"
    estimate = read_journal(options.estimate) if is_journal else read_tum(options.estimate, notes)
    truth = read_tum(options.truth, notes)
    errors = trajectory_errors(estimate, truth)
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
    print(
        f"\nSim(3) scale {errors.scale:.6f}; ATE rmse {errors.ate_rmse_cm:.3f} cm, with scale "
        f"{errors.ate_rmse_sim3_cm:.3f} cm; {errors.num_poses} of {errors.num_estimated} poses compared"
    )
    for line in [*notes, *truth_notes(estimate, truth, errors)]:
        Console().print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)
    if options.mesh is not None and options.recording is not None:
        from edslam_ti.datasets.event_replica import EventReplicaSequence
        from edslam_ti.evaluation.meshes import mesh_errors
        from edslam_ti.mesh_reading import read_triangle_mesh

        sequence = EventReplicaSequence(options.recording)
        estimate = Trajectory(estimate.timestamps - sequence.time_offset, estimate.poses)
        surface = mesh_errors(read_triangle_mesh(options.mesh), sequence, estimate)
        print(
            f"mesh accuracy {surface.accuracy_cm:.3f} cm, completion {surface.completion_cm:.3f} cm, "
            f"{100 * surface.completion_ratio:.2f} % within 5 cm"
        )
