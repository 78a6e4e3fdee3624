"""Baked light: soft shadows of area lamps and ambient occlusion, one small light map per quad."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.ray_casting import RayCaster
from edslam_ti.simulation.scene import LightMaps, SceneBuilder

SPACING = 0.09  # metres between light-map texels of large quads
MAX_TEXELS = 80  # along a side of a light map
LAMP_SAMPLES = 12  # shadow rays per texel and lamp set
AMBIENT_SAMPLES = 24  # occlusion rays per texel
AMBIENT_REACH = 1.2  # metres within which geometry occludes ambient light


@dataclass(frozen=True)
class Lamp:
    """A rectangular light source."""

    centre: tuple[float, float, float]
    half_u: tuple[float, float, float]  # metres
    half_v: tuple[float, float, float]
    normal: tuple[float, float, float]  # direction it shines
    power: float  # radiant exitance times area, arbitrary unit


def bake(builder: SceneBuilder, lamps: list[Lamp], ambient: float, brightness: float, seed: int) -> LightMaps:
    """Return light maps of ambient * openness + sum of lamp light.

    They are scaled so that the mean over all surfaces is `brightness`, and bright spots are rolled off.
    """
    rng = np.random.default_rng(seed)
    plain = builder.build("")
    # Self-luminous quads are lamps and windows; they cast no shadow.
    dark = np.array([not q.material.luminous for q in builder.quads])
    scene = RayCaster(plain.vertices, plain.triangles[dark[plain.surfaces]])

    shapes, points, normals = [], [], []
    for q in builder.quads:
        w, h = (int(np.clip(np.ceil(np.linalg.norm(side) / SPACING), 2, MAX_TEXELS)) for side in (q.u, q.v))
        b, a = np.mgrid[0:h, 0:w]
        a, b = (a.ravel() + 0.5) / w, (b.ravel() + 0.5) / h
        # Texels at the border would lie inside the neighbouring surface.
        a, b = np.clip(a, 0.03, 0.97), np.clip(b, 0.03, 0.97)
        points.append(q.origin + a[:, None] * q.u + b[:, None] * q.v + 0.008 * q.normal)
        normals.append(np.repeat(q.normal[None], w * h, 0))
        shapes.append((h, w))
    P, N = np.concatenate(points), np.concatenate(normals)  # [M, 3]

    light = ambient * _openness(scene, P, N, rng)
    for lamp in lamps:
        light += _direct(scene, P, N, lamp, rng)
    counts = np.array([h * w for h, w in shapes])
    areas = np.array([np.linalg.norm(np.cross(q.u, q.v)) * (not q.material.luminous) for q in builder.quads])
    weights = np.repeat(areas / counts, counts)
    light *= brightness / np.average(light, weights=weights)
    light = np.where(light > 0.7, 0.7 + 0.5 * np.tanh((light - 0.7) / 0.5), light).astype(np.float32)
    ends = np.cumsum(counts)
    return LightMaps([light[e - h * w : e].reshape(h, w) for e, (h, w) in zip(ends, shapes)])


def _openness(
    scene: RayCaster, points: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the cosine-weighted share of nearby directions that are free, [M] in [0, 1]."""
    # Cosine-distributed directions: a point on the unit sphere added to the normal.
    free = np.zeros(len(points))
    sphere = rng.standard_normal((AMBIENT_SAMPLES, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    for direction in sphere:
        d = normals + 0.999 * direction
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        rays = np.concatenate([points, d], 1).astype(np.float32)
        free += np.minimum(scene.cast(rays).distance / AMBIENT_REACH, 1.0)
    return free / AMBIENT_SAMPLES


def _direct(
    scene: RayCaster, points: np.ndarray, normals: np.ndarray, lamp: Lamp, rng: np.random.Generator
) -> np.ndarray:
    """Return the light of one lamp at each point with soft shadows, [M]."""
    total = np.zeros(len(points))
    for _ in range(LAMP_SAMPLES):
        s, t = rng.uniform(-1, 1, 2)
        source = np.array(lamp.centre) + s * np.array(lamp.half_u) + t * np.array(lamp.half_v)
        d = source - points
        distance2 = (d * d).sum(1)
        unit = d / np.sqrt(distance2)[:, None]
        cosines = np.maximum((unit * normals).sum(1), 0) * np.maximum(-(unit @ np.array(lamp.normal)), 0)
        lit = np.flatnonzero(cosines > 1e-4)
        rays = np.concatenate([points[lit], d[lit]], 1).astype(np.float32)
        blocked = scene.is_blocked(rays, near=0.002, far=0.98)
        total[lit] += np.where(blocked, 0.0, cosines[lit] / np.maximum(distance2[lit], 0.05))
    return lamp.power * total / LAMP_SAMPLES
