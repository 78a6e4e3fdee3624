"""Open3D's RGB-D odometry (a tracker) and its TSDF volume (a mapper).

The methods combine library functions; they are not a published system. `open3d_rgbd` aligns each frame to a
reference frame by brightness and depth (Park et al. 2017) and fuses it into a volume (Curless and Levoy
1996). It uses no events and needs images, which an event camera may not have. `open3d_icp` aligns depth
alone: point-to-plane alignment with projective association (Newcombe et al. 2011). Open3D sums in parallel,
so two runs agree to about a micrometre, not bit for bit.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.errors import DataError
from edslam_ti.frame import Frame
from edslam_ti.geometry import orthonormalized, rotation_angle_deg
from edslam_ti.mapping.mapper import Progress
from edslam_ti.mapping.rendering import View
from edslam_ti.mapping.volume import MeshView, TsdfVolume
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.tracking.tracker import TrackingResult
from edslam_ti.trajectory import Trajectory

MAX_DEPTH = 10.0  # metres
VOXEL_SIZE = 0.02  # metres
ITERATIONS = (10, 5, 3)  # coarse to fine, Open3D's default
MIN_FITNESS = 0.3  # fraction of matched pixels below which tracking has failed
# The reference is kept until the camera has moved this far. Open3D matches whole pixels, which hides smaller
# motions: with alignment from frame to frame the drift is several times larger.
REFERENCE_DISTANCE = 0.1  # metres
REFERENCE_ANGLE = 6.0  # degrees


class OdometryTracker:
    """Aligns each frame to a reference frame by an Open3D odometry `method` (Tracker)."""

    def __init__(self, camera: Camera, method: str) -> None:
        """`method`: Hybrid (brightness and depth) or PointToPlane (depth alone, no image needed)."""
        self._intrinsics = load_open3d().core.Tensor(camera.matrix)
        self._method = method
        self._reference: tuple[Any, np.ndarray] | None = None  # RGB-D image, T_world_camera

    def track(self, frame: Frame, T_world_camera_guess: np.ndarray, trajectory: Trajectory) -> TrackingResult:
        """Return the pose of `frame`; without depth or image, the guess, marked as lost."""
        needs_image = self._method != "PointToPlane"
        if frame.depth is None or (needs_image and frame.image is None):
            missing = "depth image" if frame.depth is None else "image"
            return TrackingResult(
                T_world_camera_guess, False, 0.0, f"no {missing} at this time: pose predicted"
            )
        image = frame.image if needs_image and frame.image is not None else np.zeros_like(frame.depth)
        current = _rgbd_image(frame.depth, image)
        if self._reference is None:
            self._reference = current, T_world_camera_guess
            return TrackingResult(T_world_camera_guess, True, 1.0)
        reference, T_world_reference = self._reference
        T_guess = np.linalg.inv(T_world_reference) @ T_world_camera_guess
        T_reference_camera, fitness = self._align(current, reference, T_guess)
        converged = fitness >= MIN_FITNESS
        pose = orthonormalized(T_world_reference @ T_reference_camera) if converged else T_world_camera_guess
        distance = np.linalg.norm(T_reference_camera[:3, 3])
        if (
            not converged
            or distance > REFERENCE_DISTANCE
            or rotation_angle_deg(T_reference_camera) > REFERENCE_ANGLE
        ):
            self._reference = current, pose
        message = "" if converged else f"only {fitness:.0%} of pixels found a partner: pose predicted"
        return TrackingResult(pose, converged, fitness, message)

    def consistency(self, trajectory: Trajectory) -> None:
        """Return None: it does not compare its data."""

    def _align(self, current: Any, reference: Any, T_guess: np.ndarray) -> tuple[np.ndarray, float]:
        """Return T_reference_camera and the fraction of pixels that support it."""
        o3d = load_open3d()
        odometry = o3d.t.pipelines.odometry
        try:
            result = odometry.rgbd_odometry_multi_scale(
                current,
                reference,
                self._intrinsics,
                o3d.core.Tensor(T_guess),
                depth_scale=1.0,
                depth_max=MAX_DEPTH,
                criteria_list=[odometry.OdometryConvergenceCriteria(n) for n in ITERATIONS],
                method=getattr(odometry.Method, self._method),
            )
        except RuntimeError:  # Open3D raises it for a singular system: nothing to align
            return T_guess, 0.0
        return result.transformation.numpy(), float(result.fitness)


class RgbdOdometryTracker(OdometryTracker):
    """Aligns brightness and depth together."""

    def __init__(self, sequence: EventDepthSequence) -> None:
        """Check that the sequence has images at the times of depth."""
        require_images(sequence, "open3d_rgbd")
        super().__init__(sequence.camera, "Hybrid")


def require_images(sequence: EventDepthSequence, method: str) -> None:
    """Raise DataError unless a sequence has images at the times of depth."""
    depth_times, image_times = sequence.depth_timestamps, sequence.image_timestamps
    gaps = np.abs(depth_times[:, None] - image_times[None]).min(1, initial=np.inf)  # [D] seconds
    if np.count_nonzero(gaps <= 1e-3) < 2:
        other = "ed_slam" if sequence.has_events else "open3d_icp"
        raise DataError(
            f"{sequence.scene}: method {method} needs images taken with the depth images, got "
            f"{len(image_times)} images and {len(depth_times)} depth images, fewer than 2 of them "
            f"within 1 ms of each other; use --method {other}"
        )


class TsdfMapper:
    """Fuses tracked RGB-D frames into a signed distance volume (Mapper)."""

    num_gaussians = 0
    loss = float("nan")

    def __init__(self, camera: Camera) -> None:
        self._volume = TsdfVolume(camera, VOXEL_SIZE, MAX_DEPTH)
        self._view: MeshView | None = None  # of the present volume

    def update(self, frame: Frame, trajectory: Trajectory) -> None:
        """Fuse the newest frame, unless it is held out or lacks depth or image."""
        if frame.is_held_out or frame.depth is None or frame.image is None:
            return
        self._volume.integrate(frame.depth, frame.image, trajectory.pose(-1))
        self._view = None

    def forget_depth(self, frames: Sequence[int], trajectory: Trajectory) -> None:
        """Leave the volume as it is: what is fused cannot be taken out. Its trackers trust all depth."""

    def finish(self, trajectory: Trajectory, progress: Progress) -> None:
        """Do nothing: there is nothing to refine."""
        progress(1.0)

    def render(self, camera: Camera, T_world_camera: np.ndarray, measured_only: bool = False) -> View:
        """Return the fused surface seen from a pose."""
        if self._view is None:
            self._view = MeshView(self._volume.mesh())
        brightness, depth = self._view.render(camera, T_world_camera)
        return View(brightness, depth, (depth > 0).astype(np.float32))

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices of the fused surface [N, 3] and their brightness [N]."""
        mesh = self._volume.mesh()
        return np.asarray(mesh.vertices), np.asarray(mesh.vertex_colors).reshape(-1, 3).mean(1)

    @property
    def map(self) -> TsdfVolume:
        """The volume."""
        return self._volume

    def keyframe_indices(self) -> list[int]:
        """Return an empty list: every frame is fused, none is chosen as a keyframe."""
        return []

    def metrics(self) -> dict[str, int | float | None]:
        """Return no metrics: the volume has none of its own."""
        return {}

    def save(self, folder: Path) -> None:
        """Write nothing: the volume's points and mesh are written for every mapper."""


def _rgbd_image(depth: np.ndarray, image: np.ndarray) -> Any:
    """Return Open3D's RGB-D image of depth [H, W] in metres and brightness [H, W] in [0, 1]."""
    o3d = load_open3d()
    grey = np.repeat(image[..., None], 3, axis=-1)  # [H, W, 3]
    usable = np.where((depth > 0) & (depth < MAX_DEPTH), depth, 0)
    return o3d.t.geometry.RGBDImage(
        o3d.t.geometry.Image(np.ascontiguousarray(grey, np.float32)),
        o3d.t.geometry.Image(np.ascontiguousarray(usable, np.float32)),
    )
