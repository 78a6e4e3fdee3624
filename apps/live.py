"""python apps/live.py --play office0 --pace 1

Track data while they come: `edslam live` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.live import main

if __name__ == "__main__":
    launch(main)
