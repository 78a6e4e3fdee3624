"""Real cameras: lens distortion by OpenCV's models, and its removal from events, images and depth.

    plumb_bob     k1 k2 p1 p2 [k3]            radial and tangential; ROS' and Kalibr's radtan
    rational      k1 k2 p1 p2 k3 k4 k5 k6     the radial part is a quotient; Azure Kinect
    equidistant   k1 k2 k3 k4                 fisheye (Kannala and Brandt 2006); Kalibr's equidistant

Pixel centres are at integer coordinates. The undistorted camera is a pinhole camera, `Camera`. It may be
turned against the sensor, as rectified stereo cameras are.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.events import Events

# Coefficients of each model in OpenCV's order, and how many are accepted; missing ones are 0.
MODELS = {
    "plumb_bob": ("k1 k2 p1 p2 k3", (4, 5)),
    "rational": ("k1 k2 p1 p2 k3 k4 k5 k6", (8,)),
    "equidistant": ("k1 k2 k3 k4", (4,)),
}
# Names that ROS, Kalibr, OpenCV, Basalt and RealSense give to these models.
MODEL_NAMES = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "radial-tangential": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "pinhole-radtan": "plumb_bob",
    "rational": "rational",
    "rational_polynomial": "rational",
    "pinhole-radtan8": "rational",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "kb4": "equidistant",
    "pinhole-equi": "equidistant",
}
LARGEST_COEFFICIENT = 1000  # coefficients of real lenses are below 10, of quotients below 100
LEAST_SEEN = 0.1  # share of the undistorted image that the sensor must see
NEWTON_STEPS = 20
STEP = 1e-5  # of the numeric derivative
INVERTED = 0.01  # px: how well a ray must hit the pixel that it was computed for
EVENTS_AT_ONCE = 1_000_000  # undistorting takes some 70 bytes per event, its result 13


@dataclass(frozen=True)
class Lens:
    """A pinhole camera behind a distorting lens."""

    pinhole: Camera  # the intrinsics without the distortion
    model: str  # a key of MODELS
    coefficients: tuple[float, ...]  # in OpenCV's order

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise DataError(f"distortion model: expected one of {', '.join(MODELS)}, got '{self.model}'")
        values = np.array(self.coefficients, np.float64)
        names, numbers = MODELS[self.model]
        if len(values) not in numbers:
            raise DataError(
                f"distortion {self.model}: expected {' or '.join(map(str, numbers))} coefficients {names}, "
                f"got {len(values)}"
            )
        if not np.all(np.abs(values) <= LARGEST_COEFFICIENT):  # not so for NaN
            raise DataError(
                f"expected distortion {names} within +-{LARGEST_COEFFICIENT}, got "
                f"{' '.join(f'{v:g}' for v in values)}"
            )

    @property
    def is_distorted(self) -> bool:
        return any(self.coefficients)

    @property
    def best_fit(self) -> Camera:
        """The pinhole camera of the same size and axis that shows as much as possible, and no empty pixel."""
        camera, K, D = self.pinhole, self.pinhole.matrix, np.array(self.coefficients)
        size = (camera.width, camera.height)
        if self.model == "equidistant":
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, D, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(K, D, size, 0)
        return Camera(*size, float(new[0, 0]), float(new[1, 1]), float(new[0, 2]), float(new[1, 2]))

    def maps(
        self,
        target: Camera,  # undistorted
        R_target_sensor: np.ndarray | None = None,  # [3, 3]; None: not turned
    ) -> tuple[np.ndarray, np.ndarray]:  # two [H, W] float32, px
        """Return column and row where the sensor sees the pixels of an undistorted camera."""
        K, D = self.pinhole.matrix, np.array(self.coefficients)
        R = np.eye(3) if R_target_sensor is None else R_target_sensor
        size = (target.width, target.height)
        initialise = cv2.fisheye.initUndistortRectifyMap if self.model == "equidistant" else None
        u, v = (initialise or cv2.initUndistortRectifyMap)(K, D, R, target.matrix, size, cv2.CV_32FC1)
        return u, v

    def project(self, rays: np.ndarray) -> np.ndarray:  # [N, 2] x / z, y / z -> [N, 2] px
        """Return the sensor's pixels of undistorted rays."""
        x, y = rays[:, 0], rays[:, 1]
        r2 = x * x + y * y
        if self.model == "equidistant":
            r = np.sqrt(r2)
            angle = np.arctan(r)
            k1, k2, k3, k4 = self.coefficients
            a2 = angle * angle
            bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
            scale = np.where(r > 1e-8, bent / np.maximum(r, 1e-8), 1.0)
            distorted_x, distorted_y = x * scale, y * scale
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            if self.model == "rational":
                radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        fx, fy, cx, cy = self.pinhole.intrinsics
        return np.stack([fx * distorted_x + cx, fy * distorted_y + cy], -1)

    @cached_property
    def rays(self) -> np.ndarray:  # [H, W, 2] float32
        """Undistorted ray (x / z, y / z) of every sensor pixel; NaN where the model has none (Newton)."""
        camera = self.pinhole
        wanted = np.indices(camera.shape)[::-1].reshape(2, -1).T.astype(np.float64)  # px
        start = (wanted - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        rays, open_ = start.copy(), np.arange(len(wanted))
        if self.model == "equidistant":  # the ray of the lens without coefficients: radius = angle
            angle = np.minimum(np.linalg.norm(start, axis=1), 1.5)
            rays *= (np.tan(angle) / np.maximum(angle, 1e-9))[:, None]
        for _ in range(NEWTON_STEPS):
            at = rays[open_]
            with np.errstate(all="ignore"):
                own = self.project(at)
                missing = wanted[open_] - own
                far = ~(np.abs(missing).max(1) < 0.1 * INVERTED)
                open_, at, own, missing = open_[far], at[far], own[far], missing[far]
                if not len(open_):
                    break
                rays[open_] = at + self._newton_step(at, own, missing)
        rays[~np.isfinite(rays).all(1)] = 0
        hit = np.abs(self.project(rays) - wanted).max(1) < INVERTED
        rays[~hit] = np.nan
        return rays.reshape(*camera.shape, 2).astype(np.float32)

    def _newton_step(self, at: np.ndarray, own: np.ndarray, missing: np.ndarray) -> np.ndarray:  # [N, 2] each
        """Return the change of rays that moves their pixels by `missing`, of limited length."""
        columns = [(self.project(at + d) - own) / STEP for d in ((STEP, 0), (0, STEP))]
        (a, c), (b, d) = columns[0].T, columns[1].T
        moved = np.stack([d * missing[:, 0] - b * missing[:, 1], a * missing[:, 1] - c * missing[:, 0]], -1)
        moved /= (a * d - b * c)[:, None]
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        limit = 0.5 * (1 + np.linalg.norm(at, axis=1, keepdims=True))  # do not leap over the lens's fold
        result: np.ndarray = moved * np.minimum(1, limit / np.maximum(length, 1e-12))
        return result


class Undistortion:
    """What a pinhole camera would have measured in the place of a sensor with a lens."""

    def __init__(
        self,
        lens: Lens,
        camera: Camera | None = None,  # undistorted; None: the lens's own intrinsics
        R_camera_sensor: np.ndarray | None = None,  # [3, 3]; None: not turned
    ) -> None:
        """Raise `DataError` where the sensor sees too little of the undistorted image to be a lens."""
        self.camera = camera or lens.pinhole
        self.lens = lens
        self._maps = lens.maps(self.camera, R_camera_sensor)
        self.events = EventUndistortion(*self._maps, (lens.pinhole.width, lens.pinhole.height))
        if self.events.share_seen < LEAST_SEEN:
            raise DataError(
                f"expected distortion {MODELS[lens.model][0]} of a lens, got one that shows "
                f"{100 * self.events.share_seen:.0f} % of the undistorted image: "
                f"{' '.join(f'{v:g}' for v in lens.coefficients)}"
            )

    def image(self, image: np.ndarray) -> np.ndarray:  # [H, W]
        """Return a grey image, bilinearly interpolated; pixels that the sensor does not see are 0."""
        return np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR))

    def depth(self, depth: np.ndarray) -> np.ndarray:  # [H, W] m, 0 = missing
        """Return a depth image of the nearest measurements: depth is not interpolated across edges.

        Only for cameras that are not turned: their depth is along the same axis.
        """
        return np.asarray(cv2.remap(depth, *self._maps, interpolation=cv2.INTER_NEAREST))


class EventUndistortion:
    """Nearest-neighbour remapping of events, from each undistorted pixel to its sensor pixel.

    Moving every event to the nearest undistorted pixel instead would leave curves of pixels without events,
    and give others the events of two pixels, so that their brightness seems to change twice as much.
    Tables take 8 bytes a pixel: 7 MB for 1280x720.
    """

    def __init__(
        self,
        u: np.ndarray,  # [H, W] float32, column where the sensor sees the undistorted pixel
        v: np.ndarray,  # [H, W] float32, row
        size: tuple[int, int] | None = None,  # width, height of the sensor; None: the undistorted image's
    ) -> None:
        self._columns = u.shape[1]
        width, height = size or (u.shape[1], u.shape[0])
        self._width = int(width)
        with np.errstate(invalid="ignore"):
            x, y = np.rint(u).ravel(), np.rint(v).ravel()
            is_seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        self.share_seen = float(is_seen.mean())  # of the undistorted pixels
        seen = np.flatnonzero(is_seen)
        source = y[seen].astype(np.int32) * self._width + x[seen].astype(np.int32)
        order = np.argsort(source, kind="stable")
        self._targets = seen[order].astype(np.int32)  # undistorted pixels, sorted by the sensor's pixel
        number = np.bincount(source, minlength=height * self._width)
        first = np.append(0, np.cumsum(number))  # first target of each sensor pixel
        self._first = first.astype(np.int32)  # [H W + 1]

    def __call__(self, events: Events) -> Events:
        """Return the events as an undistorted camera would have sent them, in the same order."""
        return Events.concatenate([self._undistorted(piece) for piece in events.pieces(EVENTS_AT_ONCE)])

    def _undistorted(self, events: Events) -> Events:
        pixel = events.y.astype(np.int32) * self._width + events.x
        first = self._first[pixel]
        number = self._first[pixel + 1] - first
        event = np.repeat(np.arange(len(pixel)), number)
        rank = np.arange(len(event)) - np.repeat(np.cumsum(number) - number, number)
        y, x = np.divmod(self._targets[first[event] + rank], self._columns)
        return Events(x.astype(np.int16), y.astype(np.int16), events.t[event], events.polarity[event])


def model_name(name: str) -> str:
    """Return the model that a calibration file means; raise `DataError` for an unknown one."""
    key = name.strip().lower().replace(" ", "_")
    if key not in MODEL_NAMES:
        raise DataError(f"distortion model: expected one of {', '.join(MODEL_NAMES)}, got '{name}'")
    return MODEL_NAMES[key]
