"""Errors that a user can fix. Each message is one short line: what was expected, what came, what to do."""

import reprlib

LONGEST_MESSAGE = 1000  # characters
LONGEST_VALUE = 200  # characters of one value from a file


def plain(value: object, limit: int = LONGEST_VALUE) -> str:
    """Return a text that is safe to print: one line of at most `limit` characters, nothing invisible.

    Control characters and halves of surrogate pairs become escapes; longer texts are cut.
    """
    text = str(value)
    if len(text) > limit:
        text = f"{text[: limit - 4]} ..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shown(value: object) -> str:
    """Return a value as Python writes it, shortened: a few bytes of YAML may stand for gigabytes."""
    return plain(reprlib.repr(value), 80)


class EdSlamError(ValueError):
    """Base of every error caused by input, not by a defect; commands print it as one line, exit code 1."""

    def __init__(self, message: str = "") -> None:
        super().__init__(plain(message, LONGEST_MESSAGE))


class ConfigError(EdSlamError):
    """A setting is unknown or has a value that cannot be used."""


class DataError(EdSlamError):
    """A file is missing, unreadable, truncated, or holds values that cannot be right."""


class LostTrackError(EdSlamError):
    """More than a tenth of a run's frames was lost; its results are saved."""


class MissingExtraError(EdSlamError, ModuleNotFoundError):
    """An optional package is not installed; the message names the extra that brings it."""
