"""ED-SLAM in Taichi: camera trajectory and 3D Gaussian map from an event stream and depth images."""

import os

# A spinning OpenMP/OpenBLAS team after a torch or numpy call steals a core from the Taichi workers.
# These are read once, when the libraries load, so they are set before anything imports them.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")

__version__ = "0.1.0"
