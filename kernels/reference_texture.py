"""Numpy twins of kernels.texture: rays of a camera, shading of their hits, and edges of surfaces."""

import numpy as np

from edslam_ti.kernels.texture import INVALID, MAX_TAPS, TextureTable, TriangleTable


def pixel_rays(
    T_world_camera: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],
    width: int,
    pixels: np.ndarray,  # [M] row-major indices
    offsets: np.ndarray,  # [S, 2] pixels from the centre
) -> np.ndarray:  # [M * S, 6] origin, direction
    """Return the rays of all samples of all pixels; their directions have z = 1 in the camera's frame."""
    fx, fy, cx, cy = intrinsics
    at = np.stack([pixels % width, pixels // width], -1)[:, None] + offsets  # [M, S, 2]
    directions = np.stack(
        [(at[..., 0] - cx) / fx, (at[..., 1] - cy) / fy, np.ones(at.shape[:2])], -1
    ).reshape(-1, 3)
    origins = np.tile(T_world_camera[:3, 3], (len(directions), 1))
    return np.concatenate([origins, directions @ T_world_camera[:3, :3].T], 1)


def shade(
    rays: np.ndarray,  # [N, 6]
    distance: np.ndarray,  # [N]
    primitive: np.ndarray,  # [N], INVALID where nothing is hit
    barycentric: np.ndarray,  # [N, 2]
    pixel_steps: np.ndarray,  # [2, 3]
    triangles: TriangleTable,
    textures: TextureTable,
    background: float,
) -> tuple[np.ndarray, np.ndarray]:  # [N] grey, [N] surface (-1: none)
    """Return tint * texture * light map of each hit, the texture averaged over the pixel's parallelogram."""
    grey, surfaces = np.full(len(rays), background), np.full(len(rays), -1)
    for r in np.flatnonzero(primitive != INVALID):
        row = triangles.values[primitive[r]].astype(float)
        corners, G, normal, tints, lights = np.split(row, [6, 12, 15, 18])
        texture, light, surfaces[r] = triangles.indices[primitive[r]]
        share = np.array([1 - barycentric[r].sum(), *barycentric[r]])
        value = share @ tints
        if texture >= 0:
            direction = rays[r, 3:]
            facing = normal @ direction
            facing = facing if abs(facing) >= 1e-6 else 1e-6
            moves = [distance[r] * (step - direction * (normal @ step) / facing) for step in pixel_steps]
            sides = [G.reshape(2, 3) @ move for move in moves]  # texels a pixel
            value *= filtered(textures, texture, share @ corners.reshape(3, 2), sides)
        if light >= 0:
            size = textures.levels[light, 0, 1:]
            value *= look_up(textures, light, 0, False, share @ lights.reshape(3, 2) / size)
        grey[r] = np.clip(value, 0, 1)
    return grey, surfaces


def filtered(
    textures: TextureTable,
    texture: int,
    uv: np.ndarray,  # [2] texels
    sides: list[np.ndarray],  # two of [2] texels: the parallelogram that a pixel covers
) -> float:
    """Return the anisotropic average: up to MAX_TAPS trilinear look-ups along the longer side."""
    lengths = [float(np.linalg.norm(side)) for side in sides]
    longer, major, minor = sides[0], lengths[0], lengths[1]
    if minor > major:
        longer, major, minor = sides[1], minor, major
    taps = int(np.clip(np.ceil(major / max(minor, 1.0) - 0.25), 1, MAX_TAPS))
    coarse = max(minor, major / taps, 1.0)  # texels that one look-up has to average
    lod = np.clip(np.log2(coarse), 0, textures.num_levels[texture] - 1)
    level, repeat = int(lod), bool(textures.repeat[texture])
    total = 0.0
    for k in range(taps):
        at = (uv + ((k + 0.5) / taps - 0.5) * longer) / textures.levels[texture, 0, 1:]
        value = look_up(textures, texture, level, repeat, at)
        if lod - level > 0.01:
            above = look_up(textures, texture, level + 1, repeat, at)
            value += (lod - level) * (above - value)
        total += value
    return total / taps


def look_up(textures: TextureTable, texture: int, level: int, repeat: bool, at: np.ndarray) -> float:
    """Return one level, bilinearly, at shares of the texture's width and height; texel i covers [i, i+1)."""
    offset, width, height = textures.levels[texture, level]
    image = textures.texels[offset : offset + width * height].reshape(height, width)
    x, y = at * (width, height) - 0.5
    columns, rows = (int(np.floor(p)) + np.arange(2) for p in (x, y))
    if repeat:
        columns, rows = columns % width, rows % height
    corners = image[np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))].astype(float)
    right, down = x - np.floor(x), y - np.floor(y)
    return float([1 - down, down] @ corners @ [1 - right, right])


def mark_edges(grey: np.ndarray, surface: np.ndarray, contrast: float) -> np.ndarray:  # [H, W] each
    """Return 1 where one of the 8 neighbours shows another surface of visibly different brightness."""
    height, width = grey.shape
    edges = np.zeros(grey.shape, np.uint8)
    for y, x in np.ndindex(height, width):
        around = (slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2))
        differs = np.abs(grey[around] - grey[y, x]) > contrast * (grey[around] + grey[y, x])
        edges[y, x] = (differs & (surface[around] != surface[y, x])).any()
    return edges
