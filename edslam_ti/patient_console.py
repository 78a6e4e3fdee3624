"""A console that outlives its reader: when output can no longer be written, it goes quiet."""

import os
import sys
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn


class PatientStream:
    """A text stream that discards everything once its reader is gone or its disk is full."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or discard it."""
        try:
            return self._stream.write(text)
        except OSError:
            self._be_quiet()
            return len(text)

    def flush(self) -> None:
        """Write out what is buffered, or discard it."""
        try:
            self._stream.flush()
        except OSError:
            self._be_quiet()

    def _be_quiet(self) -> None:
        """Let what is buffered, and all that follows, go to the null device."""
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, self._stream.fileno())
        except OSError:  # no descriptor of the system's behind it
            self._stream = open(os.devnull, "w")  # noqa: SIM115 -- stays open
        finally:
            os.close(null)


def say(console: Console, line: str) -> None:
    """Print a line as it is: nothing in it is markup, and the terminal wraps it."""
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def patient_console() -> Console:
    """Return a console on the standard output, which must not end a run: `edslam slam | head -1`."""
    if sys.stdout is None:  # a process without output
        return Console(quiet=True)
    stream: Any = PatientStream(sys.stdout)
    return Console(file=stream)


def progress_bar(console: Console, time: ProgressColumn) -> Progress:
    """Return a bar whose tasks have a field `status`, plain text. `time` shows time elapsed or remaining."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        time,
        TextColumn("{task.fields[status]}", markup=False),
        console=console,
    )
