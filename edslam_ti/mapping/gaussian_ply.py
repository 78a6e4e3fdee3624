"""Gaussians as a PLY file in the layout of 3D Gaussian splatting, which splat viewers open."""

from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.output import atomic_file

SH_C0 = 0.28209479177387814  # spherical harmonic of degree 0: colour = 0.5 + SH_C0 * f_dc

# The layout of Kerbl et al. 2023. Most viewers look properties up by name; some demand the 45 coefficients
# f_rest_* of harmonics up to degree 3. The normals, always zero, are there because some readers skip by
# position.
PLACE_AND_COLOUR = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
SHAPE = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
SPLAT_PROPERTIES = (*PLACE_AND_COLOUR, *SHAPE)


def write_gaussian_ply(
    path: Path,
    means: np.ndarray,  # [N, 3] metres, world
    quats: np.ndarray,  # [N, 4] wxyz
    log_scales: np.ndarray,  # [N, 3] log metres
    logit_opacities: np.ndarray,  # [N]
    colors: np.ndarray,  # [N], [N, 1] or [N, 3] brightness in [0, 1]
    harmonics: int = 0,
) -> None:
    """Write Gaussians in the 3DGS layout that splat viewers open (binary little endian, float32).

    Coefficients of spherical harmonics above degree 0, up to degree `harmonics`, are zeros. Raise DataError
    where there are no Gaussians, or where a value is not finite.
    """
    count = len(means)
    if count == 0:
        raise DataError(f"{path.name}: the map holds no Gaussians; was there any depth to map?")
    parts = {
        "means": (means, 3),
        "quats": (quats, 4),
        "log_scales": (log_scales, 3),
        "logit_opacities": (np.reshape(logit_opacities, (-1, 1)), 1),
        "colors": (three_channels(colors), 3),
    }
    for name, (values, width) in parts.items():
        if values.shape != (count, width):
            raise DataError(f"{name}: expected shape {(count, width)}, got {values.shape}")
        if not np.isfinite(values).all():
            raise DataError(f"{name}: expected finite values; {path.name} is not written")
    rest = tuple(f"f_rest_{k}" for k in range(3 * ((harmonics + 1) ** 2 - 1)))
    names = (*PLACE_AND_COLOUR, *rest, *SHAPE)
    table = np.zeros(count, dtype=[(name, "<f4") for name in names])
    columns = [means, np.zeros((count, 3)), (parts["colors"][0] - 0.5) / SH_C0]
    columns += [parts["logit_opacities"][0], log_scales, quats / np.linalg.norm(quats, axis=1, keepdims=True)]
    for name, column in zip(SPLAT_PROPERTIES, np.concatenate(columns, axis=1).T):
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(table.tobytes())


def read_gaussian_ply(path: Path) -> dict[str, np.ndarray]:
    """Return means, quats, log_scales, logit_opacities and colors ([N, 3]) of a splat file as float32.

    Raise FileNotFoundError, or DataError where the file has another layout.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found")
    data = path.read_bytes()
    header, marker, body = data.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    if not marker or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise DataError(f"{path}: expected a binary little endian PLY file")
    properties = [line.split() for line in lines if line.startswith("property ")]
    names = [words[-1] for words in properties]
    missing = [name for name in SPLAT_PROPERTIES if name not in names and name not in ("nx", "ny", "nz")]
    if missing or any(words[1] not in ("float", "float32") for words in properties):
        raise DataError(f"{path}: expected float properties of the 3DGS layout, missing {missing}")
    dtype = np.dtype([(name, "<f4") for name in names])
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    if len(counts) != 1 or not counts[0].isdigit() or len(body) < int(counts[0]) * dtype.itemsize:
        raise DataError(f"{path}: truncated; expected {counts} vertices of {dtype.itemsize} bytes")
    table = np.frombuffer(body, dtype, count=int(counts[0]))

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([table[name] for name in wanted], -1)

    return {
        "means": columns("x", "y", "z"),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "log_scales": columns("scale_0", "scale_1", "scale_2"),
        "logit_opacities": table["opacity"].copy(),
        "colors": 0.5 + SH_C0 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
    }


def three_channels(colors: np.ndarray) -> np.ndarray:  # [N], [N, 1] or [N, 3] -> [N, 3]
    """Return colours unchanged; repeat grey in three channels."""
    columns = colors.reshape(len(colors), -1)
    return np.repeat(columns, 3, axis=1) if columns.shape[1] == 1 else columns
