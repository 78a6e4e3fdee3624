"""python examples/06_own_recording_to_a_map.py RECORDING.npz [RESULTS]

From what a camera's own software wrote to a map, in the units it uses: microseconds and millimetres, and a
lens with distortion. RECORDING.npz holds
    x, y, t, p             events [N]: columns, rows, microseconds since the epoch or since boot, 0 or 1
    depth, depth_times     images [D, H, W] uint16 millimetres, and their times in microseconds
    intrinsics             fx, fy, cx, cy in pixels, pixel centres at integers
    distortion             k1, k2, p1, p2, k3 (optional)
"""

import sys
from pathlib import Path

import numpy as np

import edslam_ti
from edslam_ti.camera import Camera
from edslam_ti.lenses import Lens

EVENTS_AT_ONCE = 20_000


def main(recording: Path, out: Path = Path("results")) -> Path:
    """Feed the recording and return the folder with map.ply, mesh.ply and trajectory_tum.txt."""
    data = np.load(recording)
    height, width = data["depth"].shape[1:]
    camera: Camera | Lens = Camera(width, height, *(float(value) for value in data["intrinsics"]))
    if "distortion" in data:
        camera = Lens(camera, "plumb_bob", tuple(float(value) for value in data["distortion"]))
    config = edslam_ti.Config(contrast_threshold=0.1, mapping={"iterations": 2, "final_iterations": 20})
    session = edslam_ti.Session(camera, config, time_unit="us", depth_unit="mm", out=out, name=recording.stem)
    x, y, t, p = (data[name] for name in "xytp")
    waiting = list(zip(data["depth_times"], data["depth"]))
    for k in range(0, len(t), EVENTS_AT_ONCE):
        part = slice(k, k + EVENTS_AT_ONCE)
        session.add_events(x[part], y[part], t[part], p[part])
        while waiting and waiting[0][0] <= t[part][-1]:
            session.add_depth(*waiting.pop(0))
    results = session.finish()
    assert results.folder is not None, "`out` was given"
    print(f"{results.metrics['num_gaussians']} Gaussians: {results.folder / 'map.ply'}")
    return results.folder


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
