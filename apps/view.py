"""python apps/view.py RESULT [RESULT ...] [--save FILE.png]

Show finished runs: `edslam view` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.view import main

if __name__ == "__main__":
    launch(main)
