"""python apps/evaluate.py EST.txt TRUTH.txt [--mesh MESH.ply --recording DIR]

Print a trajectory's errors: `edslam evaluate` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.evaluate import main

if __name__ == "__main__":
    launch(main)
