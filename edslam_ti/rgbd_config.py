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


class SplatamTrackingConfig(Stage):
    """Tracking of SplaTAM, by the error of the rendered map. Defaults: the authors' settings for Replica."""

    iterations: int = Field(40, ge=1)
    """Steps for a frame."""
    rotation_rate: float = Field(8e-4, gt=0)
    """Adam's learning rate of the rotation, radians (the authors': 4e-4 of a quaternion, half an angle)."""
    translation_rate: float = Field(2e-3, gt=0)
    """Adam's learning rate of the translation, metres."""
    min_silhouette: float = Field(0.99, ge=0, lt=1)
    """Pixels where the map has a smaller alpha are left out."""
    image_weight: float = Field(0.5, ge=0)
    """Weight of the sum of brightness errors, each counted three times, as of three equal channels."""
    depth_weight: float = Field(1.0, ge=0)
    """Weight of the sum of depth errors in metres."""
    image_width: int = Field(192, ge=16)
    """Images are divided by a whole number until just above this width (the authors': whole images)."""
    max_depth_difference: float = Field(0.1, gt=0)
    """Depth of a pixel agrees with the map within this, metres (ours)."""
    min_agreement: float = Field(0.3, gt=0, lt=1)
    """With a smaller share of agreeing pixels, tracking has failed (ours: the authors' never fails)."""


class SplatamMappingConfig(Stage):
    """Mapping of SplaTAM. Defaults: the authors' settings for Replica."""

    iterations: int = Field(60, ge=0)
    """Steps after a frame, each for one view."""
    keyframe_every: int = Field(5, ge=1)
    """Every n-th mapped frame is kept as a keyframe."""
    window: int = Field(24, ge=2)
    """At most this many views are drawn from: keyframes that overlap, the last keyframe, the new frame."""
    image_width: int = Field(320, ge=16)
    """Images are divided by a whole number until just above this width (the authors': whole images)."""
    pixel_stride: int = Field(1, ge=1)
    """One new Gaussian for every stride x stride pixels that need one."""
    min_silhouette: float = Field(0.5, ge=0, lt=1)
    """Pixels where the map has a smaller alpha get new Gaussians."""
    depth_error_factor: float = Field(50.0, gt=0)
    """So do pixels where the map lies behind by more than this multiple of the median depth error."""
    initial_size: float = Field(1.0, gt=0)
    """Standard deviation of a new Gaussian, as a share of the spacing of its neighbours."""
    initial_opacity: float = Field(0.5, gt=0, lt=1)
    """Opacity of a new Gaussian."""
    image_weight: float = Field(0.5, ge=0)
    """Weight of the brightness error."""
    similarity_weight: float = Field(0.2, ge=0, le=1)
    """Share of 1 - SSIM in the brightness error; the rest is the mean absolute error."""
    depth_weight: float = Field(1.0, ge=0)
    """Weight of the mean absolute depth error in metres."""
    means_rate: float = Field(1e-4, gt=0)
    """Adam's learning rate of the means, metres."""
    scales_rate: float = Field(1e-3, gt=0)
    """Adam's learning rate of the log-scales."""
    opacities_rate: float = Field(5e-2, gt=0)
    """Adam's learning rate of the opacity logits."""
    colors_rate: float = Field(2.5e-3, gt=0)
    """Adam's learning rate of brightness."""
    prune_every: int = Field(20, ge=1)
    """Faint and huge Gaussians are removed every this many steps of a frame,"""
    prune_until: int = Field(20, ge=0)
    """until this step."""
    min_opacity: float = Field(0.005, ge=0, lt=1)
    """Gaussians with a lower opacity are faint."""
    max_size: float = Field(0.1, gt=0)
    """Gaussians larger than this share of the scene's radius, a third of the first depth, are huge."""


class SplatamConfig(Stage):
    """Tracking and mapping after SplaTAM (method splatam)."""

    tracking: SplatamTrackingConfig = SplatamTrackingConfig()
    mapping: SplatamMappingConfig = SplatamMappingConfig()
