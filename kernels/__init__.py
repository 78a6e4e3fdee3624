"""Taichi kernels of ED-SLAM and their torch wrappers. They work on arrays and know nothing of SLAM."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edslam_ti.kernels.runtime import init

__all__ = ["init"]


def __getattr__(name: str) -> Any:
    """Load `init` on first use, so that a module of constants can be imported without Taichi."""
    if name in __all__:
        from edslam_ti.kernels import runtime

        return getattr(runtime, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
