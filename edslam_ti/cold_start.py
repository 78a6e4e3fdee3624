"""What the command line loads before the kernels."""


def load_kernels() -> None:
    """Load torch, Taichi and the kernels' runtime."""
    import edslam_ti.kernels.runtime  # noqa: F401
