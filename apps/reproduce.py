"""python apps/reproduce.py tracking --quick

Measure over many recordings: `edslam reproduce` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.reproduce import main

if __name__ == "__main__":
    launch(main)
