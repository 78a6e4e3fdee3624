"""python examples/02_own_depth_and_events.py [FOLDER]

Bring your own data: arrays of events and depth are written in EventReplica's layout and run. Here the arrays
come from a camera that moves 8 cm to the right in front of a painted wall, 1.5 m away.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

import edslam_ti

WIDTH, HEIGHT, FOCAL_LENGTH = 160, 120, 100.0  # pixels
SECONDS, SPEED, DISTANCE, THRESHOLD = 0.4, 0.2, 1.5, 0.1  # s, m/s, m, of log brightness


def make_events() -> np.ndarray:  # [N, 4] x, y, t in seconds, polarity -1 or 1; sorted by t
    """Return the events of the moving camera: pixels whose log brightness has changed by the threshold."""
    random = np.random.default_rng(0)
    wall = cv2.resize(random.uniform(0.1, 0.9, (24, 48)), (480, 240), interpolation=cv2.INTER_NEAREST)
    wall = cv2.GaussianBlur(wall, None, 1.0)
    xs, ys = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    events, last = [], None
    for t in np.arange(0, SECONDS, 0.0005):
        shift = np.float32(FOCAL_LENGTH * SPEED * t / DISTANCE)  # pixels
        image = np.log(cv2.remap(wall, 100 + xs + shift, 50 + ys, cv2.INTER_LINEAR))
        last = image.copy() if last is None else last
        change = np.trunc((image - last) / THRESHOLD)
        last += THRESHOLD * change
        y, x = np.nonzero(change)
        events.append(np.stack([x, y, np.full(len(x), t), np.sign(change[y, x])], axis=1))
    return np.concatenate(events)


def write_sequence(folder: Path, events: np.ndarray, depths: dict[int, np.ndarray]) -> None:
    """Write events [N, 4], and depth images [H, W] in metres by their time in milliseconds."""
    for name in ("depth", f"event_threshold_{THRESHOLD}"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    np.save(folder / f"event_threshold_{THRESHOLD}" / "gray_events_data.npy", events)
    for milliseconds, depth in depths.items():
        image = np.round(1000 * depth).astype(np.uint16)  # millimetres, 0 = missing
        cv2.imwrite(str(folder / "depth" / f"frame{milliseconds:06d}.png"), image)
    camera = dict(width=WIDTH, height=HEIGHT, fx=FOCAL_LENGTH, fy=FOCAL_LENGTH, cx=WIDTH / 2, cy=HEIGHT / 2)
    (folder / "camera.json").write_text(json.dumps(camera))


def main(folder: Path = Path("data/painted_wall"), out: Path = Path("results")) -> Path:
    """Write the recording, run it, and return the results folder."""
    depths = np.random.default_rng(0).normal(DISTANCE, 0.002, (8, HEIGHT, WIDTH))  # with noise of 2 mm
    write_sequence(folder, make_events(), {50 * k: depth for k, depth in enumerate(depths)})
    place = {"dataset": "event_replica", "data_dir": folder.parent, "scene": folder.name, "out": out}
    return edslam_ti.run(edslam_ti.Config(**place, mapping={"iterations": 2, "final_iterations": 20}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
