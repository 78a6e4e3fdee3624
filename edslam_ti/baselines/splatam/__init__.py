"""SplaTAM (Keetha et al. 2024), implemented from its paper on the kernels of this package.

Tracker and mapper share one map of isotropic Gaussians. Inner loops work on tensors of the map's device.
"""
