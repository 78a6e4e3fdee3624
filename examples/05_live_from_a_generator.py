"""python examples/05_live_from_a_generator.py [PICTURE.png]

Track a stream that never was a file, and look through the map while it grows: a generator stands in for a
camera that moves along a painted wall; every fifth frame the map is rendered from beside the camera.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import edslam_ti
from edslam_ti.camera import Camera

CAMERA = Camera(width=160, height=120, fx=100.0, fy=100.0, cx=79.5, cy=59.5)
SPEED, DISTANCE, THRESHOLD = 0.2, 1.5, 0.1  # m/s, m, of log brightness


def stream(seconds: float) -> Iterator[tuple[float, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield a time (s) and the columns, rows and signs of the events of every millisecond."""
    tiles = np.random.default_rng(0).uniform(0.1, 0.9, (24, 48))
    wall = cv2.GaussianBlur(cv2.resize(tiles, (480, 240), interpolation=cv2.INTER_NEAREST), None, 1.0)
    xs, ys = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(120, dtype=np.float32))
    last = None
    for t in np.arange(0, seconds, 0.001):
        shift = np.float32(CAMERA.fx * SPEED * t / DISTANCE)  # pixels
        image = np.log(cv2.remap(wall, 100 + xs + shift, 50 + ys, cv2.INTER_LINEAR))
        last = image.copy() if last is None else last
        change = np.trunc((image - last) / THRESHOLD)
        last += THRESHOLD * change
        y, x = np.nonzero(change)
        yield t, x, y, change[y, x]


def main(picture: Path = Path("growing_map.png"), seconds: float = 0.6) -> np.ndarray:
    """Track the stream, write renders of the growing map side by side; return the path [F, 3] in metres."""
    settings = {"iterations": 2, "final_iterations": 20}
    session = edslam_ti.Session(CAMERA, edslam_ti.Config(contrast_threshold=THRESHOLD, mapping=settings))
    views, random, shown = [], np.random.default_rng(1), 0
    for k, (t, x, y, sign) in enumerate(stream(seconds)):
        session.add_events(x, y, np.full(len(x), t), sign)
        if k % 50 == 0:  # at 20 Hz
            session.add_depth(t, random.normal(DISTANCE, 0.002, CAMERA.shape))
        if len(session.trajectory) >= shown + 5:
            shown = len(session.trajectory)
            beside = session.trajectory.pose(-1).copy()
            beside[:3, 3] += 0.1 * beside[:3, 0]  # metres, to the right
            views.append(session.render(beside).intensity)
    results = session.finish()
    cv2.imwrite(str(picture), np.round(255 * np.hstack(views).clip(0, 1)).astype(np.uint8))
    return results.trajectory.poses[:, :3, 3]


if __name__ == "__main__":
    print(main(*map(Path, sys.argv[1:2])))
