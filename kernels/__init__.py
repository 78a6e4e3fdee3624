"""Taichi kernels of ED-SLAM and their torch wrappers; knows arrays, not SLAM."""

from kernels.runtime import init

__project__ = "edslam_ti"  # `kernels` is also the name of an unrelated PyPI package

__all__ = ["init"]
