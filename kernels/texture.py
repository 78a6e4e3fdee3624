"""Rays of a pinhole camera and the brightness at their hits, filtered to the size of a pixel.

A ray x(t) = o + t d with d = R ((u - cx)/fx, (v - cy)/fy, 1) hits a plane with normal n. Moving the
pixel by du turns d by dd = R[:, 0] / fx, and the hit point moves by

    dx = t (dd - d (n . dd) / (n . d)),

so with the gradient G [2, 3] of the texture coordinates along the triangle, a pixel covers the parallelogram
(G dx_u, G dx_v) of texels. Up to MAX_TAPS trilinear look-ups along its longer side average it, each in the
mip level that matches its share (anisotropic filtering).
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.kernels.engine import ti
from edslam_ti.kernels.runtime import check_shape

MAX_TAPS = 4
INVALID = 0xFFFFFFFF  # Open3D's primitive id of a ray that hits nothing


@dataclass(frozen=True)
class TextureTable:
    """Grey textures with their mip levels in one flat buffer."""

    texels: np.ndarray  # [B] float32, all levels of all textures, row-major
    levels: np.ndarray  # [K, L, 3] int32: offset, width, height of each level
    num_levels: np.ndarray  # [K] int32
    repeat: np.ndarray  # [K] int32, 1: tiled; 0: clamped at its borders


@dataclass(frozen=True)
class TriangleTable:
    """Data of each triangle for shading; texture coordinates in texels, texel i covers [i, i+1)."""

    values: np.ndarray  # [T, 24] float32: uv of 3 corners, G [2, 3], normal, tint of 3 corners, light uv of 3
    indices: np.ndarray  # [T, 3] int32: texture (-1: none), light map (-1: none), surface


@ti.func
def _wrapped(index: ti.i32, size: ti.i32, repeat: ti.i32) -> ti.i32:
    result = ti.math.clamp(index, 0, size - 1)
    if repeat == 1 and result != index:
        result = index % size  # Python's sign: never negative
    return result


@ti.func
def _bilinear(
    texels: ti.template(),
    levels: ti.template(),
    texture: ti.i32,
    level: ti.i32,
    repeat: ti.i32,
    u: ti.f32,
    v: ti.f32,
):
    """Look up one level at (u, v) given in shares of the texture's width and height."""
    offset, w, h = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
    x = u * ti.cast(w, ti.f32) - ti.f32(0.5)
    y = v * ti.cast(h, ti.f32) - ti.f32(0.5)
    x_floor, y_floor = ti.floor(x), ti.floor(y)
    a, b = x - x_floor, y - y_floor
    i, j = ti.cast(x_floor, ti.i32), ti.cast(y_floor, ti.i32)
    left, right = _wrapped(i, w, repeat), _wrapped(i + 1, w, repeat)
    upper, lower = offset + w * _wrapped(j, h, repeat), offset + w * _wrapped(j + 1, h, repeat)
    top = (1 - a) * texels[upper + left] + a * texels[upper + right]
    bottom = (1 - a) * texels[lower + left] + a * texels[lower + right]
    return (1 - b) * top + b * bottom


@ti.kernel
def _pixel_rays(
    rotation: ti.types.matrix(3, 3, ti.f32),
    origin: ti.types.vector(3, ti.f32),
    intrinsics: ti.types.vector(4, ti.f32),
    width: ti.i32,
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [M] flat pixel index
    offsets: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [S, 2] pixels from the centre
    rays: ti.types.ndarray(dtype=ti.f32, ndim=2),  # out [M * S, 6]
):
    samples = offsets.shape[0]
    for r in range(rays.shape[0]):
        pixel = pixels[r // samples]
        s = r % samples
        x = (ti.cast(pixel % width, ti.f32) + offsets[s, 0] - intrinsics[2]) / intrinsics[0]
        y = (ti.cast(pixel // width, ti.f32) + offsets[s, 1] - intrinsics[3]) / intrinsics[1]
        for k in ti.static(range(3)):
            rays[r, k] = origin[k]
            rays[r, 3 + k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]


@ti.kernel
def _shade(
    rays: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [N, 6]
    distance: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [N]
    primitive: ti.types.ndarray(dtype=ti.u32, ndim=1),  # [N]
    barycentric: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [N, 2]
    step_u: ti.types.vector(3, ti.f32),  # dd of one pixel (or sample) to the right
    step_v: ti.types.vector(3, ti.f32),  # and down
    values: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [T, 24]
    indices: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [T, 3]
    texels: ti.types.ndarray(dtype=ti.f32, ndim=1),
    levels: ti.types.ndarray(dtype=ti.i32, ndim=3),
    num_levels: ti.types.ndarray(dtype=ti.i32, ndim=1),
    repeats: ti.types.ndarray(dtype=ti.i32, ndim=1),
    background: ti.f32,
    grey: ti.types.ndarray(dtype=ti.f32, ndim=1),  # out [N]
    surface: ti.types.ndarray(dtype=ti.i32, ndim=1),  # out [N]
):
    for r in range(grey.shape[0]):
        value = background
        hit_surface = -1
        triangle = ti.cast(primitive[r], ti.i32)  # INVALID becomes -1
        if triangle >= 0:
            b1, b2 = barycentric[r, 0], barycentric[r, 1]
            b0 = 1 - b1 - b2
            value = b0 * values[triangle, 15] + b1 * values[triangle, 16] + b2 * values[triangle, 17]
            texture, light = indices[triangle, 0], indices[triangle, 1]
            hit_surface = indices[triangle, 2]
            if texture >= 0:
                u = b0 * values[triangle, 0] + b1 * values[triangle, 2] + b2 * values[triangle, 4]
                v = b0 * values[triangle, 1] + b1 * values[triangle, 3] + b2 * values[triangle, 5]
                direction = ti.Vector([rays[r, 3], rays[r, 4], rays[r, 5]])
                normal = ti.Vector([values[triangle, 12], values[triangle, 13], values[triangle, 14]])
                facing = normal.dot(direction)
                if ti.abs(facing) < 1e-6:
                    facing = ti.cast(1e-6, ti.f32)
                dx_u = distance[r] * (step_u - direction * (normal.dot(step_u) / facing))
                dx_v = distance[r] * (step_v - direction * (normal.dot(step_v) / facing))
                gradient_u = ti.Vector([values[triangle, 6], values[triangle, 7], values[triangle, 8]])
                gradient_v = ti.Vector([values[triangle, 9], values[triangle, 10], values[triangle, 11]])
                side_u = ti.Vector([gradient_u.dot(dx_u), gradient_v.dot(dx_u)])  # texels per pixel
                side_v = ti.Vector([gradient_u.dot(dx_v), gradient_v.dot(dx_v)])
                length_u, length_v = side_u.norm(), side_v.norm()
                longer = side_u
                major, minor = length_u, length_v
                if length_v > length_u:
                    longer = side_v
                    major, minor = length_v, length_u
                ratio = major / ti.max(minor, 1.0)  # look-ups closer than a texel add nothing
                taps = ti.cast(ti.math.clamp(ti.ceil(ratio - 0.25), 1.0, float(MAX_TAPS)), ti.i32)
                coarse = ti.max(minor, major / ti.cast(taps, ti.f32))  # texels one look-up has to average
                lod = ti.math.clamp(
                    ti.log(ti.max(coarse, 1.0)) * ti.f32(1.4426950408889634),
                    0.0,
                    ti.cast(num_levels[texture] - 1, ti.f32),
                )
                level = ti.cast(lod, ti.i32)
                blend = lod - ti.cast(level, ti.f32)
                repeat = repeats[texture]
                scale_u = 1 / ti.cast(levels[texture, 0, 1], ti.f32)
                scale_v = 1 / ti.cast(levels[texture, 0, 2], ti.f32)
                total = ti.f32(0.0)
                for k in range(taps):
                    at = (ti.cast(k, ti.f32) + 0.5) / ti.cast(taps, ti.f32) - 0.5
                    uk, vk = (u + at * longer[0]) * scale_u, (v + at * longer[1]) * scale_v
                    fine = _bilinear(texels, levels, texture, level, repeat, uk, vk)
                    if blend > 0.01:
                        fine = (1 - blend) * fine + blend * _bilinear(
                            texels, levels, texture, level + 1, repeat, uk, vk
                        )
                    total += fine
                value *= total / ti.cast(taps, ti.f32)
            if light >= 0:
                s = b0 * values[triangle, 18] + b1 * values[triangle, 20] + b2 * values[triangle, 22]
                t = b0 * values[triangle, 19] + b1 * values[triangle, 21] + b2 * values[triangle, 23]
                scale_s = 1 / ti.cast(levels[light, 0, 1], ti.f32)
                scale_t = 1 / ti.cast(levels[light, 0, 2], ti.f32)
                value *= _bilinear(texels, levels, light, 0, 0, s * scale_s, t * scale_t)
        grey[r] = ti.math.clamp(value, 0.0, 1.0)
        surface[r] = hit_surface


@ti.kernel
def _mark_edges(
    grey: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [H, W]
    surface: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [H, W]
    contrast: ti.f32,
    edges: ti.types.ndarray(dtype=ti.u8, ndim=2),  # out [H, W], 1: more samples needed
):
    height, width = grey.shape[0], grey.shape[1]
    for y, x in ti.ndrange(height, width):
        mark = ti.u8(0)
        centre = grey[y, x]
        for dy, dx in ti.static(ti.ndrange((-1, 2), (-1, 2))):
            j, i = y + dy, x + dx
            if 0 <= j < height and 0 <= i < width:
                other = grey[j, i]
                if surface[j, i] != surface[y, x] and ti.abs(other - centre) > contrast * (other + centre):
                    mark = ti.u8(1)
        edges[y, x] = mark


@ti.kernel
def _average_samples(
    samples: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [M, S]
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [M]
    grey: ti.types.ndarray(dtype=ti.f32, ndim=1),  # in/out [H * W]
):
    for m in range(pixels.shape[0]):
        total = ti.f32(0.0)
        for s in range(samples.shape[1]):
            total += samples[m, s]
        grey[pixels[m]] = total / ti.cast(samples.shape[1], ti.f32)


def pixel_rays(
    T_world_camera: np.ndarray,  # [4, 4]
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy in pixels
    width: int,
    pixels: np.ndarray,  # [M] int32, row-major pixel indices
    offsets: np.ndarray,  # [S, 2] float32, (x, y) from the pixel centre
) -> np.ndarray:  # [M * S, 6] float32: origin, direction
    """Return rays whose directions have camera z = 1, so that the distance along them is z-depth."""
    check_shape("offsets", offsets, (None, 2))
    rays = np.empty((len(pixels) * len(offsets), 6), np.float32)
    if len(rays):
        _pixel_rays(
            ti.Matrix(T_world_camera[:3, :3].astype(np.float32).tolist()),
            ti.Vector(T_world_camera[:3, 3].astype(np.float32).tolist()),
            ti.Vector([float(v) for v in intrinsics]),
            width,
            pixels,
            offsets,
            rays,
        )
    return rays


def shade(
    rays: np.ndarray,  # [N, 6] float32
    distance: np.ndarray,  # [N] float32, along the ray
    primitive: np.ndarray,  # [N] uint32, INVALID where nothing is hit
    barycentric: np.ndarray,  # [N, 2] float32, weights of corners 1 and 2
    pixel_steps: np.ndarray,  # [2, 3], change of the ray direction per sample to the right and down
    triangles: TriangleTable,
    textures: TextureTable,
    background: float,
) -> tuple[np.ndarray, np.ndarray]:  # [N] float32 grey in [0, 1], [N] int32 surface (-1: none)
    """Return the filtered brightness of each hit: tint * texture * light map."""
    count = len(distance)
    check_shape("rays", rays, (count, 6))
    check_shape("barycentric", barycentric, (count, 2))
    check_shape("triangles.values", triangles.values, (None, 24))
    grey, surface = np.empty(count, np.float32), np.empty(count, np.int32)
    if count:
        _shade(
            rays,
            distance,
            primitive,
            barycentric,
            ti.Vector([float(v) for v in pixel_steps[0]]),
            ti.Vector([float(v) for v in pixel_steps[1]]),
            triangles.values,
            triangles.indices,
            textures.texels,
            textures.levels,
            textures.num_levels,
            textures.repeat,
            background,
            grey,
            surface,
        )
    return grey, surface


def mark_edges(
    grey: np.ndarray,  # [H, W] float32
    surface: np.ndarray,  # [H, W] int32
    contrast: float,  # smallest Michelson contrast that counts
) -> np.ndarray:  # [H, W] uint8
    """Return 1 where one of the 8 neighbours shows another surface of visibly different brightness."""
    check_shape("surface", surface, grey.shape)
    edges = np.empty(grey.shape, np.uint8)
    _mark_edges(grey, surface, contrast, edges)
    return edges


def write_sample_means(
    samples: np.ndarray,  # [M, S] float32
    pixels: np.ndarray,  # [M] int32
    grey: np.ndarray,  # [H * W] float32, changed
) -> None:
    """Overwrite the listed pixels with the means of their samples."""
    check_shape("samples", samples, (len(pixels), None))
    if len(pixels):
        _average_samples(samples, pixels, grey)
