"""python apps/benchmark.py --suites rasterizer tracking

Time the kernels against alternatives: `edslam benchmark` from a checkout; --help lists the options.
"""

from edslam_ti.command_line import launch
from edslam_ti.commands.benchmark import main

if __name__ == "__main__":
    launch(main)
