"""Methods by name. A method is a Tracker and a Mapper; all methods share one loop (`Slam`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from edslam_ti.errors import ConfigError, DataError

if TYPE_CHECKING:  # `--help` must not load Taichi or Open3D
    from edslam_ti.config import Config
    from edslam_ti.datasets import EventDepthSequence
    from edslam_ti.event_images.contrast import ContrastThreshold
    from edslam_ti.mapping.mapper import Mapper
    from edslam_ti.tracking.tracker import Tracker

    Build = Callable[[EventDepthSequence, ContrastThreshold, Config], tuple[Tracker, Mapper]]


@dataclass(frozen=True)
class Method:
    """Builds a method's tracker and mapper; names the settings that differ from the defaults."""

    description: str
    build: "Build"  # (sequence, contrast threshold, settings) -> tracker and mapper
    overrides: Mapping[str, Any] = field(default_factory=dict)


def _require_events(sequence: "EventDepthSequence", config: "Config") -> None:
    if not sequence.has_events:
        raise DataError(
            f"{sequence.scene}: method {config.method} needs events, and this sequence has none; use "
            "--method open3d_rgbd or open3d_icp"
        )


def _ed_slam(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    _require_events(sequence, config)
    from edslam_ti.event_images.sharp import SharpImages
    from edslam_ti.mapping.gaussian_mapper import GaussianMapper
    from edslam_ti.tracking.image_tracker import BrightnessTracker
    from edslam_ti.tracking.patch_tracker import BidirectionalPatchTracker

    tracker: Tracker
    surfaces, tracking = config.time_surface, config.tracking
    if tracking.brightness:
        tracker = BrightnessTracker(sequence.camera, contrast, surfaces, tracking, config.seed)
    else:
        tracker = BidirectionalPatchTracker(sequence.camera, surfaces, tracking, config.seed)
    if config.method == "ed_slam_paper":
        from edslam_ti.mapping.paper_mapper import PaperMapper

        return tracker, PaperMapper(sequence.camera, contrast, config)
    sharp_images = SharpImages(sequence, contrast, config.mapping) if config.mapping.frames else None
    return tracker, GaussianMapper(sequence.camera, contrast, config, sharp_images)


def _open3d_rgbd(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    from edslam_ti.baselines.open3d_rgbd import RgbdOdometryTracker, TsdfMapper

    return RgbdOdometryTracker(sequence), TsdfMapper(sequence.camera)


def _open3d_icp(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    from edslam_ti.baselines.open3d_rgbd import OdometryTracker, TsdfMapper

    return OdometryTracker(sequence.camera, "PointToPlane"), TsdfMapper(sequence.camera)


def _kiss_icp(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    from edslam_ti.baselines.kiss import KissIcpTracker
    from edslam_ti.baselines.open3d_rgbd import TsdfMapper

    return KissIcpTracker(sequence.camera), TsdfMapper(sequence.camera)


def _small_gicp(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    from edslam_ti.baselines.gicp import SmallGicpTracker
    from edslam_ti.baselines.open3d_rgbd import TsdfMapper

    return SmallGicpTracker(sequence.camera, config.small_gicp), TsdfMapper(sequence.camera)


def _splatam(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    if not config.mapping.enabled:
        raise ConfigError(
            "mapping.enabled: method splatam tracks by its map, so it cannot be off; use --method open3d_rgbd"
        )
    from edslam_ti.baselines.open3d_rgbd import require_images
    from edslam_ti.baselines.splatam.mapper import SplatamMapper
    from edslam_ti.baselines.splatam.tracker import SplatamTracker

    require_images(sequence, config.method)
    mapper = SplatamMapper(sequence.camera, config)
    return SplatamTracker(sequence.camera, mapper.map, config.splatam), mapper


def _event_3dgs(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    _require_events(sequence, config)
    if config.poses != "truth":
        raise ConfigError("poses: method event_3dgs maps with known poses; use --poses truth")
    from edslam_ti.mapping.event_only_mapper import EventOnlyMapper
    from edslam_ti.tracking.tracker import TruePoses

    return TruePoses(sequence.true_pose), EventOnlyMapper(sequence.camera, contrast, config)


def _inc_event_gs(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    _require_events(sequence, config)
    if not config.mapping.enabled:
        raise ConfigError("mapping.enabled: method inc_event_gs tracks by its map and cannot run without")
    from edslam_ti.baselines.inc_event_gs import IncEventMapper, IncEventTracker

    mapper = IncEventMapper(sequence.camera, contrast, config)
    return IncEventTracker(mapper, config.inc_event_gs), mapper


def _depth_event_vo(
    sequence: "EventDepthSequence", contrast: "ContrastThreshold", config: "Config"
) -> tuple["Tracker", "Mapper"]:
    _require_events(sequence, config)
    from edslam_ti.baselines.depth_event_vo import DepthEventTracker
    from edslam_ti.baselines.semi_dense import SemiDenseMapper

    camera, surfaces, settings = sequence.camera, config.time_surface, config.depth_event_vo
    return (
        DepthEventTracker(camera, surfaces, settings, config.seed, config.device),
        SemiDenseMapper(camera, surfaces, settings, config.seed),
    )


METHODS: dict[str, Method] = {
    "ed_slam": Method(
        "time surface and depth aligned together, Gaussian map from events and depth", _ed_slam
    ),
    "ed_slam_paper": Method(
        "the paper to the letter: time surfaces alone (Eq. 5), map from the change between two renders",
        _ed_slam,
        {
            "tracking": {"brightness": False, "references": "previous", "depth_weight": 0.0},
            "mapping": {"event_weight": 0.7, "scale_weight": 0.25, "depth_weight": 0.05},  # Sec. IV-A
        },
    ),
    "inc_event_gs": Method(
        "IncEventGS: poses and map from events alone, by the change between two renders; no scale",
        _inc_event_gs,
        {
            "change": {"min_window": 0.5, "max_window": 6.0, "solve_views": 8},
            "event_only": {"nearest": 2.0, "farthest": 3.0},  # only the ratio matters: the scale is unknown
            "mapping": {
                **{"initial_size": 0.8, "initial_opacity": 0.6, "background": 0.4, "means_rate": 0.005},
                **{"iterations": 5, "final_iterations": 800, "max_gaussians": 100_000},
                **{"poses_rate": 2e-4},
            },
        },
    ),
    "event_3dgs": Method(
        "Event3DGS as re-implemented for comparison: true poses, events alone, Gaussians at random depth",
        _event_3dgs,
        {
            "poses": "truth",
            "change": {"min_window": 1.0, "max_window": 60.0},
            "event_only": {"nearest": 2.5, "farthest": 2.5},  # one distance, corrected by what events say
            "mapping": {
                **{"initial_size": 0.8, "initial_opacity": 0.6, "background": 0.4, "means_rate": 0.005},
                **{"iterations": 0, "final_iterations": 2400, "max_gaussians": 100_000},
            },
        },
    ),
    "depth_event_vo": Method(
        "Zuo et al. 2022: semi-dense points fall into the negated time surface, map of edges",
        _depth_event_vo,
        {"time_surface": {"blur": 0.7}},  # a wider one shifts the bottom of the field
    ),
    "open3d_rgbd": Method(
        "Open3D's RGB-D odometry and TSDF volume; needs images, uses no events", _open3d_rgbd
    ),
    "open3d_icp": Method(
        "Open3D's point-to-plane odometry of depth alone and TSDF volume; uses no events", _open3d_icp
    ),
    "kiss_icp": Method(
        "KISS-ICP (where installed) on points of the depth images, TSDF volume; uses no events", _kiss_icp
    ),
    "small_gicp": Method(
        "generalised ICP of depth (package small_gicp) to keyframes, TSDF volume; uses no events", _small_gicp
    ),
    "splatam": Method(
        "SplaTAM, implemented from its paper: tracks and maps by renders of Gaussians; needs images, uses no "
        "events",
        _splatam,
    ),
}
