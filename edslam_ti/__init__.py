"""ED-SLAM in Taichi: camera trajectory and 3D Gaussian map from an event stream and depth images."""

__version__ = "0.1.0"
