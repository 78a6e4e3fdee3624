"""python apps/reproduce.py tracking --quick true

Measure tracking over many recordings: five rooms and harder scenes, exact and Kinect-like depth at 20, 10 and
5 Hz, normal and double speed, three seeds. Recordings are simulated on first use and kept; every result is
kept too, so a run that was stopped goes on where it ended. Tables and pictures land in --out.

    python apps/reproduce.py tracking --quick true                        four short cases, about 3 minutes
    python apps/reproduce.py tracking --scenes wall --seeds 0             one scene
    python apps/reproduce.py tracking --methods ed_slam open3d_icp
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from edslam_ti.command_line import UsageError, launch, parse_arguments
from edslam_ti.reproduce.cases import EVERYTHING, Selection, all_cases, quick_cases


def tracking(
    select: Annotated[Selection, tyro.conf.arg(name="")] = EVERYTHING,
    methods: tuple[str, ...] = ("ed_slam", "ed_slam_paper", "open3d_icp", "open3d_rgbd"),
    out: Path = Path("results/reproduce"),
    data_dir: Path = Path("../shared/data"),
    quick: bool = False,
    mapping: bool = False,
    fresh: bool = False,
    keep_recordings: bool = True,
    threads: int = 2,
) -> None:
    """Run methods over the bench.

    Args:
        select: filters
        methods: methods to compare, side by side in the tables
        out: folder that receives results.json, tracking.md, the pictures, and one file per run
        data_dir: folder with trajectories/, scenes/ and slider_depth/; cases without their data are skipped
        quick: four short cases instead of all
        mapping: run the whole system instead of tracking alone
        fresh: run again what has a result already
        keep_recordings: false: delete each simulated recording after its last case
        threads: CPU threads
    """
    cases = [case for case in (quick_cases() if quick else all_cases()) if select.includes(case)]
    if not cases:
        raise UsageError("no case passes the filters; leave some out")
    # After the arguments: torch and Taichi take seconds to load.
    from edslam_ti.reproduce.recordings import Recordings
    from edslam_ti.reproduce.report import write_report
    from edslam_ti.reproduce.runs import methods_as_variants, run_all

    console = Console()
    variants = methods_as_variants(methods, mapping)
    recordings = Recordings(data_dir)
    results = run_all(cases, variants, recordings, out, console, threads, fresh, keep_recordings)
    print(f"{write_report(results, out, 'Tracking')}: {len(results)} runs of {len(cases)} cases")


COMMANDS = {"tracking": tracking}


def main(argv: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if argv is None else list(argv)
    if arguments and arguments[0] in COMMANDS:
        parse_arguments(COMMANDS[arguments[0]], arguments[1:], description=__doc__)
    elif arguments and arguments[0] in ("-h", "--help"):
        print(__doc__)
    else:
        raise UsageError(f"expected a command first: {', '.join(COMMANDS)}")


if __name__ == "__main__":
    launch(main)
