"""python apps/inspect_recording.py PATH [--sheet FILE.png]

Check a recording: `edslam inspect` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.inspect import main

if __name__ == "__main__":
    launch(main)
