"""Log-brightness images from events: what a keyframe looked like, without any camera image.

With l the unknown log brightness at the keyframe's time and E_k the change summed up since then
(Eq. 11), the image at time k is l + E_k. A surface point seen at pixel u of the keyframe and at x_k(u)
of frame k keeps its brightness:

    l(u) = l(x_k(u)) + E_k(x_k(u))           for every frame k and pixel u with depth

Linear equations in l alone; x_k comes from depth and poses, l(x) is interpolated. Unlike a time surface
(Eq. 1), which lags its edges by an amount that depends on the motion, such an image belongs to the
surfaces themselves, so that alignment to it is not biased.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.events import Events
from edslam_ti.kernels import brightness_image, time_surface
from edslam_ti.kernels.runtime import check_shape

HYSTERESIS = 0.5  # thresholds
HUBER = 0.1  # log brightness; equations beyond count less (occlusions, reflections, wrong depth)


class BrightnessChange:
    """Log-brightness change of every pixel since the beginning, from events (Eq. 11).

    A pixel's brightness lies up to one threshold C beyond its last event, in that event's direction
    unless it has turned since: C / 2 on average. Without that half threshold a moving edge of contrast g
    per pixel trails by C / 2g pixels, which biases alignment.
    """

    def __init__(self, shape: tuple[int, int], positive: float, negative: float) -> None:
        """`positive` and `negative` are the sensor's thresholds C+ and C-, in log brightness."""
        self._thresholds = np.float32(positive), np.float32(negative)
        self._counts = np.zeros((*shape, 2), np.int32)  # negative and positive events
        self._last = np.zeros(shape, np.int8)  # polarity of the last event

    def add(self, events: Events) -> None:
        """Add events that follow those added before."""
        time_surface.count_events(events.x, events.y, events.polarity, self._counts, self._last)

    def log_brightness(self) -> np.ndarray:  # [H, W] float32
        """Return the change since the beginning."""
        positive, negative = self._thresholds
        beyond = np.float32(HYSTERESIS)
        fell = self._counts[..., 0].astype(np.float32) + beyond * (self._last < 0)
        rose = self._counts[..., 1].astype(np.float32) + beyond * (self._last > 0)
        return positive * rose - negative * fell

    def reset(self) -> None:
        """Begin anew."""
        self._counts[:], self._last[:] = 0, 0


@dataclass(frozen=True)
class Observation:
    """One time at which a keyframe's surfaces were seen."""

    T_camera_keyframe: np.ndarray  # [4, 4]
    change: np.ndarray  # [h, w] log brightness: E_k, since the keyframe (before it: negative time)
    depth: np.ndarray | None  # [h, w] metres, 0 = missing; for occlusion


def solve_log_brightness_image(
    depth: np.ndarray,  # [h, w] of the keyframe, metres, 0 = missing
    camera: Camera,  # of these images
    observations: Sequence[Observation],
    prior: np.ndarray,  # [h, w] log brightness before; stays where nothing was observed
    prior_weight: float = 1e-3,  # against one equation
    iterations: int = 12,
    is_robust: bool = True,
) -> np.ndarray:  # [h, w] float32
    """Return the keyframe's log brightness by conjugate gradients.

    `is_robust`: equations that the prior fits badly count less (Huber).
    """
    check_shape("prior", prior, depth.shape)
    own = brightness_image.ChangeImage(np.zeros(depth.shape, np.float32), depth)
    images = [own, *(brightness_image.ChangeImage(o.change, o.depth) for o in observations)]
    pairs = [brightness_image.Pair(0, k, o.T_camera_keyframe) for k, o in enumerate(observations, 1)]
    image, _ = brightness_image.solve_brightness_image(
        images, pairs, camera.intrinsics, prior, prior_weight, HUBER, iterations, [is_robust]
    )
    return image


def compile_kernels() -> None:
    """Compile what images need, so that the first frames of a sequence need not wait for it."""
    brightness_image.compile_kernels()
    time_surface.compile_kernels()
