"""The only file that imports the engine: Taichi or its fork, as EDSLAM_ENGINE says (`taichi`, `quadrants`).

Kernels write `from edslam_ti.kernels.engine import ti`. The first import of this file makes the choice for
the whole process. Both engines share the API that the kernels use.
"""

import contextlib
import importlib
import os
import tempfile
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING

DEFAULT = "taichi"
ENGINES = {  # how each is installed
    "taichi": "pip install 'taichi>=1.7.4,<1.8'",
    "quadrants": "pip install 'edslam-ti[quadrants]'",
}


def _load(name: str) -> ModuleType:
    """Return the engine's module, loaded without its banner; an ImportError says what to do."""
    if name not in ENGINES:
        raise ImportError(f"EDSLAM_ENGINE: expected {' or '.join(map(repr, ENGINES))}, got {name!r}")
    try:
        with _without_banner(name), with_home():
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ImportError(f"EDSLAM_ENGINE={name}: {name} is not installed; {ENGINES[name]}") from error


@contextlib.contextmanager
def _without_banner(name: str) -> Iterator[None]:
    """Import without a printed banner, and leave the environment as it was.

    Engines inspect standard output when they are imported, so it must not be redirected.
    """
    variable = f"ENABLE_{name.upper()}_HEADER_PRINT"
    if variable in os.environ:
        yield
        return
    os.environ[variable] = "0"
    try:
        yield
    finally:
        del os.environ[variable]


@contextlib.contextmanager
def with_home() -> Iterator[None]:
    """Give the engine a HOME, without which it aborts, and leave the environment as it was."""
    if "HOME" in os.environ:
        yield
        return
    folder = os.path.expanduser("~")
    os.environ["HOME"] = folder if os.path.isabs(folder) else tempfile.gettempdir()
    try:
        yield
    finally:
        del os.environ["HOME"]


ENGINE = os.environ.get("EDSLAM_ENGINE") or DEFAULT

if TYPE_CHECKING:
    import taichi as ti
else:
    ti = _load(ENGINE)

VERSION = ".".join(map(str, ti.__version__))
