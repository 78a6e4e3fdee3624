"""Errors a user can mend. Each message says what was expected, what came, and what to do."""


class EdSlamError(ValueError):
    """Root of every error caused by input, not by a defect; apps print it as one line, exit code 1."""


class ConfigError(EdSlamError):
    """A setting is unknown or has a value that cannot be used."""


class DataError(EdSlamError):
    """A file is missing, unreadable, truncated, or holds values that cannot be right."""


class MissingExtraError(EdSlamError, ModuleNotFoundError):
    """An optional package is not installed; the message names the extra that brings it."""
