"""A shorter cold start of the command line: what it changes in the process, it changes here alone.

Importing edslam_ti changes nothing in the process that imports it. A command owns its process, so it may set
the threads of libraries, pause the garbage collector, and make Taichi compile faster.
"""

import atexit
import gc
import os

from edslam_ti.errors import EdSlamError

# A spinning OpenMP/OpenBLAS team after a torch or numpy call steals a core from the workers of the kernels.
THREADS = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "1"}


def load_kernels() -> None:
    """Load torch and the kernels' engine as fast as they can be, for a command that needs kernels.

    Call it once the arguments are parsed and before numpy or torch is loaded: libraries read the variables of
    the environment once, when they load. Variables that are already set keep their values. Raises EdSlamError
    when the engine is unknown or missing.
    """
    for name, value in THREADS.items():
        os.environ.setdefault(name, value)
    was_enabled = gc.isenabled()
    gc.disable()  # the collector would run 380 times among the objects that importing torch makes
    try:
        from edslam_ti.kernels import runtime, taichi_speedups  # noqa: F401

        taichi_speedups.apply()
    except ImportError as error:
        raise EdSlamError(str(error)) from error
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)  # Taichi saves compiled kernels when its objects are collected at exit
        if was_enabled:
            gc.enable()
