"""Taichi kernels of ED-SLAM and their torch wrappers; knows arrays, not SLAM."""

import gc

_was_enabled = gc.isenabled()
gc.disable()  # importing torch would look 380 times for garbage among what it has just made
try:
    from kernels.runtime import init
finally:
    if _was_enabled:
        gc.enable()

__project__ = "edslam_ti"  # `kernels` is also the name of an unrelated PyPI package

__all__ = ["init"]
