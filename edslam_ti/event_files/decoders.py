"""Decodes the words that event cameras send; all decoders work on whole arrays.

Layouts: Prophesee, "Data Encoding Formats" (EVT 2.0, 2.1, 3.0), and event_camera_codecs for the packets of
ROS (libcaer, libcaer_cmp, mono). Stamps are whole ticks: microseconds, in mono nanoseconds.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.event_files.stream import RawEvents

# The high part of a stamp may go back a little where a camera has several readouts; a larger step backwards
# means that the counter has started again.
LITTLE_BACKWARD = 10


class Rollover:
    """Continues a counter of a few bits that starts again at zero."""

    def __init__(self, bits: int) -> None:
        self._period = 1 << bits
        self._turns = 0
        self._last: int | None = None

    def __call__(self, values: np.ndarray) -> np.ndarray:  # [N] -> [N] int64
        """Return successive values of the counter without its jumps back to zero."""
        values = values.astype(np.int64)
        if len(values) == 0:
            return values
        before = np.concatenate([[values[0] if self._last is None else self._last], values[:-1]])
        turns = self._turns + np.cumsum(before - values > LITTLE_BACKWARD)
        self._turns, self._last = int(turns[-1]), int(values[-1])
        return values + turns * self._period


class Latest:
    """The value that was set last before each place, also by earlier calls."""

    def __init__(self, value: int) -> None:
        self._value = value

    def __call__(
        self,
        places: np.ndarray,  # [K] where values are set, increasing
        values: np.ndarray,  # [K]
        asked: np.ndarray,  # [M]
    ) -> np.ndarray:  # [M] int64
        known = np.concatenate([[self._value], values.astype(np.int64)])
        self._value = int(known[-1])
        return known[np.searchsorted(places, asked, side="right")]

    def moved(self, step: int) -> None:
        """Add to the value for later calls."""
        self._value += step


@dataclass(frozen=True)
class Codes:
    """Types of 16-bit words (bits 12 to 15): single events, and vectors of 8 and 12 pixels."""

    line: int  # sets the coordinate that all events share until the next one
    single: int  # one event: the other coordinate, and polarity in bit 11
    base: int  # the first pixel of the vectors that follow, and their polarity
    vector_8: int
    vector_12: int
    time_low: int
    time_high: int
    others: tuple[int, ...]  # known words without events


EVT3 = Codes(
    line=0, single=2, base=3, vector_12=4, vector_8=5, time_low=6, time_high=8, others=(7, 10, 14, 15)
)
# Columns take the part of rows here.
LIBCAER_CMP = Codes(time_high=0, time_low=1, line=2, single=3, base=4, vector_8=5, vector_12=6, others=())


class VectorDecoder:
    """Decodes a stream of 16-bit words in pieces (EVT 3.0, libcaer_cmp); the state goes on."""

    def __init__(self, codes: Codes, has_time: bool = False) -> None:
        """`has_time`: stamps begin at 0, else the events before the first stamp are left out."""
        self._codes = codes
        self.num_unknown = 0  # words of no known type
        self._has_time = has_time
        self._line, self._low, self._high = Latest(0), Latest(0), Latest(0)
        self._base, self._polarity = Latest(0), Latest(0)
        self._turns = Rollover(12)
        self._last_high = -1

    def __call__(self, words: np.ndarray) -> RawEvents:  # [N] uint16
        """Return the events of the next words, in their order; t in microseconds since the clock's zero."""
        codes = self._codes
        kind = words >> 12
        self.num_unknown += int(np.isin(kind, self._unknown()).sum())
        is_event = (kind == codes.single) | (kind == codes.vector_8) | (kind == codes.vector_12)
        at = np.flatnonzero(is_event)
        stamps, at = self._stamps(words, kind, at)
        word, kind_at = words[at], kind[at]

        place = np.flatnonzero(kind == codes.line)
        line = self._line(place, words[place] & 0x7FF, at)
        is_single = kind_at == codes.single
        start, polarity = self._vector_starts(words, kind, at)
        start = np.where(is_single, word & 0x7FF, start)
        polarity = np.where(is_single, (word >> 11) & 1, polarity)
        mask = np.where(is_single, 1, np.where(kind_at == codes.vector_8, word & 0xFF, word & 0xFFF))
        bits = np.unpackbits(mask.astype("<u2").view(np.uint8).reshape(-1, 2), axis=1, bitorder="little")
        which, pixel = np.nonzero(bits)
        return RawEvents(start[which] + pixel, line[which], stamps[which], polarity[which])

    def _stamps(
        self, words: np.ndarray, kind: np.ndarray, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:  # [M], [M]
        """Return the stamps of the words `at`, and of these words those that have a stamp."""
        place = np.flatnonzero(kind == self._codes.time_high)
        if not self._has_time:
            if len(place) == 0:
                return np.empty(0, np.int64), at[:0]
            at = at[at > place[0]]
            self._has_time = True
        high = self._turns(words[place] & 0xFFF)
        before = np.concatenate([[self._last_high], high[:-1]])
        if len(high):
            self._last_high = int(high[-1])
        # A new high part makes the low part zero until the next low part.
        changes = place[high != before]
        lows = np.flatnonzero(kind == self._codes.time_low)
        places = np.concatenate([lows, changes])
        order = np.argsort(places, kind="stable")
        values = np.concatenate([words[lows] & 0xFFF, np.zeros(len(changes), np.uint16)])
        low = self._low(places[order], values[order], at)
        return (self._high(place, high, at) << 12) + low, at

    def _vector_starts(
        self, words: np.ndarray, kind: np.ndarray, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:  # [M], [M]
        """Return the first pixel and the polarity of vectors: each continues where the one before ended."""
        codes = self._codes
        place = np.flatnonzero(kind == codes.base)
        length = np.where(kind == codes.vector_8, 8, np.where(kind == codes.vector_12, 12, 0))
        passed = np.cumsum(length) - length  # pixels of the vectors before each word
        start = self._base(place, (words[place] & 0x7FF).astype(np.int64) - passed[place], at) + passed[at]
        if len(words):
            self._base.moved(int(passed[-1] + length[-1]))
        return start, self._polarity(place, (words[place] >> 11) & 1, at)

    def _unknown(self) -> list[int]:
        codes = self._codes
        known = {codes.line, codes.single, codes.base, codes.vector_8, codes.vector_12}
        return sorted(set(range(16)) - known - {codes.time_low, codes.time_high, *codes.others})


class Evt2Decoder:
    """Decodes EVT 2.0, 32-bit words."""

    unknown = (2, 3, 4, 5, 6, 7, 9, 11, 12, 13)

    def __init__(self) -> None:
        self.num_unknown = 0
        self._turns, self._high = Rollover(28), Latest(0)
        self._has_time = False

    def __call__(self, words: np.ndarray) -> RawEvents:  # [N] uint32
        """Return the events of the next words; t in microseconds."""
        kind = words >> 28
        self.num_unknown += int(np.isin(kind, self.unknown).sum())
        at, high = self._events(kind, words & 0xFFF_FFFF)
        word = words[at]
        t = (high << 6) + ((word >> 22) & 0x3F)
        return RawEvents((word >> 11) & 0x7FF, word & 0x7FF, t, kind[at])

    def _events(self, kind: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [M], [M]
        """Return which words are events with a stamp, and the high part of their stamps."""
        place = np.flatnonzero(kind == 8)
        at = np.flatnonzero(kind <= 1)
        if not self._has_time:
            at = at[at > place[0]] if len(place) else at[:0]
            self._has_time = len(place) > 0
        return at, self._high(place, self._turns(high[place]), at)


class Evt21Decoder(Evt2Decoder):
    """Decodes EVT 2.1, 64-bit words with vectors of 32 pixels."""

    def __init__(self, is_legacy: bool) -> None:
        """`is_legacy`: the halves of a word are swapped (IMX636)."""
        super().__init__()
        self._is_legacy = is_legacy

    def __call__(self, words: np.ndarray) -> RawEvents:  # [N] uint64
        """Return the events of the next words; t in microseconds."""
        halves = np.ascontiguousarray(words).view("<u4").reshape(-1, 2)
        upper, lower = (halves[:, 0], halves[:, 1]) if self._is_legacy else (halves[:, 1], halves[:, 0])
        kind = upper >> 28
        self.num_unknown += int(np.isin(kind, self.unknown).sum())
        at, high = self._events(kind, upper & 0xFFF_FFFF)
        word = upper[at]
        mask = np.ascontiguousarray(lower[at])
        bits = np.unpackbits(mask.astype("<u4").view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
        which, pixel = np.nonzero(bits)
        t = (high << 6) + ((word >> 22) & 0x3F)
        x = ((word >> 11) & 0x7FF)[which] + pixel
        return RawEvents(x, (word & 0x7FF)[which], t[which], kind[at][which])


def libcaer(data: bytes, time_base: int) -> RawEvents:
    """Return the events of a packet of libcaer; t in microseconds, `time_base` in nanoseconds."""
    words = np.frombuffer(data, "<u4", 2 * (len(data) // 8)).reshape(-1, 2)
    low = words[:, 1].astype(np.int64)
    turns = np.concatenate([np.zeros(min(1, len(low)), np.int64), np.cumsum(low[1:] < low[:-1])])
    t = time_base // 1000 + low + (turns << 31)
    return RawEvents(words[:, 0] >> 17, (words[:, 0] >> 2) & 0x7FFF, t, (words[:, 0] >> 1) & 1)


def libcaer_cmp(data: bytes, time_base: int) -> RawEvents:
    """Return the events of a compressed packet of libcaer; t in microseconds, `time_base` in nanoseconds."""
    words = np.frombuffer(data, "<u2", len(data) // 2)
    events = VectorDecoder(LIBCAER_CMP, has_time=True)(words)
    return RawEvents(events.y, events.x, events.t + time_base // 1000, events.p)


def mono(data: bytes, time_base: int) -> RawEvents:
    """Return the events of a packet of 64-bit words; t and `time_base` in nanoseconds."""
    words = np.frombuffer(data, "<u8", len(data) // 8)
    t = (words & 0xFFFF_FFFF).astype(np.int64) + time_base
    return RawEvents((words >> 32) & 0xFFFF, (words >> 48) & 0x7FFF, t, words >> 63)
