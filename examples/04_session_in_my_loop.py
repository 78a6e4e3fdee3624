"""python examples/04_session_in_my_loop.py [SCENE]

Drive SLAM from a loop of your own: events go in as they come, ten milliseconds at a time, depth images when
there is one, and the pose is asked for after every piece. Here the arrays come from a recording; a Session
finds the path that `edslam slam` finds for it, to the bit.
"""

import sys
from pathlib import Path

import numpy as np

import edslam_ti

PIECE = 0.01  # seconds of events that are added at a time


def main(scene: str = "office0", data_dir: Path = Path("data"), out: Path = Path("results")) -> Path:
    """Feed a recording piece by piece and return the results folder."""
    settings = {"iterations": 2, "final_iterations": 20}
    config = edslam_ti.Config(scene=scene, data_dir=data_dir, contrast_threshold=0.1, mapping=settings)
    sequence = edslam_ti.open_sequence(config)
    session = edslam_ti.Session(sequence.camera, config, out=out, name=scene)
    first, last = sequence.time_range
    depth_times = list(sequence.depth_timestamps)
    for start in np.arange(first, min(last, first + 0.4), PIECE):
        events = sequence.events(start, start + PIECE)
        session.add_events(events.x, events.y, events.t, events.polarity)
        while depth_times and depth_times[0] < start + PIECE:
            taken = depth_times.pop(0)
            session.add_depth(taken, sequence.depth(len(sequence.depth_timestamps) - len(depth_times) - 1))
        pose = session.pose()  # predicted to the newest event; None before the first frame
        if pose is not None:
            print(f"{start:.2f} s: camera at {np.round(pose[:3, 3], 3)} m, {len(session.map)} Gaussians")
    results = session.finish()
    for note in results.notes:
        print(note)
    assert results.folder is not None, "`out` was given"
    print(f"{len(results.trajectory)} poses, map and mesh: {results.folder}")
    return results.folder


if __name__ == "__main__":
    main(*sys.argv[1:2])
