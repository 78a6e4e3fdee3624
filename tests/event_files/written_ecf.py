"""Writes HDF5 files compressed with Prophesee's ECF, chunk by chunk, event by event."""

import struct
from pathlib import Path

import h5py
import numpy as np

EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])


def encoded(events: np.ndarray, how: str) -> bytes:
    """Return a chunk; `how`: "all packed", "packed" or "masked"."""
    flags = {"all packed": 2, "packed": 1, "masked": 0}[how]
    out = struct.pack("<Iq", len(events) << 2 | flags, int(events["t"][0]) if len(events) else 0)
    out += _stamps(events["t"].tolist())
    if how == "all packed":
        return out + _packed([y << 12 | x << 1 | p for x, y, p, _ in events.tolist()], 24, "I")
    out += _counted(events["y"].tolist(), 31, lambda y, c: struct.pack("<H", y << 5 | c), "<H")
    if how == "packed":
        return out + _packed([x << 1 | p for x, _, p, _ in events.tolist()], 12, "H")
    x = events["x"].tolist()
    k = 0
    while k < len(x):
        first, mask = x[k], 0
        k += 1
        for j in range(5):
            if k < len(x) and x[k] == first + j + 1:
                mask |= 1 << (4 - j)
                k += 1
        out += struct.pack("<H", first << 5 | mask)
    return out + _counted(events["p"].tolist(), 127, lambda p, c: struct.pack("B", p << 7 | c), "<H")


def _stamps(stamps: list[int]) -> bytes:
    out, now, k = b"", stamps[0] if stamps else 0, 0
    while k < len(stamps):
        step = stamps[k] - now
        if step >= 15:
            while step:
                out += bytes([0xF0 | step & 0xF])
                step >>= 4
            now = stamps[k]
        step, now = stamps[k] - now, stamps[k]
        count = 1
        while k + count < len(stamps) and stamps[k + count] == now:
            count += 1
        out += (
            bytes([step << 4 | count]) if count < 15 else bytes([step << 4 | 15]) + struct.pack("<H", count)
        )
        k += count
    return out


def _counted(values, marker, word, code) -> bytes:  # type: ignore[no-untyped-def]
    out, k = b"", 0
    while k < len(values):
        count = 1
        while k + count < len(values) and values[k + count] == values[k]:
            count += 1
        out += word(values[k], min(count, marker))
        out += struct.pack(code, count) if count >= marker else b""
        k += count
    return out


def _packed(values: list[int], bits: int, code: str) -> bytes:
    """Four values in three words, the highest bits first in each word."""
    values = values + [0] * (-len(values) % 4)
    out = b""
    for k in range(0, len(values), 4):
        word = 8 * struct.calcsize(code)
        a, b, c, d = values[k : k + 4]
        first = a << (word - bits) | b & ((1 << (word - bits)) - 1)
        low = 2 * (word - bits)
        second = (b >> (word - bits)) << low | c & ((1 << low) - 1)
        third = (c >> low) << bits | d
        out += struct.pack(f"<3{code}", first, second, third)
    return out


def write_ecf(path: Path, events: np.ndarray, chunk: int, how: str, size: tuple[int, int]) -> Path:
    with h5py.File(path, "w") as file:
        file.attrs["geometry"] = f"{size[0]}x{size[1]}"
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((chunk,))
        settings.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((len(events),), (h5py.h5s.UNLIMITED,))
        kind = h5py.h5t.py_create(EVENT, logical=True)
        dataset = h5py.h5d.create(file.create_group("CD").id, b"events", kind, space, settings)
        for start in range(0, len(events), chunk):
            dataset.write_direct_chunk((start,), encoded(events[start : start + chunk], how), 0)
    return path
