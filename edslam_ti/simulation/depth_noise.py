"""What a depth sensor with faults measures: noise, quantisation, flying pixels at edges, and holes.

Axial noise after Nguyen et al. 2012, quantised disparity after Handa et al. 2014; docs/sensors.md.
"""

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.depth_images import beside_edges
from edslam_ti.sensor_config import DEPTH_PRESETS, DepthSensor

EDGE_STEP = 0.03  # neighbours form an edge beyond this relative depth step


def kinect_depth(
    depth: np.ndarray,  # [H, W] float32 metres, exact, 0 = missing
    cosine: np.ndarray,  # [H, W] of the angle between viewing ray and surface normal
    camera: Camera,
    rng: np.random.Generator,
) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
    """Return depth as a Kinect would measure it.

    Edge pixels take a neighbour's depth (lateral jitter). All pixels get axial noise of 1.2 mm +
    1.9 mm (z - 0.4)^2 and quantised disparity. Most pixels at depth edges and grazing angles are lost, and
    all beyond 5 m.
    """
    return measured_depth(depth, cosine, None, camera, DEPTH_PRESETS["kinect"], rng)


def measured_depth(
    depth: np.ndarray,  # [H, W] float32 metres, exact, 0 = missing
    cosine: np.ndarray,  # [H, W] of the angle between viewing ray and surface normal
    grey: np.ndarray | None,  # [H, W] brightness; None: surfaces are bright
    camera: Camera,
    sensor: DepthSensor,
    rng: np.random.Generator,
) -> np.ndarray:  # [H, W] float32 metres, 0 = missing
    """Return depth as a sensor would measure it; where it stands and when is not considered here."""
    edge = beside_edges(depth, EDGE_STEP)
    z = depth.astype(np.float64)
    if sensor.lateral_noise > 0:  # inside a surface: no jitter
        z = np.where(edge, _jittered(depth, sensor.lateral_noise, camera, rng), depth).astype(np.float64)

    if sensor.axial_noise > 0 or sensor.axial_growth > 0:
        sigma = sensor.axial_noise + sensor.axial_growth * (z - sensor.noise_from) ** 2
        z = z + sigma * _noise(z.shape, sensor.noise_width, rng)
    if sensor.disparity_step > 0:
        step = sensor.disparity_step
        inverse = np.rint(1 / np.maximum(z, 1e-3) / step) * step
        z = 1 / np.maximum(inverse, 1e-3)

    lost = np.zeros(z.shape, bool)
    if sensor.edge_loss > 0:
        lost |= edge & (rng.random(z.shape) < sensor.edge_loss)
    if sensor.dropout > 0:
        lost |= _holes(z.shape, sensor.dropout, sensor.hole_size, rng)
    low, high = sensor.grazing_loss
    if high > low:
        lost |= rng.random(z.shape) > (cosine - low) / (high - low)
    if sensor.flying_pixels > 0:
        flying = edge & (rng.random(z.shape) < sensor.flying_pixels)
        z = np.where(flying, _between(depth, rng), z)
    if sensor.dark_loss > 0 and grey is not None:
        least = sensor.dark_loss * depth.astype(np.float64) ** 2
        lost |= grey < 2 * least * rng.random(z.shape)
    lost |= (depth <= 0) | (z < sensor.nearest) | (z > sensor.farthest)
    return np.where(lost, 0, z).astype(np.float32)


def _jittered(depth: np.ndarray, deviation: float, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Return the depth of pixels that are displaced at random."""
    height, width = camera.shape
    v, u = np.mgrid[0:height, 0:width]
    jitter = rng.normal(0, deviation, (2, height, width))
    row = np.clip(np.rint(v + jitter[0]), 0, height - 1).astype(int)
    column = np.clip(np.rint(u + jitter[1]), 0, width - 1).astype(int)
    moved: np.ndarray = depth[row, column]
    return moved


def _noise(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> np.ndarray:
    """Return noise of standard deviation 1 that is alike over some pixels."""
    noise = rng.standard_normal(shape)
    if width == 0:
        return noise
    blurred = cv2.GaussianBlur(noise, (0, 0), width)
    # The sum of squares of a Gaussian's weights is 1 / (4 pi width^2).
    return np.asarray(blurred * np.sqrt(4 * np.pi) * width)


def _holes(shape: tuple[int, ...], share: float, size: float, rng: np.random.Generator) -> np.ndarray:
    """Return a share of the pixels, in patches of a size."""
    if size == 0:
        return rng.random(shape) < share
    field = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), size / 2)
    return np.asarray(field > np.quantile(field, 1 - share))


def _between(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:  # [H, W] float64 m
    """Return depths between the nearest and the farthest surface around each pixel."""
    missing = depth <= 0
    kernel = np.ones((3, 3), np.uint8)
    far = cv2.dilate(depth, kernel).astype(np.float64)
    near = cv2.erode(np.where(missing, np.float32(np.inf), depth), kernel).astype(np.float64)
    near = np.where(np.isfinite(near), near, far)
    return np.asarray(near + (far - near) * rng.random(depth.shape))


def viewing_cosine(
    depth: np.ndarray,  # [H, W] metres, exact, 0 = missing
    camera: Camera,
) -> np.ndarray:  # [H, W] in [0, 1]
    """Return the cosine between viewing ray and surface normal, computed from exact depth.

    Tangents are differences to the neighbour that is nearer in depth, so that steps do not tilt surfaces.
    """
    rays = camera.rays()
    points = rays * depth.astype(np.float64)[..., None]  # [H, W, 3]
    tangents = []
    for axis in (1, 0):
        forward = np.diff(points, axis=axis, append=np.take(points, [-1], axis))
        backward = np.diff(points, axis=axis, prepend=np.take(points, [0], axis))
        # Beyond the border the difference is zero and is never chosen.
        size = [np.where(np.abs(d).sum(-1) > 0, np.abs(d[..., 2]), np.inf) for d in (forward, backward)]
        tangents.append(np.where((size[0] <= size[1])[..., None], forward, backward))
    normals = np.cross(tangents[0], tangents[1])
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(rays, axis=-1)
    cosine = np.abs((normals * rays).sum(-1)) / np.maximum(lengths, 1e-12)
    return np.where(depth > 0, cosine, 0.0)
