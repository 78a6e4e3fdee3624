"""python apps/slam.py --scene office0

Track an event camera and build a 3D Gaussian map: `edslam slam` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.slam import main

if __name__ == "__main__":
    launch(main)
