"""Small sequences in EventReplica's layout, written file by file, so that tests know every number in them."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

WIDTH, HEIGHT = 32, 24
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 16.0, "cy": 12.0}


def some_events(count: int = 3000, end: float = 0.3) -> np.ndarray:  # [N, 4]
    """Return random events on [0, end), the first and last near its ends."""
    random = np.random.default_rng(0)
    t = np.sort(random.uniform(0, end, count))
    p = random.choice([-1.0, 1.0], count)
    return np.stack([random.integers(0, WIDTH, count), random.integers(0, HEIGHT, count), t, p], -1)


def write_sequence(
    folder: Path, events: np.ndarray | None = None, camera: dict[str, Any] | None = None
) -> Path:
    """Write a whole sequence: 0.3 s, depth and images every 50 ms, poses every 25 ms."""
    (folder / "event_threshold_0.1").mkdir(parents=True)
    (folder / "depth").mkdir()
    (folder / "images").mkdir()
    np.save(folder / "event_threshold_0.1/gray_events_data.npy", some_events() if events is None else events)
    (folder / "camera.json").write_text(json.dumps(CAMERA if camera is None else camera))
    for ms in range(0, 301, 50):
        depth = np.full((HEIGHT, WIDTH), 1000 + ms, np.uint16)
        depth[0, 0] = 0
        cv2.imwrite(str(folder / f"depth/frame{ms:06d}.png"), depth)
        cv2.imwrite(str(folder / f"images/frame{ms:06d}.png"), np.full((HEIGHT, WIDTH), 51, np.uint8))
    times = np.arange(13) * 0.025
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = times
    np.savetxt(folder / "poses_ts.txt", times)
    np.savetxt(folder / "traj.txt", poses.reshape(-1, 16))
    return folder


def save_events(folder: Path, events: np.ndarray) -> None:
    np.save(folder / "event_threshold_0.1/gray_events_data.npy", events)
