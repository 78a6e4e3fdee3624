"""Taichi kernels of ED-SLAM and their torch wrappers; knows arrays, not SLAM."""

import atexit
import gc

# Python would look 380 times for garbage among what importing torch has just made, and then now and again.
_was_enabled = gc.isenabled()
gc.disable()
try:
    from edslam_ti.kernels.runtime import init
finally:
    gc.freeze()
    atexit.register(gc.unfreeze)  # Taichi saves compiled kernels when its objects are collected at the end
    if _was_enabled:
        gc.enable()

__project__ = "edslam_ti"  # `kernels` is also the name of an unrelated PyPI package

__all__ = ["init"]
