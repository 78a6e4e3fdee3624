"""python apps/simulate.py --scene office0 --out DIR

Write a simulated recording: `edslam simulate` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.simulate import main

if __name__ == "__main__":
    launch(main)
