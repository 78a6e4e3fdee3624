"""Reads text files of numbers, row by row: poses, times, calibrations.

`#` begins a comment. A byte-order mark, Windows' and old Mac's line ends, blank lines and bytes of another
encoding in comments are ignored. Messages number lines as an editor does.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.errors import LONGEST_MESSAGE, DataError, plain

LARGEST = 1e20  # nanoseconds since 1970 are 2e18; no measurement is larger
LARGEST_FILE = 2_000_000_000  # bytes of text


@dataclass(frozen=True)
class Table:
    """Rows of a text file."""

    rows: np.ndarray  # [N, columns] float64, finite
    lines: np.ndarray  # [N] int, the line of each in the file, from 1


def read_table(path: Path, columns: int, line: str, header_lines: int = 0) -> Table:
    """Return the table in a text file of `columns` numbers a line; `line` describes one in messages.

    Of the first `header_lines` lines, those that hold words are skipped, even if they are no comments.
    Raises `FileNotFoundError`, and `DataError` for a file without rows, a line of other than `columns`
    numbers, and numbers that are not finite.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, text in text_lines(path, f"expected lines '{line}'"):
        fields = text.split()
        if number <= header_lines and not any(_is_number(field) for field in fields):
            continue
        where = f"{path}: line {number}: expected {columns} numbers a line '{line}'"
        if "," in text:
            raise DataError(f"{where} with blanks between them, got commas: '{plain(text, 60)}'")
        if len(fields) != columns:
            raise DataError(f"{where}, got {len(fields)}: '{plain(text, 60)}'")
        rows.append([_number(field, where) for field in fields])
        lines.append(number)
    if not rows:
        raise DataError(f"{path}: expected lines '{line}', got an empty file")
    return Table(np.array(rows), np.array(lines))


def text_lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of every line that holds more than a comment.

    `expected` describes the file in messages.
    """
    if not path.is_file():
        raise FileNotFoundError(plain(f"{path} not found; {expected}", LONGEST_MESSAGE))
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise DataError(f"{path}: {expected}, got {path.stat().st_size} bytes; is this the right file?")
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise DataError(f"{path}: {expected}, got text in UTF-16; save it as UTF-8")
    # Bytes of another encoding are preserved, because file names may contain them.
    content = data.decode("utf-8-sig", "surrogateescape").replace("\r\n", "\n").replace("\r", "\n")
    for number, text in enumerate(content.split("\n"), start=1):
        if "\0" in text:
            raise DataError(f"{path}: line {number}: {expected}, got zero bytes; copy or download it again")
        text = text.split("#", 1)[0].strip()
        if text:
            yield number, text


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _number(field: str, where: str) -> float:
    try:
        if "_" in field or not field.isascii():
            raise ValueError
        value = float(field)
    except ValueError:
        raise DataError(f"{where}, got '{plain(field, 40)}'") from None
    if not math.isfinite(value) or abs(value) > LARGEST:
        raise DataError(f"{where} that are finite and below {LARGEST:g}, got {plain(field, 40)}")
    return value
