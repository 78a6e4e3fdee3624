"""edslam reproduce tracking --quick

Measure over many recordings. tracking: five rooms and harder scenes, exact and Kinect-like depth at 20, 10
and 5 Hz, normal and double speed, three seeds. Recordings are simulated on first use and kept; every result
is kept too, so a run that was stopped goes on where it ended. Tables and pictures land in --out.

    edslam reproduce all --scenes all            every method, the paper's tables and figures, one report
    edslam reproduce table4 --scenes office0 --seeds 0 1 2 --jobs 2        one table; also table1 to table3
    edslam reproduce runtime --ray local         the same runs as tasks of a Ray cluster
    edslam reproduce tracking --quick                            four short cases, about 3 minutes
    edslam reproduce tracking --scenes wall --seeds 0            one scene
    edslam reproduce tracking --methods ed_slam open3d_icp
    edslam reproduce ablations                                   one setting changed at a time
    edslam reproduce long                        a minute and five through a flat of four rooms
    edslam reproduce long_stream                                 time and memory along 60 s
    edslam reproduce report                                      tables of README.md and docs/

`edslam reproduce tracking --help` lists the options of a command.
"""

import sys
from collections.abc import Sequence

from edslam_ti.arguments import HELP, UsageError, nearest_name_hint, read_options
from edslam_ti.experiments.command import COMMANDS


def main(argv: Sequence[str] | None = None) -> None:
    """Measure over many recordings."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    name = arguments[0] if arguments else ""
    if name in HELP:
        print(__doc__)
        return
    if name not in COMMANDS:
        hint = nearest_name_hint(name, list(COMMANDS))
        raise UsageError(f"expected a command first: {', '.join(COMMANDS)}{hint}")
    options, run = COMMANDS[name]
    run(read_options(options, arguments[1:], f"edslam reproduce {name}", run.__doc__))
