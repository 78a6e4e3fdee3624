"""Whether a PLY file is what its header says, found by numpy alone (Turk 1994, The PLY polygon file format).

Open3D's reader trusts lengths and indices and ends the process where they are wrong.
"""

import mmap
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError, plain

LONGEST_HEADER = 65536  # bytes
TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
# Open3D gives up reading, without an error, where one of three is missing.
TRIPLES = {"positions": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "colours": ("red", "green", "blue")}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # of the value, or of a list's values: numpy's name without byte order
    length: str | None = None  # of a list's length; None: no list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


def is_sound_ply(path: Path) -> bool:
    """Return True when a PLY file of points or triangles is whole, False when it is of a rarer kind.

    Rarer kinds are text, polygons, and lists of several lengths: they are not looked into. Raises `DataError`
    that says what is wrong when vertices are not finite, faces name vertices that are not there, or the file
    is shorter than its header says.
    """
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
        elements, order, offset = _header(path, head)
        names = [element.name for element in elements]
        if order is None or not all(e.count for e in elements) or len(set(names)) < len(names):
            return False
        for element in elements:
            if element.name == "vertex":
                _check_properties(path, [prop.name for prop in element.properties if prop.length is None])
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    num_vertices = next((e.count for e in elements if e.name == "vertex"), 0)
    for element in elements:
        rows = _rows(path, element, order, data, offset)
        if rows is None:
            return False
        offset += rows.nbytes
        if element.name == "vertex":
            _check_finite(path, rows)
        elif element.name == "face" and not _has_triangles(path, rows, element, num_vertices):
            return False
    return True


def _header(path: Path, head: bytes) -> tuple[list[_Element], str | None, int]:
    """Return the elements, the byte order (None: text) and where the rows begin."""
    if not head.startswith(b"ply"):
        raise DataError(
            f"{path}: expected a PLY file, could not read any triangle or point: it begins with "
            f"'{plain(head[:20].decode('latin-1'))}'"
        )
    end = re.search(rb"\bend_header(\r\n|\n|\r)", head)
    if end is None:
        raise DataError(f"{path}: expected a PLY header, found no line 'end_header'; is the file cut off?")
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(head[: end.start()].decode("latin-1").splitlines(), start=1):
        words = line.split()
        try:
            match words:
                case ["format", name, _]:
                    order = None if name == "ascii" else ORDERS[name]
                case ["element", name, count] if re.fullmatch(r"\d{1,12}", count):
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", length, kind, name]:
                    elements[-1].properties.append(_Property(name, TYPES[kind], TYPES[length]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, TYPES[kind]))
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError) as error:
            raise DataError(f"{path}: line {number} is no line of a PLY header: '{plain(line)}'") from error
    return elements, order, end.end()


def _rows(
    path: Path, element: _Element, order: str, data: mmap.mmap, offset: int
) -> np.ndarray | None:  # [count] with one field a property
    """Return an element's rows; None where lists differ in length."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    size = 0  # bytes of a row so far
    for k, prop in enumerate(element.properties):
        if prop.length is not None:
            place, width = offset + size, np.dtype(prop.length).itemsize
            if len(data) < place + width:
                raise _too_short(path, element, data, offset, size + width)
            length = int(np.frombuffer(data, order + prop.length, 1, place)[0])
            if not 0 < length <= 16:
                return None
            fields.append((f"length {k}", order + prop.length))
            fields.append((f"{k}", order + prop.kind, (length,)))
        else:
            fields.append((f"{k}", order + prop.kind))
        size = np.dtype(fields).itemsize
    if size == 0:
        return None
    lists = [f"length {k}" for k, prop in enumerate(element.properties) if prop.length is not None]
    fitting = min(element.count, (len(data) - offset) // size)
    rows = np.frombuffer(data, np.dtype(fields), fitting, offset)
    if any((rows[name] != rows[name][0]).any() for name in lists):
        return None
    if fitting < element.count:
        raise _too_short(path, element, data, offset, size)
    return rows


def _check_properties(path: Path, found: list[str]) -> None:
    """Raise unless vertices have positions, and each of three values or none."""
    for what, names in TRIPLES.items():
        missing = [name for name in names if name not in found]
        if missing and (what == "positions" or len(missing) < len(names)):
            raise DataError(
                f"{path}: expected the vertices' {what} as {', '.join(names)}, its header has no "
                f"'{missing[0]}'"
            )


def _too_short(path: Path, element: _Element, data: mmap.mmap, offset: int, size: int) -> DataError:
    needed = offset + element.count * size
    return DataError(
        f"{path}: its header says {element.count} rows of '{plain(element.name)}', which end at byte "
        f"{needed}, but the file ends at byte {len(data)}; is it cut off?"
    )


def _check_finite(path: Path, rows: np.ndarray) -> None:
    for name in rows.dtype.names or ():
        values = rows[name]
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            bad = int(np.argmax(~np.isfinite(values.reshape(len(values), -1)).all(1)))
            raise DataError(f"{path}: vertex {bad} (counted from 0) holds a value that is not finite")


def _has_triangles(path: Path, rows: np.ndarray, element: _Element, num_vertices: int) -> bool:
    """Return whether all faces are triangles; raise where they name vertices that are not there."""
    for k, prop in enumerate(element.properties):
        if prop.length is None or prop.name not in ("vertex_indices", "vertex_index"):
            continue
        indices = rows[f"{k}"]
        if prop.kind[0] == "f" or indices.shape[1] != 3:
            return False
        bad = ((indices < 0) | (indices >= num_vertices)).any(1)
        if bad.any():
            face = int(np.argmax(bad))
            raise DataError(
                f"{path}: face {face} (counted from 0) names the vertices {indices[face].tolist()}; expected "
                f"0 to {num_vertices - 1}"
            )
        return True
    return False
