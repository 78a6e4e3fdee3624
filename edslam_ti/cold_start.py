"""Shortens the cold start of the command line. Only this file changes settings of the whole process.

Importing edslam_ti changes nothing in the process that imports it. A command owns its process, so it may set
the threads of libraries, pause the garbage collector, and make Taichi compile faster.
"""

import atexit
import gc
import os

from edslam_ti.errors import EdSlamError

# After a torch or numpy call, spinning OpenMP/OpenBLAS threads would take a core from the kernels' workers.
THREADS = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "1"}


def load_kernels() -> None:
    """Load torch and the kernels' engine quickly, for a command that needs kernels.

    Call it after the arguments are parsed and before numpy or torch is loaded: libraries read the environment
    variables once, when they load. Variables that are already set keep their values. Raises EdSlamError when
    the engine is unknown or missing.
    """
    for name, value in THREADS.items():
        os.environ.setdefault(name, value)
    was_enabled = gc.isenabled()
    gc.disable()  # importing torch would trigger 380 garbage collections
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
