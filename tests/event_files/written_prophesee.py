"""Writes Prophesee's RAW and DAT files event by event, as the vendor's pages on its formats describe them."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

SIZE = (1280, 720)


class Event(NamedTuple):
    """One event; t in microseconds, p 0 or 1."""

    x: int
    y: int
    t: int
    p: int


def some_events(count: int = 3000, span: int = 60_000, start: int = 0) -> list[Event]:
    """Return events in the order of time; some are neighbours in one row, as vectors hold them."""
    random = np.random.default_rng(1)
    events: list[Event] = []
    stamps = np.sort(random.integers(start, start + span, count)).tolist()
    while len(events) < count:
        x, y, p = (int(random.integers(0, n)) for n in (1250, 720, 2))
        t = stamps[len(events)]
        length = int(random.integers(2, 30)) if random.random() < 0.1 else 1
        events += [Event(x + k, y, t, p) for k in range(length) if k == 0 or random.random() < 0.7]
    return sorted(events[:count], key=lambda event: event.t)


def header(*lines: str) -> bytes:
    return "".join(f"% {line}\n" for line in lines).encode()


def evt3_words(events: list[Event]) -> Iterator[int]:
    """Yield words: neighbours in a row with one stamp and polarity as vectors, others as single events."""
    high, low, row, k = -1, -1, -1, 0
    yield from (0x0123, 0x2FFF)  # a row and an event before the first stamp have no time
    while k < len(events):
        x, y, t, p = events[k]
        if t >> 12 & 0xFFF != high:
            high, low = t >> 12 & 0xFFF, -1
            yield 0x8000 | high
        if t & 0xFFF != low:
            low = t & 0xFFF
            yield 0x6000 | low
        if y != row:
            row = y
            yield 0x0000 | y
        group = [x]
        while k + len(group) < len(events):
            other = events[k + len(group)]
            if (other.y, other.t, other.p) != (y, t, p) or not group[-1] < other.x < x + 32:
                break
            group.append(other.x)
        k += len(group)
        if len(group) == 1:
            yield 0x2000 | p << 11 | x
            continue
        yield 0x3000 | p << 11 | x
        mask = sum(1 << (column - x) for column in group)
        yield 0x4000 | mask & 0xFFF
        yield 0x4000 | mask >> 12 & 0xFFF
        yield 0x5000 | mask >> 24 & 0xFF
        yield 0xA000 | 1 << 8  # a trigger


def evt2_words(events: list[Event]) -> Iterator[int]:
    yield 0x1000_0000  # an event before the first stamp
    high = -1
    for x, y, t, p in events:
        if t >> 6 != high:
            high = t >> 6
            yield 0x8000_0000 | high & 0xFFF_FFFF
        yield p << 28 | (t & 0x3F) << 22 | x << 11 | y


def evt21_words(events: list[Event]) -> Iterator[int]:
    high = -1
    for x, y, t, p in events:
        if t >> 6 != high:
            high = t >> 6
            yield 8 << 60 | (high & 0xFFF_FFFF) << 32
        base, bit = (x - x % 32), x % 32
        yield p << 60 | (t & 0x3F) << 54 | base << 43 | y << 32 | 1 << bit


def write_raw(path: Path, events: list[Event], version: str, *lines: str, is_legacy: bool = False) -> Path:
    """Write a RAW file; `lines` come before that with the version."""
    words, code = {
        "3.0": (evt3_words(events), "H"),
        "2.0": (evt2_words(events), "I"),
        "2.1": (evt21_words(events), "Q"),
    }[version]
    body = b"".join(struct.pack(f"<{code}", word) for word in words)
    if is_legacy:  # the halves of each word change places
        halves = np.frombuffer(body, "<u4").reshape(-1, 2)
        body = halves[:, ::-1].tobytes()
    stated = () if any(line.startswith("format") for line in lines) else (f"evt {version}",)
    path.write_bytes(header(*lines, *stated) + body)
    return path


def write_dat(path: Path, events: list[Event]) -> Path:
    start = header("Data file containing CD events.", "Version 2", "Height 720", "Width 1280")
    rows = (struct.pack("<II", t & 0xFFFF_FFFF, p << 28 | y << 14 | x) for x, y, t, p in events)
    path.write_bytes(start + bytes([12, 8]) + b"".join(rows))
    return path
