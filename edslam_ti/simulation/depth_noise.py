"""Noise of a structured-light depth camera (Kinect).

Axial noise after Nguyen et al. 2012, quantised disparity after Handa et al. 2014.
"""

import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.depth_images import beside_edges

MIN_DEPTH, MAX_DEPTH = 0.4, 5.0  # metres
DISPARITY_STEP = 1 / 351.3  # 1/metre: inverse depth is quantised to this (2.8 mm at 1 m, 11 mm at 2 m)
EDGE_STEP = 0.03  # neighbours form an edge beyond this relative depth step
LATERAL_DEVIATION = 0.5  # pixels
DROPOUT = 0.002  # share of pixels lost anywhere
GRAZING_COSINE = (0.10, 0.25)  # returns are lost below the first, kept above the second


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
    height, width = camera.shape
    v, u = np.mgrid[0:height, 0:width]
    jitter = rng.normal(0, LATERAL_DEVIATION, (2, height, width))
    row = np.clip(np.rint(v + jitter[0]), 0, height - 1).astype(int)
    column = np.clip(np.rint(u + jitter[1]), 0, width - 1).astype(int)
    edge = beside_edges(depth, EDGE_STEP)
    z = np.where(edge, depth[row, column], depth).astype(np.float64)  # inside a surface: no jitter

    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    z = z + sigma * rng.standard_normal(z.shape)
    inverse = np.rint(1 / np.maximum(z, 1e-3) / DISPARITY_STEP) * DISPARITY_STEP
    z = 1 / np.maximum(inverse, 1e-3)

    lost = (edge & (rng.random(z.shape) < 0.75)) | (rng.random(z.shape) < DROPOUT)
    low, high = GRAZING_COSINE
    lost |= rng.random(z.shape) > (cosine - low) / (high - low)
    lost |= (depth <= 0) | (z < MIN_DEPTH) | (z > MAX_DEPTH)
    return np.where(lost, 0, z).astype(np.float32)


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
