"""The only file that imports Open3D; it does so lazily, and supplies libusb-1.0 if the system lacks it."""

import ctypes
from functools import cache
from types import ModuleType

from edslam_ti.errors import EdSlamError

LIBUSB = (
    "libusb-1.0.so.0",
    "libusb-1.0.dylib",
)  # as the linker knows it; finding it by search runs a compiler


@cache
def load_open3d() -> ModuleType:
    """Return the `open3d` module.

    Open3D links against libusb-1.0, which a stock Debian/Ubuntu does not have; the PyPI package
    `libusb-package` carries the same library, and loading it first satisfies the linker.
    """
    if not any(_is_loaded(name) for name in LIBUSB):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        import open3d
    except ImportError as error:
        raise EdSlamError(
            f"Open3D could not be loaded ({error}); on a minimal Linux install its graphics "
            "libraries: apt-get install libgl1 libegl1 libx11-6"
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _is_loaded(name: str) -> bool:
    try:
        ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True
