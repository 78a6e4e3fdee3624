"""Every setting, one validated model per stage: each field states its default, unit and source.

Files and flags state differences only; a key that is unknown, or a value out of range, is an error
that names the field. A field that was renamed keeps its old name for files and flags:
`new: int = Field(3, validation_alias=AliasChoices("new", "old"))`.
"""

from pathlib import Path
from typing import Any, Literal, Self

import yaml
from pydantic import AliasChoices, BaseModel, Field
from pydantic.fields import FieldInfo

from edslam_ti.errors import ConfigError, EdSlamError, plain
from edslam_ti.rgbd_config import SmallGicpConfig, SplatamConfig
from edslam_ti.sensor_config import DepthSensorConfig, SensorConfig
from edslam_ti.stage import Stage

CONFIGS = Path(__file__).parent / "configs"  # <dataset>.yaml: settings for a data set


class TimeSurfaceConfig(Stage):
    """Time surface, Eq. 1."""

    decay: float = Field(0.03, gt=0)
    """tau in Eq. 1 (the text also calls it eta), seconds. Not given in the paper; ESVO uses 0.03."""
    blur: float = Field(1.0, ge=0, le=100)
    """Standard deviation in pixels of the Gaussian that smooths the surface before alignment."""


class ImageTrackingConfig(Stage):
    """Tracking by log-brightness images made of events, the default tracker (beyond the paper)."""

    image_width: int = Field(192, ge=16)
    """Images are halved until they are about this many pixels wide, which averages out event noise."""
    num_pixels: int = Field(8100, ge=100)
    """Number of a keyframe's pixels that are aligned; half as many at half the size."""
    strong_gradient: float = Field(0.02, ge=0)
    """Gradient in log brightness per pixel; pixels with a larger one are chosen first."""
    steps: int = Field(6, ge=1)
    """At most this many Levenberg-Marquardt steps per level; twice as many without depth."""
    max_misfit: float = Field(0.25, gt=0)
    """Median absolute difference of log brightness beyond which tracking has failed."""
    doubtful: float = Field(1.25, ge=1)
    """A frame that fits this many times worse than usual is aligned a second time, from the last pose."""
    max_misfits: int = Field(4, ge=0)
    """After more than this many failed frames in a row, the keyframe's image is discarded."""
    window: int = Field(12, ge=5)
    """Frames that a keyframe's image can be solved from."""
    observations: int = Field(5, ge=2)
    """Of these, the number of evenly spaced frames that it is solved from."""
    min_frames: int = Field(5, ge=3)
    """Frames with events before the first image is solved."""
    min_flow: float = Field(1.5, gt=0)
    """Optical flow in pixels of brightness images that is needed before the first image is solved."""
    solve_interval: int = Field(3, ge=1)
    """At least this many frames between two solves of one keyframe's image."""
    silent_share: float = Field(0.02, ge=0, lt=1)
    """With fewer events than this share of the usual number, the camera or the event stream has stopped."""
    slowing_share: float = Field(0.2, ge=0, lt=1)
    """With fewer events than this share in the frame before, the camera was coming to rest."""
    silent_flow: float = Field(0.3, ge=0)
    """Optical flow in pixels per frame; a faster camera cannot stop within one frame: events are missing."""
    revisit_overlap: float = Field(0.6, gt=0, lt=1)
    """Share of an old keyframe's pixels that must be in view again to close a loop."""
    revisit_misfit: float = Field(0.12, gt=0)
    """Two keyframes show the same place up to this median absolute difference of log brightness."""


class TrackingConfig(Stage):
    """Trackers of Sec. III-B: time surfaces (Eq. 5), images made of events, or one after the other."""

    brightness: bool = True
    """Align to log-brightness images made of events once the first exists; False: time surfaces only."""
    images: ImageTrackingConfig = ImageTrackingConfig()
    brightness_sigma: float = Field(0.15, gt=0)
    """Images: standard deviation of a log-brightness residual."""
    num_patches: int = Field(400, ge=1)
    """Time surfaces: patches per direction; 400 is the best row of Table II (the text says 200)."""
    patch_size: int = Field(9, ge=1, le=31)
    """Time surfaces: side p of a patch in pixels, odd (Table I)."""
    min_time_surface: float = Field(0.3, ge=0, lt=1)
    """Time surfaces: patch centres are drawn where the surface exceeds this (tau in Sec. III-B; no value
    given there)."""
    references: Literal["previous", "keyframe", "both"] = "keyframe"
    """Time surfaces: frames to align to: the last one (paper), the keyframe (less drift), or both."""
    directions: Literal["both", "forward"] = "both"
    """Time surfaces: warp patches of the reference into the new frame (forward), or also patches of the new
    frame into the reference (both, Eq. 5)."""
    form: Literal["additive", "compositional"] = "additive"
    """Time surfaces: compute Jacobians in the view that patches are warped to, at each step (additive), or in
    the patches, once (inverse compositional, Baker and Matthews 2004)."""
    surface_sigma: float = Field(0.15, gt=0)
    """Time surfaces: standard deviation of a residual."""
    levels: int = Field(3, ge=1, le=6)
    """Time surfaces: pyramid levels, coarse to fine."""
    iterations: int = Field(20, ge=1)
    """Time surfaces: at most this many Levenberg-Marquardt steps per level."""
    max_depth_difference: float = Field(0.1, gt=0)
    """tau_d in metres: a warped pixel whose depth disagrees by more is discarded (Sec. IV-A)."""
    depth_weight: float = Field(3.0, ge=0)
    """Weight of depth residuals relative to those of time surfaces or images; 0: Eq. 5 alone."""
    depth_sigma: float = Field(0.003, gt=0)
    """Standard deviation of depth at short range, metres."""
    depth_sigma_2: float = Field(0.0019, ge=0)
    """Growth of the depth's standard deviation with depth squared, 1/m (Kinect: 0.0019)."""
    huber_threshold: float = Field(1.345, gt=0)
    """Residuals beyond this many standard deviations count linearly (Eq. 5 sums unsquared norms)."""
    min_overlap: float = Field(0.8, gt=0, lt=1)
    """With less than this fraction of its pixels in view, a keyframe is replaced by the new frame."""
    min_inliers: float = Field(0.3, gt=0, lt=1)
    """With less than this fraction of pixels in agreement, tracking has failed."""


class KeyframeConfig(Stage):
    """When a frame becomes a keyframe, and how many frames count as newest (Sec. III-E)."""

    min_covisibility: float = Field(0.85, gt=0, lt=1)
    """A frame that shares a smaller fraction of visible Gaussians with the last keyframe becomes one."""
    max_translation: float = Field(0.05, gt=0)
    """So does a frame beyond this translation relative to the median depth (MonoGS: 0.02 to 0.04)."""
    num_chunks: int = Field(5, ge=1)
    """N: the newest N frames (event chunks) get half of the optimisation steps after each frame; all kept
    frames share the other half."""


class MappingConfig(Stage):
    """Gaussian map, its losses and its optimiser (Sec. III-C to III-E)."""

    enabled: bool = True
    """False: track only, build no map."""
    iterations: int = Field(5, ge=0)
    """Optimisation steps after each frame."""
    final_iterations: int = Field(400, ge=0)
    """Steps over all kept frames after the last frame."""
    budget: float | None = Field(None, gt=0)
    """Seconds of mapping per second of data. Beyond it, steps are skipped, so results depend on the machine's
    speed; inserting Gaussians and solving brightness are never skipped. Omitted: no limit."""
    pixel_stride: int = Field(2, ge=1)
    """One new Gaussian for every stride x stride pixels that need one."""
    min_visibility: float = Field(0.8, gt=0, lt=1)
    """lambda_V of Eq. 13: pixels with less alpha get new Gaussians (Sec. IV-A)."""
    depth_error_factor: float = Field(50.0, gt=0)
    """lambda_MDE of Eq. 13: pixels whose depth error exceeds this multiple of the median get new Gaussians
    (Sec. IV-A)."""
    max_gaussians: int = Field(300_000, ge=1)
    """Largest number of Gaussians; beyond half of it, the fuller the map, the coarser the new ones."""
    ply_harmonics: int = Field(0, ge=0, le=3)
    """Degree of the spherical harmonics in map.ply. Those above 0 are zeros, which some viewers and
    converters demand: with 3, a file is 3.6 times as large."""
    initial_size: float = Field(0.25, gt=0)
    """Standard deviation of a new Gaussian, as a share of the spacing of its neighbours."""
    initial_opacity: float = Field(0.95, gt=0, lt=1)
    """Opacity of a new Gaussian."""
    min_opacity: float = Field(0.05, ge=0, lt=1)
    """Gaussians with a lower opacity are pruned."""
    stretch: float = Field(3.0, gt=0)
    """Seconds of events measured from one start image; each such window has its own, so that errors do not
    accumulate."""
    compare_pixels: int = Field(2, ge=0)
    """How many times each pixel's thresholds are found from what the map shows (0: never), before the final
    steps. Where events show neither dead time nor noise, or pixels are alike, nothing changes."""
    solved_views: int = Field(24, ge=3)
    """At most this many frames of a window are compared when its start image is solved."""
    max_views: int = Field(150, ge=10)
    """At most this many frames are kept to optimise the map for; older ones are thinned out."""
    frames: bool = False
    """Also use the sequence's grey images, after removing motion blur with the events of their exposure; they
    determine the level of brightness. Images of held-out frames are not used."""
    exposure: float | None = Field(None, ge=0, lt=1)
    """Seconds over which such an image integrates, centred on its time; omitted: the data set's own
    (camera.json), else 0: images are sharp."""
    event_weight: float = Field(1.0, ge=0)
    """lambda_event of Eq. 16 (paper: 0.7). It weighs the mean square of the differences of log brightness
    divided by 0.1 (BRIGHTNESS_VARIANCE in mapping/losses.py): at 1 the mean square itself weighs 10."""
    depth_weight: float = Field(2.0, ge=0)
    """lambda_d of Eq. 16 (paper: 0.05). It weighs the mean absolute depth error in metres (Eq. 15)."""
    scale_weight: float = Field(0.01, ge=0)
    """lambda_reg of Eq. 16 (paper: 0.25). It weighs the mean excess of Eq. 14."""
    max_scale_ratio: float = Field(10.0, ge=1)
    """r of Eq. 14: Gaussians may be this much longer than thick."""
    densify: bool = False
    """Clone, split and prune Gaussians by their gradients during the final steps (as gsplat does)."""
    densify_every: int = Field(100, ge=1)
    """With densify: every this many steps (gsplat: 100), in the first half of the final steps."""
    densify_gradient: float = Field(2e-4, gt=0)
    """A Gaussian with a larger mean gradient in the image, in half image widths, becomes two (gsplat)."""
    opacity_reset_every: int = Field(3000, ge=1)
    """With densify: final steps between two resets of all opacities to 0.01 (gsplat: 3000)."""
    log_epsilon: float = Field(0.004, gt=0)
    """Added to brightness before the logarithm of Eq. 10."""
    background: float = Field(0.5, gt=0, lt=1)
    """Brightness where nothing is drawn; also of new Gaussians without neighbours."""
    means_rate: float = Field(5e-4, gt=0)
    """Adam's learning rate of the means, metres."""
    quats_rate: float = Field(1e-3, gt=0)
    """Adam's learning rate of the quaternions (gsplat)."""
    scales_rate: float = Field(1e-2, gt=0)
    """Adam's learning rate of the log-scales (gsplat: 5e-3)."""
    opacities_rate: float = Field(5e-2, gt=0)
    """Adam's learning rate of the opacity logits."""
    colors_rate: float = Field(6e-2, gt=0)
    """Adam's learning rate of the brightness logits."""
    brightness_cells: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8)
    """Edge lengths in metres of cells whose Gaussians share a brightness offset. Events constrain brightness
    only across edges, so without cells large surfaces converge slowly."""
    cells_rate: float = Field(2e-2, gt=0)
    """Adam's learning rate of the cells' brightness offsets."""
    bundle_adjustment: bool = True
    """Optimise the frames' poses together with the map; align those without depth to it."""
    poses_rate: float = Field(2e-5, gt=0)
    """Adam's learning rate of poses, metres and radians."""


class ChangeConfig(Stage):
    """Windows of events of the mappers that compare two renders: ed_slam_paper, event_3dgs, inc_event_gs."""

    knots_per_frame: int = Field(5, ge=1)
    """Moments in each frame's chunk at which windows may begin and end."""
    min_window: float = Field(0.2, gt=0)
    """Fewest events of a window, per pixel (IncEventGS: 80,000 events of 768 x 480 pixels)."""
    max_window: float = Field(1.1, gt=0)
    """Most events of a window, per pixel (IncEventGS: 400,100 events)."""
    solve_views: int = Field(20, ge=0)
    """Views from which brightness is solved for at once (mapping/brightness_solve.py); 0: never."""
    solve_every: int = Field(8, ge=1)
    """Frames between two such solves during the run."""
    solve_iterations: int = Field(60, ge=1)
    """Iterations of conjugate gradients of a solve."""


class EventOnlyConfig(Stage):
    """Maps without depth: event_3dgs and inc_event_gs."""

    nearest: float = Field(0.5, gt=0)
    """Metres; new Gaussians get a random depth from here on."""
    farthest: float = Field(6.0, gt=0)
    """Metres; up to here."""
    solve_steps: int = Field(100, ge=1)
    """Final steps between two solves of all brightness."""
    min_opacity: float = Field(0.02, ge=0, lt=1)
    """Gaussians that fade below this during the final steps are removed."""


class IncEventGsConfig(Stage):
    """Method inc_event_gs (Huang et al. 2025)."""

    bootstrap_frames: int = Field(6, ge=3)
    """Chunks over which map and poses are found together (authors: 3 in the paper, 5 in their code)."""
    bootstrap_steps: int = Field(100, ge=0)
    """Gradient steps at the end of the bootstrap (authors: 3501 without Gauss-Newton steps)."""
    tracking_steps: int = Field(6, ge=1)
    """At most this many Gauss-Newton steps for a pose, on each of two sizes of images (authors: 201 of
    Adam)."""
    adjust_every: int = Field(1, ge=1)
    """Chunks between two sliding bundle adjustments (authors: 2)."""
    window: int = Field(10, ge=2)
    """Chunks that a sliding bundle adjustment covers (authors: 20)."""
    min_explained: float = Field(0.3, gt=0, lt=1)
    """With a smaller share of the change explained by the map, tracking has failed."""


class DepthEventVoConfig(Stage):
    """Method depth_event_vo (Zuo et al. 2022); its time surface has its settings in `time_surface`."""

    num_points: int = Field(3000, ge=200)
    """Semi-dense points of a keyframe (the authors' later Canny-EVT: at most 3000)."""
    min_time_surface: float = Field(0.6, gt=0, lt=1)
    """Points are chosen where the time surface exceeds this, at edges."""
    surfaces_per_frame: int = Field(5, ge=1)
    """Time surfaces aligned one after the other for each frame (authors: 10 a depth image at 30 Hz)."""
    iterations: int = Field(10, ge=1)
    """At most this many steps for each time surface (Canny-EVT: 10)."""
    huber_threshold: float = Field(0.2, gt=0)
    """Potentials beyond this count linearly (Canny-EVT: 50 of 255)."""
    keyframe_distance: float = Field(0.05, gt=0)
    """A keyframe is replaced when the camera has moved this far, as a share of its median depth."""
    min_overlap: float = Field(0.8, gt=0, lt=1)
    """So it is with less than this share of its points in view."""
    min_support: float = Field(0.5, gt=0, lt=1)
    """With a smaller share of points on edges of the time surface, tracking has failed."""
    voxel_size: float = Field(0.01, gt=0)
    """Metres, of the map's voxels, which hold a point each."""


class EvaluationConfig(Stage):
    """Image metrics at poses held out from mapping."""

    hold_out_every: int = Field(5, ge=2)
    """Every n-th frame is held out: its depth and its exact time stamp are never used for mapping."""
    max_images: int = Field(20, ge=1)
    """At most this many views of each kind (held out, mapped, novel) are rendered and compared."""
    flythrough_frames: int = Field(100, ge=1)
    """At most this many frames in `flythrough.mp4`, 15 per second."""
    lpips_weights: Path | None = None
    """LPIPS weights (AlexNet backbone and linear heads in one torch state dict)."""


class Config(Stage):
    """All settings of a run."""

    scene: str = Field("office0", min_length=1)
    """Sequence: a folder name under the data folder, or a built-in room."""
    dataset: str | None = None
    """Input format: generic, event_replica, rpg, vector, dsec, tum_vie, mvsec, m3ed, evslam, rgbd, builtin;
    omitted: detected from the files in the data folder, else the built-in room."""
    data_dir: Path = Path("data")
    """Folder that holds the sequences."""
    calibrate: Literal["none", "depth"] = "none"
    """depth: estimate a small delay and rotation between depth and events from the data, and correct them
    (docs/my_camera.md). The log says what was found."""
    depth_dir: Path | None = None
    """Folder with depth images to use instead of the recording's own, or where it has none (docs/data.md)."""
    crop: bool = False
    """Use the part of the recording that published evaluations use (vector)."""
    method: str = "ed_slam"
    """Method to run: a tracker and a mapper."""
    start: float = Field(0.0, ge=0)
    """Seconds of the sequence to skip."""
    duration: float | None = Field(None, gt=0)
    """Seconds of the sequence to use; omitted: to its end."""
    poses: Literal["tracked", "truth"] = "tracked"
    """truth: skip tracking and map with the true poses."""
    contrast_threshold: float | None = Field(None, ge=1e-3, le=10)
    """C in Eq. 11. Omitted: the data set's own (camera.json), else estimated from its images, else 0.1;
    events alone do not determine it, so log brightness is then known up to a factor. Given: the mean of C+
    and C-, whose ratio is estimated from the images, if there are any."""
    dead_time: float | None = Field(None, ge=0, lt=1)
    """Seconds after an event in which its pixel is blind; the change missed meanwhile is estimated from the
    intervals between events. 0: none. Omitted: estimated from the data."""
    depth_rate: float | None = Field(None, ge=1e-3, le=1e5)
    """Hz, of depth images that are numbered by index, not by milliseconds (event_replica). Omitted: that in
    camera.json."""
    image_rate: float | None = Field(None, ge=1e-3, le=1e5)
    """The same of grey images."""
    max_interval: float = Field(0.05, ge=1e-3)
    """Longest time between tracked frames in seconds; frames without depth fill longer intervals."""
    out: Path = Path("results")
    """Folder that receives the results."""
    checkpoint: float = Field(60.0, ge=0)
    """Seconds between checkpoints, from which `--resume RUN` goes on with a run that was cut off; 0: none.
    Less often where they would take more than 2 % of the time."""
    visualize: bool = False
    """Show the run in an Open3D window."""
    viewer: bool = False
    """Show the run on a page for the browser (extra `viewer`)."""
    viewer_address: str = Field("127.0.0.1", min_length=1)
    """Address of the page. With any other one, other machines can see the run and pause it."""
    viewer_port: int = Field(8080, ge=0, le=65535)
    """Port of the page; the next free one is taken where it is in use; 0: any."""
    log: Path | None = None
    """Write the run into a file for the viewer of Rerun (extra `rerun`)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the kernels. A run refuses cuda, because rendering and tracking are not right there yet; the
    kernels alone and the benchmark can use it."""
    threads: int = Field(2, ge=1, le=256)
    """CPU threads of the kernels; results are identical for the same number."""
    seed: int = Field(0, ge=0)
    """Seed of every random choice."""
    sensor: SensorConfig = SensorConfig()
    depth_sensor: DepthSensorConfig = DepthSensorConfig()
    time_surface: TimeSurfaceConfig = TimeSurfaceConfig()
    tracking: TrackingConfig = TrackingConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    change: ChangeConfig = ChangeConfig()
    event_only: EventOnlyConfig = EventOnlyConfig()
    inc_event_gs: IncEventGsConfig = IncEventGsConfig()
    depth_event_vo: DepthEventVoConfig = DepthEventVoConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    small_gicp: SmallGicpConfig = SmallGicpConfig()
    splatam: SplatamConfig = SplatamConfig()

    def updated(self, differences: dict[str, Any]) -> Self:
        """Return these settings with (nested) differences applied and validated."""
        differences = with_present_names(type(self), differences)
        return self.validated(merged(self.model_dump(), differences), source="settings")

    def require_device(self) -> None:
        """Raise EdSlamError where a run on the device would give wrong results."""
        if self.device == "cuda":
            raise EdSlamError(
                "device: rendering and tracking are not right on cuda yet; use --device cpu "
                "(the kernels and `edslam benchmark` can be run on cuda)"
            )

    def to_yaml(self) -> str:
        """Return every value as YAML, loadable with --config."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def read_differences(path: Path) -> dict[str, Any]:
    """Read a settings file (YAML mapping of differences) and check its keys and values."""
    if not path.is_file():
        raise ConfigError(f"{path}: settings file not found")
    try:
        values = yaml.safe_load(path.read_text()) or {}
    except (
        yaml.YAMLError,
        ValueError,
        RecursionError,
    ) as error:  # encoding; integers of 5000 digits; nesting
        raise ConfigError(f"{path}: not readable as YAML ({plain(' '.join(str(error).split()))})") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping 'key: value', got {type(values).__name__}")
    values = with_present_names(Config, values)
    Config.validated(merged(Config().model_dump(), values), source=str(path))
    return values


def dataset_differences(dataset: str, folder: Path = CONFIGS) -> dict[str, Any]:
    """Return the settings in a data set's own file; most need none."""
    path = folder / f"{dataset}.yaml"
    return read_differences(path) if path.is_file() else {}


def former_names(field: FieldInfo) -> list[str]:
    """Return a field's former names."""
    alias = field.validation_alias
    return [str(name) for name in alias.choices[1:]] if isinstance(alias, AliasChoices) else []


def with_present_names(model: type[BaseModel], values: dict[str, Any]) -> dict[str, Any]:
    """Return (nested) values with former names of fields replaced by present ones."""
    present = {old: name for name, field in model.model_fields.items() for old in former_names(field)}
    result = {}
    for key, value in values.items():
        name = present.get(key, key)
        stage: Any = model.model_fields[name].annotation if name in model.model_fields else None
        is_stage = isinstance(stage, type) and issubclass(stage, BaseModel) and isinstance(value, dict)
        result[name] = with_present_names(stage, value) if is_stage else value
    return result


def merged(base: dict[str, Any], differences: dict[str, Any]) -> dict[str, Any]:
    """Return `base` with the (nested) differences written over it."""
    result = dict(base)
    for key, value in differences.items():
        old = result.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result
