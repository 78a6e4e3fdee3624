"""Reads the true views off the path that simulated recordings have, for evaluation only.

novel_views/images/frameNNNNNN.png     NNNNNN = milliseconds of the nearby pose on the path
novel_views/depth/frameNNNNNN.png      depth of the same views
novel_views/traj.txt                   T_world_camera of every view (16 numbers a line), in the files' order
"""

from pathlib import Path

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import NovelView
from edslam_ti.datasets.depth import DepthFormat, read_depth
from edslam_ti.datasets.files import numbered_files, read_image
from edslam_ti.datasets.truth import read_poses
from edslam_ti.errors import DataError


def read_novel_views(
    folder: Path,  # of the recording
    camera: Camera,
    format: DepthFormat,
    shift: float,  # s, subtracted from the stamps
) -> list[NovelView]:
    """Return the novel views in the order of time; empty if there are none."""
    folder = folder / "novel_views"
    if not folder.is_dir():
        return []
    images, depths = (numbered_files(folder / name, "frame*", (".png",)) for name in ("images", "depth"))
    poses, _ = read_poses(folder / "traj.txt")
    if list(images) != list(depths) or len(images) != len(poses):
        raise DataError(
            f"{folder}: expected an image, a depth image of the same name and a pose for every view, got "
            f"{len(images)} images, {len(depths)} depth images and {len(poses)} poses"
        )
    return [
        NovelView(
            ms / 1000 - shift, read_image(images[ms], camera), read_depth(depths[ms], camera, format), T
        )
        for ms, T in zip(images, poses)
    ]
