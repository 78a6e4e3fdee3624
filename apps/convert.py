"""python apps/convert.py IN OUT [--layout event_replica]

Write a recording in another layout: `edslam convert` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.convert import main

if __name__ == "__main__":
    launch(main)
