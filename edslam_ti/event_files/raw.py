"""Recordings of Prophesee's cameras: RAW files (EVT 2.0, 2.1, 3.0).

A header of lines `% key value` precedes the words. It states the encoding (`evt 3.0`, or `format
EVT3;height=720;width=1280`), and perhaps the size of the image (`geometry 1280x720`); otherwise the size
follows from the sensor that `plugin_name` or `sensor_generation` names.
"""

import re
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError, plain
from edslam_ti.event_files.decoded import DecodedRows, Parts
from edslam_ti.event_files.decoders import EVT3, Evt2Decoder, Evt21Decoder, VectorDecoder
from edslam_ti.event_files.stream import Clock

SENSORS = {  # widths and heights; the first name that occurs in the header counts
    "genx320": (320, 320),
    "gen41": (1280, 720),
    "gen4.1": (1280, 720),
    "imx636": (1280, 720),
    "evk4": (1280, 720),
    "gen4": (1280, 720),
    "gen31": (640, 480),
    "gen3": (640, 480),
}
SENSOR_KEYS = ("plugin_name", "sensor_generation", "sensor_name", "integrator_name")
LONGEST_HEADER = 65_536  # bytes
WORDS_AT_ONCE = 500_000
MOST_UNKNOWN = 0.01  # share of words of no known type; more of them mean another encoding
ENCODINGS = {"2.0": "<u4", "2.1": "<u8", "3.0": "<u2"}
TYPICAL = {"<u2": 1, "<u4": 1, "<u8": 4}  # events in a word, rather many: vectors are rarely full


class PropheseeHeader:
    """The lines `% key value` at the beginning of RAW and DAT files."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            start = file.read(LONGEST_HEADER)
        self.values: dict[str, str] = {}
        self.length = 0  # bytes
        for line in start.split(b"\n")[:-1]:
            if not line.startswith(b"%"):
                break
            self.length += len(line) + 1
            text = line[1:].decode("latin-1").strip()
            if text == "end":
                break
            key, _, value = text.partition(" ")
            self.values[key.lower()] = value.strip()

    def size(self) -> tuple[int, int] | None:
        """Return width and height, or None where the header does not tell."""
        options = self.options()
        width, height = (options.get(key, self.values.get(key, "")) for key in ("width", "height"))
        found = re.fullmatch(r"(\d+)\s*x\s*(\d+)", self.values.get("geometry", "") or f"{width}x{height}")
        if found:
            return int(found[1]), int(found[2])
        sensor = " ".join(self.values.get(key, "") for key in SENSOR_KEYS).lower()
        return next((size for name, size in SENSORS.items() if name in sensor), None)

    def options(self) -> dict[str, str]:
        """Return the settings `key=value` of the format."""
        words = self.values.get("format", "").split(";")[1:]
        return {key.strip().lower(): value.strip() for key, _, value in (w.partition("=") for w in words)}

    def encoding(self) -> str | None:
        """Return "2.0", "2.1", "3.0", or what else the header states; None: it does not."""
        if "evt" in self.values:
            return self.values["evt"]
        name = self.values.get("format", "").split(";")[0].strip().upper()
        return {"EVT2": "2.0", "EVT21": "2.1", "EVT3": "3.0"}.get(name, name or None)


def raw_rows(path: Path) -> tuple[DecodedRows, tuple[int, int] | None]:
    """Return the events of a RAW file, and the size of the image that it states."""
    header = PropheseeHeader(path)
    encoding = header.encoding()
    if encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise DataError(
            f"{path}: expected a header '% evt VERSION' with {known}, got {plain(encoding or 'none', 40)}"
        )
    dtype = ENCODINGS[encoding]
    number = (path.stat().st_size - header.length) // np.dtype(dtype).itemsize
    rows = DecodedRows(
        path,
        lambda rows: _parts(rows, header, dtype),
        clock=Clock(1e6),
        most_events=TYPICAL[dtype] * number,
    )
    return rows, header.size()


def _parts(rows: DecodedRows, header: PropheseeHeader, dtype: str) -> Parts:
    decoder: VectorDecoder | Evt2Decoder | None = None
    number_words = 0
    total = rows.path.stat().st_size
    width = np.dtype(dtype).itemsize
    with rows.path.open("rb") as file:
        file.seek(header.length)
        while data := file.read(WORDS_AT_ONCE * width):
            if rest := len(data) % width:
                rows.notes.append(f"the last {rest} bytes are cut off and left out")
            words = np.frombuffer(data, dtype, len(data) // width)
            number_words += len(words)
            decoder = decoder or _decoder(header, words)
            raw = decoder(words)
            if decoder.num_unknown > MOST_UNKNOWN * max(number_words, 100):
                raise DataError(
                    f"{rows.name}: expected words of EVT {header.encoding()}, got {decoder.num_unknown} of "
                    f"{number_words} of unknown types; the file is damaged or has another encoding"
                )
            yield raw, file.tell() / total


def _decoder(header: PropheseeHeader, words: np.ndarray) -> VectorDecoder | Evt2Decoder:
    """Return a decoder of the words whose first ones are given."""
    if words.dtype.itemsize == 2:
        return VectorDecoder(EVT3)
    if words.dtype.itemsize == 4:
        return Evt2Decoder()
    stated = header.options().get("endianness")
    return Evt21Decoder(stated == "legacy" if stated else _are_halves_swapped(words))


def _are_halves_swapped(words: np.ndarray) -> bool:  # [N] uint64
    """Return whether the type of 64-bit words is in the half that comes first (IMX636).

    In that half all types are known, and the high parts of the stamps increase.
    """
    first, second = np.ascontiguousarray(words).view("<u4").reshape(-1, 2).T
    return _disorder(first) <= _disorder(second)


def _disorder(half: np.ndarray) -> float:  # [N] uint32
    kind = half >> 28
    stamps = half[kind == 8] & 0xFFF_FFFF
    is_constant = len(stamps) == 0 or stamps.min() == stamps.max()
    backward = 1.0 if is_constant else float((stamps[1:] < stamps[:-1]).mean())
    return float(np.isin(kind, Evt2Decoder.unknown).mean()) + backward


def is_prophesee(path: Path) -> bool:
    """Return whether a file begins as Prophesee's RAW and DAT files do."""
    with path.open("rb") as file:
        return file.read(2) == b"% "
