"""Loads and compiles all kernels of a method before data come: a short session of a painted wall."""

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.errors import DataError
from edslam_ti.session import Session

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
DISTANCE, SPEED, THRESHOLD = 1.0, 0.3, 0.1  # m, m/s, of log brightness
FRAMES, RATE, STEPS = 14, 20.0, 10  # depth images, Hz, images between two of them that make events


def warm_up(config: Config) -> None:
    """Track and map a wall that is passed; what comes out is discarded."""
    few = {"iterations": 1, "final_iterations": 2, "max_gaussians": 20_000, "max_views": 10}
    session = Session(CAMERA, config.updated({"mapping": few, "contrast_threshold": THRESHOLD}))
    random = np.random.default_rng(0)
    wall = cv2.resize(random.uniform(0.1, 0.9, (32, 64)).astype(np.float32), (256, 128))
    xs, ys = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    depth = np.full(CAMERA.shape, DISTANCE, np.float32)
    last = None
    try:
        for k in range(FRAMES * STEPS):
            t = k / (RATE * STEPS)
            column = (40 + xs + CAMERA.fx * SPEED * t / DISTANCE).astype(np.float32)
            image = cv2.remap(wall, column, (30 + ys).astype(np.float32), cv2.INTER_LINEAR)
            last = np.log(image) if last is None else last
            change = np.trunc((np.log(image) - last) / THRESHOLD)
            last += THRESHOLD * change
            y, x = np.nonzero(change)
            session.add_events(x, y, np.full(len(x), t), change[y, x])
            if k % STEPS == 0:
                session.add_image(t, image)
                session.add_depth(t, depth + random.normal(0, 0.001, depth.shape))
        session.finish()
    except DataError:  # the wall is too little for some methods; their kernels load with the first frames
        return
