"""python apps/reproduce.py tracking --quick true

Measure tracking over many recordings: five rooms and harder scenes, exact and Kinect-like depth at 20, 10 and
5 Hz, normal and double speed, three seeds. Recordings are simulated on first use and kept; every result is
kept too, so a run that was stopped goes on where it ended. Tables and pictures land in --out.

    python apps/reproduce.py tracking --quick true                        four short cases, about 3 minutes
    python apps/reproduce.py tracking --scenes wall --seeds 0             one scene
    python apps/reproduce.py tracking --methods ed_slam open3d_icp
    python apps/reproduce.py ablations                                    one setting changed at a time
    python apps/reproduce.py long_stream                                  time and memory along 60 s
    python apps/reproduce.py report                                       the tables of README and docs
"""

import sys
from collections.abc import Sequence

from edslam_ti.command_line import UsageError, launch, parse_arguments
from edslam_ti.experiments.command import COMMANDS


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
