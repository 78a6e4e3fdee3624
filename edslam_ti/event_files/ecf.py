"""Decodes chunks of HDF5 files compressed with Prophesee's ECF, HDF5 filter 0x8ECF.

A chunk is a word of 32 bits (number of events, and in its lowest bits how the rest is stored), the first
stamp in 64 bits, and then:

    stamps      bytes of step and count, 4 bits each; count 15: two more bytes hold it; step 15: the count
                bits are part of a longer step, lowest bits first
    y, x, p     packed in 24 bits, four events in 12 bytes; or
    y           words of value (11 bits) and count (5); count 31: the next word holds it; then
      x, p      packed in 12 bits, four events in 6 bytes; or
      x         words of value (11 bits) and a mask of the five pixels that follow; then
      p         bytes of value (1 bit) and count (7); count 127: two more bytes hold it

The layout follows the codec that Prophesee publishes (github.com/prophesee-ai/hdf5_ecf).
"""

from collections import OrderedDict
from typing import Any

import numpy as np

FILTER = 0x8ECF
EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
KEPT = 16  # decoded chunks


class EcfDataset:
    """A table of events in ECF chunks, sliced like the dataset itself."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._length = int(dataset.chunks[0])  # events of a chunk
        self._decoded: OrderedDict[int, np.ndarray] = OrderedDict()

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, rows: slice) -> np.ndarray:
        start, end, _ = rows.indices(len(self))
        if end <= start:
            return np.empty(0, EVENT)
        chunks = range(start // self._length, (end - 1) // self._length + 1)
        together = np.concatenate([self._chunk(k) for k in chunks])
        first = chunks[0] * self._length
        return together[start - first : end - first]

    def _chunk(self, k: int) -> np.ndarray:
        if k not in self._decoded:
            skipped, data = self._dataset.id.read_direct_chunk((k * self._length,))
            # A set bit means that the filter was not applied.
            events = np.frombuffer(data, self._dataset.dtype) if skipped & 1 else decoded(data)
            number = min(self._length, len(self) - k * self._length)
            if len(events) < number:
                raise ValueError(f"chunk {k} holds {len(events)} events, not {number}")
            self._decoded[k] = events[:number]
            if len(self._decoded) > KEPT:
                self._decoded.popitem(last=False)
        return self._decoded[k]


def decoded(data: bytes) -> np.ndarray:  # [N] EVENT
    """Return the events of a chunk; raises `ValueError` where it ends too early."""
    info = int(np.frombuffer(data, "<u4", 1)[0])
    number, is_all_packed, is_packed = info >> 2, bool(info & 2), bool(info & 1)
    events = np.zeros(number, EVENT)
    if number == 0:
        return events
    events["t"], at = _stamps(data, number)
    if is_all_packed:
        a, b, c = _groups(data, "<u4", at, number)
        values = [a >> 8, a & 0xFF | b >> 16 << 8, b & 0xFFFF | c >> 24 << 16, c & 0xFF_FFFF]
        packed = np.stack(values, 1).ravel()[:number]
        events["y"], events["x"] = packed >> 12 & 0x7FF, packed >> 1 & 0x7FF
        events["p"] = packed & 1
        return events
    words = np.frombuffer(data, "<u2", min((len(data) - at) // 2, 2 * number), at)
    y, used = _runs(words >> 5, (words & 0x1F).astype(np.int64), 31, words[1:].astype(np.int64), 1, number)
    events["y"] = y
    at += 2 * used
    if is_packed:
        a, b, c = _groups(data, "<u2", at, number)
        values = [a >> 4, a & 0xF | b >> 8 << 4, b & 0xFF | c >> 12 << 8, c & 0xFFF]
        packed = np.stack(values, 1).ravel()[:number]
        events["x"], events["p"] = packed >> 1, packed & 1
        return events
    words = np.frombuffer(data, "<u2", min((len(data) - at) // 2, number), at)
    events["x"], used = _masked(words, number)
    at += 2 * used
    marks = np.frombuffer(data, np.uint8, len(data) - at, at)
    counts = (marks & 0x7F).astype(np.int64)
    events["p"], _ = _runs(marks >> 7, counts, 127, _two_bytes(marks), 2, number)
    return events


def _stamps(data: bytes, number: int) -> tuple[np.ndarray, int]:
    """Return stamps [number], and where the bytes that follow begin."""
    first = int(np.frombuffer(data, "<i8", 1, 4)[0])
    whole = np.frombuffer(data, np.uint8, len(data) - 12, 12)
    for length in (number // 8 + 64, number + 64, len(whole)):  # it is not stored how long they are
        found = _stamps_of(whole[:length], first, number)
        if found is not None:
            return found[0], 12 + found[1]
    raise ValueError(f"the chunk ends before the stamps of its {number} events")


def _stamps_of(values: np.ndarray, first: int, number: int) -> tuple[np.ndarray, int] | None:
    """Return stamps [number] and the bytes they take; None: there are too few bytes."""
    step, count = (values >> 4).astype(np.int64), (values & 0xF).astype(np.int64)
    is_long = step == 15
    is_start, count = _tokens(count, 15, _two_bytes(values), 2, is_never=is_long)
    # A long step: its bytes hold 4 bits each, the lowest first. Bit positions start again with every run.
    place = np.arange(len(values))
    run_start = np.maximum.accumulate(np.where(is_long & is_start, -1, place))  # the place before the run
    shift = np.minimum(4 * (place - run_start - 1), 60)
    long_step = np.where(is_long, values.astype(np.int64) & 0xF, 0) << np.where(is_long, shift, 0)
    steps = np.where(is_start, np.where(is_long, long_step, step), 0)
    counts = np.where(is_start & ~is_long, count, 0)
    total = np.cumsum(counts)
    used = int(np.searchsorted(total, number)) + 1
    if used + 2 > len(values):
        return None
    stamps = np.repeat(first + np.cumsum(steps[:used]), counts[:used])[:number]
    return stamps, used + (2 if values[used - 1] & 0xF == 15 else 0)


def _two_bytes(values: np.ndarray) -> np.ndarray:  # [N] uint8 -> [N - 1] int64
    """Return for each byte the number that the two bytes after it hold."""
    after = values[1:].astype(np.int64)
    return after + (np.append(after[1:], 0) << 8)


def _tokens(
    count: np.ndarray,  # [N] as stored in each word
    marker: int,  # a count that means that it follows
    following: np.ndarray,  # [N - 1] the count after each word
    width: int,  # words that it takes
    is_never: np.ndarray | None = None,  # [N] bool; words in which the marker means nothing
) -> tuple[np.ndarray, np.ndarray]:
    """Return which words are tokens rather than a count that follows one, and their counts."""
    is_marked = count == marker if is_never is None else (count == marker) & ~is_never
    is_token, count = np.ones(len(count), bool), count.copy()
    free = 0
    for k in np.flatnonzero(is_marked).tolist():
        if k >= free and k < len(following):
            is_token[k + 1 : k + 1 + width] = False
            count[k] = following[k]
            free = k + 1 + width
    return is_token, count


def _runs(
    values: np.ndarray, count: np.ndarray, marker: int, following: np.ndarray, width: int, number: int
) -> tuple[np.ndarray, int]:
    """Return the values [number] that runs stand for, and how many words they take."""
    is_token, lengths = _tokens(count, marker, following, width)
    lengths = np.where(is_token, lengths, 0)
    total = np.cumsum(lengths)
    used = int(np.searchsorted(total, number)) + 1
    if used > len(values):
        raise ValueError(f"values of {total[-1] if len(total) else 0} events, not {number}")
    result = np.repeat(values[:used], lengths[:used])[:number]
    return result, used + (width if count[used - 1] == marker else 0)


def _masked(words: np.ndarray, number: int) -> tuple[np.ndarray, int]:
    """Return columns [number], each followed by those of the five next ones that its mask names."""
    bits = (words[:, None] >> np.array([4, 3, 2, 1, 0], np.uint16)) & 1
    is_event = np.concatenate([np.ones((len(words), 1), bool), bits.astype(bool)], 1)
    total = np.cumsum(is_event.sum(1))
    used = int(np.searchsorted(total, number)) + 1
    if used > len(words):
        raise ValueError(f"columns of {total[-1] if len(total) else 0} events, not {number}")
    word, pixel = np.nonzero(is_event[:used])
    return ((words[word] >> 5) + pixel)[:number], used


def _groups(data: bytes, dtype: str, at: int, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the three words of each group of four events."""
    words = np.frombuffer(data, dtype, 3 * (-(-number // 4)), at).reshape(-1, 3)
    return words[:, 0], words[:, 1], words[:, 2]
