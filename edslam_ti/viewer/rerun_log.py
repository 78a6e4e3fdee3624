"""A run as a file for the viewer of Rerun: everything of a frame on one time line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import ConfigError, MissingExtraError
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.viewer.moment import Moment
from edslam_ti.viewer.pictures import brightness_picture, event_picture, grey_picture
from edslam_ti.viewer.shapes import PATH_COLOUR, TRUTH_COLOUR, rgb, up_direction

MAP_EVERY = 10  # frames between two copies of the map, of its render and of the path
REFINED_EVERY = 20  # updates while the map is refined between two values of the loss
MILLIMETRES = 1000.0  # depth units per metre
MOST_POINTS = 200_000  # of the map


class RerunLog:
    """Writes events, images, depth, poses, map and numbers of a run into an .rrd file (Viewer)."""

    def __init__(self, path: Path) -> None:
        """Begin the file, or raise EdSlamError where that is impossible."""
        if path.suffix != ".rrd":
            raise ConfigError(f"log: expected a file name that ends in .rrd, got '{path}'")
        try:
            import rerun
        except ModuleNotFoundError as error:
            raise MissingExtraError("--log needs Rerun: pip install 'edslam-ti[rerun]'") from error
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            raise ConfigError(f"log: '{path}' cannot be written: {error.strerror}") from error
        self._rerun: Any = rerun
        self._stream: Any = rerun.RecordingStream("edslam", send_properties=False)
        self._stream.save(path)
        self._last: Moment | None = None
        self._num_updates = 0

    def update(self, moment: Moment) -> None:
        """Write what is new."""
        is_first, self._last = self._last is None, moment
        self._num_updates += 1
        if moment.sample is None and self._num_updates % REFINED_EVERY:
            return
        self._stream.set_time("update", sequence=self._num_updates)
        self._stream.set_time("time", duration=float(moment.trajectory.timestamps[-1]))
        if is_first:
            self._begin(moment)
        self._log_numbers(moment)
        if moment.sample is not None:
            self._log_frame(moment)
            if len(moment.trajectory) % MAP_EVERY == 1:
                self._log_map(moment)

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return at once."""

    def close(self) -> None:
        """Write the final map and path, and end the file."""
        if self._last is not None:
            self._stream.set_time("update", sequence=self._num_updates + 1)
            self._log_map(self._last)
        self._stream.flush()
        self._stream.disconnect()

    # --- what is written ---

    def _begin(self, moment: Moment) -> None:
        log, rerun, camera = self._stream.log, self._rerun, moment.camera
        up = up_direction(moment.trajectory.poses)
        if abs(up).max() == 1:  # an axis
            name = f"RIGHT_HAND_{'XYZ'[int(abs(up).argmax())]}_{'UP' if up.sum() > 0 else 'DOWN'}"
            log("world", getattr(rerun.ViewCoordinates, name), static=True)
        log("world/camera/image", pinhole(rerun, camera), static=True)
        if moment.truth is not None:
            self._log_line("world/truth", moment.truth.poses, TRUTH_COLOUR, static=True)

    def _log_numbers(self, moment: Moment) -> None:
        mapper = moment.mapper
        numbers = {"error_cm": moment.error_cm, "hertz": moment.hertz}
        if mapper is not None:
            numbers |= {"loss": mapper.loss, "gaussians": float(mapper.num_gaussians)}
        for name, value in numbers.items():
            if value is not None and np.isfinite(value):
                self._stream.log(f"numbers/{name}", self._rerun.Scalars(value))

    def _log_frame(self, moment: Moment) -> None:
        sample, log, rerun = moment.sample, self._stream.log, self._rerun
        assert sample is not None
        T = moment.trajectory.pose(-1)
        log("world/camera", rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        log("numbers/events", rerun.Scalars(float(len(sample.events))))
        self._log_picture("events", event_picture(sample.events, moment.camera.shape))
        if sample.depth is not None:
            depth = np.clip(np.rint(MILLIMETRES * sample.depth), 0, 65535).astype(np.uint16)
            log("world/camera/image/depth", rerun.DepthImage(depth, meter=MILLIMETRES))
        if (log_brightness := moment.log_brightness()) is not None:
            self._log_picture("brightness", brightness_picture(log_brightness))

    def _log_map(self, moment: Moment) -> None:
        """Write the path, and the Gaussians as points as large as they are, or the points of another map."""
        self._log_line("world/path", moment.trajectory.poses, PATH_COLOUR)
        mapper = moment.mapper
        if mapper is None:
            return
        points, brightness = mapper.points()
        if len(points) == 0:
            return
        chosen = slice(None, None, max(1, -(-len(points) // MOST_POINTS)))
        radii: Any = 0.005
        if isinstance(gaussians := getattr(mapper, "map", None), GaussianMap):
            radii = gaussians.raw["log_scales"].detach().exp().numpy().mean(1)[chosen]
        grey = np.rint(255 * np.clip(brightness[chosen], 0, 1)).astype(np.uint8)
        colors = np.repeat(grey[:, None], 3, axis=1)
        self._stream.log("world/map", self._rerun.Points3D(points[chosen], radii=radii, colors=colors))
        view = mapper.render(moment.camera, moment.trajectory.pose(-1))
        self._log_picture("render", grey_picture(view.intensity))

    def _log_picture(self, name: str, picture: np.ndarray) -> None:  # [H, W, 3] uint8
        self._stream.log(name, self._rerun.Image(picture).compress(jpeg_quality=90))

    def _log_line(self, name: str, poses: np.ndarray, color: str, static: bool = False) -> None:
        line = self._rerun.LineStrips3D([poses[:, :3, 3]], colors=[rgb(color)])
        self._stream.log(name, line, static=static)


def pinhole(rerun: Any, camera: Camera) -> Any:
    """Return a camera as Rerun has it: the first pixel's centre is at (0.5, 0.5), x right, y down."""
    matrix = camera.matrix
    matrix[:2, 2] += 0.5
    return rerun.Pinhole(
        image_from_camera=matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rerun.ViewCoordinates.RDF,
        image_plane_distance=0.2,
    )
