"""Reads events of a text file, one per line; detects comments, a header and damaged lines."""

import io
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.event_files.rows import RowBlock

TYPICAL_LINE = 15  # bytes of a line with an event
CHUNK = 4_000_000  # characters read at once, some 200,000 lines
LONGEST_LINE = 10_000  # characters; a longer one is cut into several
SHOWN = 60  # characters of a line in messages
PIECE = 256  # a chunk with unreadable lines is read in pieces of this many lines
SEPARATORS = str.maketrans(",;", "  ")
HEADER_WORDS = {"t", "ts", "time", "timestamp", "x", "y", "p", "pol", "polarity"}
# Byte-order marks of UTF-16 and UTF-32, decoded as Latin-1.
WIDE_MARKS = ("\xff\xfe", "\xfe\xff", "\x00\x00\xfe\xff")


class TextRows:
    """Lines 't x y p'. Blank lines, text after '#', and a first line 'width height' are skipped."""

    part, columns, counted, origin = "", "txyp", "line", 0.0

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        """`size` is the image's width and height; a header must agree with it."""
        self.path = path
        self.name = str(path)
        self._size = size
        if not path.is_file():
            raise FileNotFoundError(f"{path} not found; expected lines 't x y p'")
        self.num_bytes = path.stat().st_size
        if self.num_bytes == 0:
            raise DataError(f"{path}: the file is empty; expected lines 't x y p'")
        self.notes: list[str] = []  # of the last reading

    def most_events(self) -> int:
        return self.num_bytes // TYPICAL_LINE

    def column(self, index: int) -> str:
        return f"column {index + 1}"

    def sample(self) -> np.ndarray:  # [S, 4] float64
        for block in self.blocks():
            return block.rows
        raise DataError(f"{self.name}: expected lines 't x y p', got none with events")

    def blocks(self) -> Iterator[RowBlock]:
        self.notes = []
        read, number, is_first = 0, 1, True
        # Latin-1 decodes any bytes; universal newlines accept the line ends of all systems.
        with self.path.open(encoding="latin-1") as file:
            while text := file.read(CHUNK):
                text += file.readline(LONGEST_LINE)
                read += len(text)
                if number == 1:
                    text = self._without_mark(text)
                lines_in_text = text.count("\n") + (not text.endswith("\n"))
                is_end = not text.endswith("\n")
                rows = None if is_first or is_end else _numbers(text)
                if rows is not None and len(rows) == lines_in_text:
                    block = RowBlock(rows, range(number, number + len(rows)))
                else:
                    block = self._line_by_line(text, number, is_first)
                number += lines_in_text
                if len(block.rows):
                    is_first = False
                    share = min(1.0, read / self.num_bytes)
                    yield RowBlock(block.rows, block.numbers, block.unreadable, share)

    def _without_mark(self, text: str) -> str:
        """Return the beginning of the file without the byte-order mark that Windows' editors write."""
        if text.startswith(WIDE_MARKS) or "\x00" in text[:1000]:
            raise DataError(
                f"{self.name}: line 1: expected plain text, got UTF-16 or binary; save it as UTF-8"
            )
        return text.removeprefix("\xef\xbb\xbf")

    def _line_by_line(self, text: str, first: int, is_start: bool) -> RowBlock:
        """Return the rows of a text with some lines that are no events; `is_start`: the file starts here."""
        lines = text.translate(SEPARATORS).split("\n")
        kept = [(first + k, line) for k, line in enumerate(lines) if line.strip() and line.lstrip()[0] != "#"]
        if is_start and kept and self._is_header(*kept[0]):
            del kept[0]
        if kept and not text.endswith("\n") and kept[-1][1] is lines[-1]:
            number, line = kept[-1]
            if len(line.split()) < 4:
                self.notes.append(f"line {number}, the last one, is cut off and left out: '{_shown(line)}'")
                del kept[-1]
        rows = np.full((len(kept), 4), np.nan)
        unreadable = {}
        for start in range(0, len(kept), PIECE):
            piece = kept[start : start + PIECE]
            together = _numbers("\n".join(line for _, line in piece))
            if together is not None and len(together) == len(piece):
                rows[start : start + len(piece)] = together
                continue
            for k, (_, line) in enumerate(piece, start):
                values = _values(line)
                if values is None:
                    unreadable[k] = _shown(line)
                else:
                    rows[k] = values
        return RowBlock(rows, [number for number, _ in kept], unreadable)

    def _is_header(self, number: int, line: str) -> bool:
        """Return whether the first line names the columns or the image's size."""
        words = line.split()
        if all(word.lower().strip("[]()") in HEADER_WORDS | {"s", "us", "ns"} for word in words):
            return True
        if len(words) != 2 or not all(word.isdecimal() for word in words):
            return False
        if tuple(int(word) for word in words) != self._size:
            width, height = self._size
            raise DataError(
                f"{self.name}: line {number}: width and height {_shown(line)} differ from the camera's "
                f"{width} {height}"
            )
        return True


def _numbers(text: str) -> np.ndarray | None:  # [N, 4] float64
    """Return the numbers of lines without comments; None: a line does not hold four numbers."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no lines
            rows = np.loadtxt(io.StringIO(text.translate(SEPARATORS)), comments=None, ndmin=2)
    except (ValueError, OverflowError):
        return None
    return rows if rows.ndim == 2 and rows.shape[1] == 4 else None


def _values(line: str) -> list[float] | None:
    words = line.split()
    try:
        return [float(word) for word in words] if len(words) == 4 and "_" not in line else None
    except ValueError:
        return None


def _shown(line: str) -> str:
    """Return the beginning of a line in printable characters."""
    text = "".join(c if " " <= c <= "~" else "?" for c in line.strip())
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
