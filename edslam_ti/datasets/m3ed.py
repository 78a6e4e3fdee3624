"""M3ED (Chaney et al. 2023): Prophesee EVK4 (1280x720) on car, drone and robot; depth from lidar maps.

    <name>_data.h5 (or <name>.h5)    prophesee/left/{x,y,t,p}, ms_map_idx,
                                     prophesee/left/calib/{intrinsics, distortion_coeffs, distortion_model,
                                     resolution}; ovc/imu/{accel, omega, ts}
    <name>_depth_gt.h5               depth/prophesee/left [N, 720, 1280] m, inf = missing; ts [N] us;
                                     Cn_T_C0 [N, 4, 4]
    <name>_pose_gt.h5                ts, Cn_T_C0

Events and depth are distorted alike, and undistorted here, depth by its nearest measurement. Cn_T_C0 maps
points of the first camera to camera n, so that T_world_camera is its inverse. Depth is that of a moving
lidar, collected over time: it is sparse, and moving objects leave trails.
"""

from pathlib import Path

import numpy as np

from edslam_ti.datasets.hdf5 import Hdf5File, only_file
from edslam_ti.datasets.imu import in_order
from edslam_ti.datasets.recording import Recording
from edslam_ti.datasets.truth import check_rigid
from edslam_ti.event_files import open_events
from edslam_ti.geometry import inverse, orthonormalized
from edslam_ti.lenses import Undistortion
from edslam_ti.trajectory import in_order as poses_in_order

CAMERA = "prophesee/left"
MICROSECONDS = 1e6
TRUTH_ENDS = ("_depth_gt.h5", "_pose_gt.h5", "_semantics.h5", "_gt.h5")


class M3edSequence(Recording):
    """A folder of M3ED with one recording."""

    dataset = "m3ed"

    def __init__(self, folder: Path, needs_depth: bool = True) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: sequence folder not found")
        event_file = _event_file(folder)
        if event_file is None:
            event_file = only_file(folder, "*_data.h5", "events")
        name = event_file.name.removesuffix(".h5").removesuffix("_data")
        data = Hdf5File(event_file)
        lens = data.kalibr_lens(f"{CAMERA}/calib")
        events = open_events(event_file, (lens.pinhole.width, lens.pinhole.height), group=CAMERA)
        super().__init__(folder, events, Undistortion(lens, lens.best_fit), "M3ED")
        depth_file, pose_file = (folder / f"{name}_{kind}_gt.h5" for kind in ("depth", "pose"))
        if depth_file.is_file():
            depth = Hdf5File(depth_file)
            self.set_depth(
                depth.times("ts", MICROSECONDS),
                lambda k: self._undistortion.depth(depth.depth(f"depth/{CAMERA}", k, lens.pinhole)),
                depth_file.name,
            )
        for path in (pose_file, depth_file):
            if path.is_file():
                self._find_poses(Hdf5File(path))
                break
        if "ovc/imu/accel" in data:
            times = data.read("ovc/imu/ts").astype(np.float64) / MICROSECONDS
            imu = in_order(
                times,
                data.read("ovc/imu/omega").astype(np.float64),
                data.read("ovc/imu/accel").astype(np.float64),
            )
            self.set_imu(imu, "ovc/imu/ts")
        self.finish(needs_depth, f"no depth: expected {depth_file.name}")

    def _find_poses(self, file: Hdf5File) -> None:
        motions = file.read("Cn_T_C0").astype(np.float64)  # [N, 4, 4] T_camera_first
        rows = np.arange(len(motions))
        check_rigid(motions, file.path, rows)
        poses = inverse(np.array([orthonormalized(T) for T in motions]))
        truth, notes = poses_in_order(
            file.read("ts").astype(np.float64) / MICROSECONDS, poses, rows, file.path
        )
        self.notes.extend(notes)
        self.set_truth(truth, file.path.name)


def _event_file(folder: Path) -> Path | None:
    """Return <name>_data.h5, or the only <name>.h5 that has a <name>_depth_gt.h5 or _pose_gt.h5 beside it."""
    if any(folder.glob("*_data.h5")):
        return only_file(folder, "*_data.h5", "events")
    for path in sorted(folder.glob("*.h5")):
        if not path.name.endswith(TRUTH_ENDS) and any(
            (folder / f"{path.stem}_{kind}_gt.h5").is_file() for kind in ("depth", "pose")
        ):
            return path
    return None


def is_m3ed(folder: Path) -> bool:
    """Return whether a folder holds events where this layout has them."""
    return _event_file(folder) is not None
