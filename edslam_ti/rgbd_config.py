"""Settings of the methods that use depth and images and no events."""

from pydantic import Field

from edslam_ti.stage import Stage


class SmallGicpConfig(Stage):
    """Tracking by generalised ICP of depth (method small_gicp)."""

    voxel_size: float = Field(0.03, gt=0)
    """Points are averaged in cells of this edge length, metres (the package: 0.25, for lidars)."""
    num_neighbours: int = Field(20, ge=5, le=200)
    """Points that the covariance of a point is estimated from (Segal et al. 2009, and the package: 20)."""
    max_distance: float = Field(0.1, gt=0)
    """Points further apart than this are no partners, metres (the package: 1.0, for lidars)."""
    iterations: int = Field(30, ge=1)
    """At most this many steps (the package: 20)."""
    max_depth: float = Field(10.0, gt=0)
    """Points beyond this depth are left out, metres."""
    reference_distance: float = Field(0.1, gt=0)
    """The reference is replaced once the camera has moved this far from it, metres; as in open3d_icp."""
    reference_angle: float = Field(6.0, gt=0)
    """Or has turned this far, degrees; as in open3d_icp."""
    min_overlap: float = Field(0.3, gt=0, lt=1)
    """With a smaller share of points that find a partner, tracking has failed."""
