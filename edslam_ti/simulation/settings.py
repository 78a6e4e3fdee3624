"""Settings of a simulated recording."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator

from edslam_ti.config import Stage
from edslam_ti.errors import ConfigError, shown
from edslam_ti.sensor_config import DEPTH_PRESETS, DepthSensor, DepthSensorConfig, SensorConfig

if TYPE_CHECKING:  # reading options must not load numpy
    from edslam_ti.camera import Camera

DAY = 86400.0  # seconds, the longest recording
Stretch = tuple[Annotated[float, Field(ge=0, le=DAY)], Annotated[float, Field(ge=0, le=DAY)]]


class SimulationConfig(Stage):
    """Camera, event sensor, depth sensor and timing of a simulated recording."""

    model_config = ConfigDict(allow_inf_nan=False)

    width: int = Field(384, ge=8, le=4096)
    """Image width in pixels."""
    height: int = Field(240, ge=8, le=4096)
    """Image height in pixels."""
    focal_length: float | None = Field(None, ge=1, le=1e5)
    """fx = fy in pixels; omitted: half the width (90 degrees, as EventReplica)."""
    duration: float = Field(2.5, gt=0, le=DAY)
    """Length of the recording in seconds."""
    contrast_threshold: float = Field(0.1, ge=0.01, le=10)
    """C: change of log intensity that fires an event (EventReplica's)."""
    negative_contrast_threshold: float | None = Field(None, ge=0.01, le=10)
    """C of darker events; omitted: the same."""
    threshold_noise: float = Field(0.0, ge=0, le=10)
    """Standard deviation of the threshold of each event (ESIM: 0.021)."""
    refractory_period: float = Field(0.0, ge=0, lt=1)
    """Seconds after an event in which its pixel stays silent."""
    log_epsilon: float = Field(1 / 255, ge=1e-6, le=1)
    """Added to the grey value in [0, 1] before the logarithm."""
    depth_rate: float = Field(20.0, ge=1e-3, le=1000)
    """Depth images per second; their times are rounded to whole milliseconds."""
    image_rate: float = Field(20.0, ge=1e-3, le=1000)
    """Grey images and written poses per second; their times are rounded to whole milliseconds."""
    depth_noise: Literal["none", "kinect"] = "none"
    """kinect: axial noise, quantised disparity, jittered and missing edges, nothing beyond 5 m."""
    exposure: float = Field(0.0, ge=0, lt=1)
    """Seconds over which an image integrates, centred on its time (motion blur); 0: sharp."""
    samples_per_pixel: int = Field(6, ge=1, le=64)
    """Rays of a pixel that shows an edge; others take one ray and a texture look-up filtered to its size."""
    max_motion: float = Field(1.0, ge=0.01, le=8)
    """Pixels a scene point may move between rendered frames; in between, log intensity is linear."""
    min_frame_rate: float = Field(100.0, ge=1, le=10_000)
    """Rendered frames per second at least (Hz), however slow the motion."""
    speed: float = Field(1.0, ge=0.01, le=10)
    """Factor on the speed of the built-in path (1: about 0.4 m/s)."""
    path: Literal["hand_held", "rotation", "stop_and_go", "loop", "tour"] = "hand_held"
    """rotation: the camera turns on the spot; stop_and_go: it stands still for 0.6 s of every 1.6 s;
    loop: it turns once around (every 30 s or so) and ends where it began; tour: it walks through all rooms of
    the scene flat, again and again."""
    moving_object: bool = False
    """Something moves in view: a box that goes ahead on a tour, to and fro in a room."""
    pose_rate: float | None = Field(None, ge=1e-3, le=1000)
    """Written true poses per second, milliseconds as for images; omitted: one per image."""
    event_gap: Stretch | None = None
    """Start and length in seconds of a stretch whose events are lost."""
    depth_gap: Stretch | None = None
    """Start and length in seconds of a stretch whose depth images are lost."""
    compact_events: bool = False
    """Events as float32: half the disk space; stamps are exact to 0.3 us up to 4 s, 4 us up to a minute."""
    seed: int = Field(0, ge=0, le=2**31 - 1)
    """Seed of path, threshold noise, depth noise, and of all that is random in the sensor."""
    sensor: SensorConfig = SensorConfig()
    depth_sensor: DepthSensorConfig = DepthSensorConfig()

    def __init__(self, **values: Any) -> None:
        """Check the values; the first invalid one raises `ConfigError`."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            problem = error.errors()[0]
            name = ".".join(str(part) for part in problem["loc"])
            raise ConfigError(f"{name}: {problem['msg']}, got {shown(problem['input'])}") from error

    @model_validator(mode="before")
    @classmethod
    def _sized_as_the_sensor(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Take the size of the sensor where none is given."""
        if "sensor" not in values:
            return values
        sensor = SensorConfig.validated(values["sensor"], "sensor")
        size = sensor.sensor.size
        return values if size is None else {"width": size[0], "height": size[1], **values}

    @property
    def states_threshold(self) -> bool:
        """Whether the recording says what C is: real ones do not."""
        return self.sensor.sensor.is_ideal and self.sensor.sensor.positive_threshold is None

    @property
    def depth_measured_by(self) -> DepthSensor:
        """The depth sensor; `depth_noise` chooses one, too."""
        sensor = self.depth_sensor.sensor
        if self.depth_noise == "none":
            return sensor
        if self.depth_sensor != DepthSensorConfig():
            raise ConfigError("depth_noise: expected it alone or depth_sensor alone, got both; leave one out")
        return DEPTH_PRESETS["kinect"]

    @property
    def camera(self) -> "Camera":
        """The pinhole camera, principal point in the middle of the image."""
        from edslam_ti.camera import Camera

        f = self.focal_length or 0.5 * self.width
        return Camera(self.width, self.height, f, f, (self.width - 1) / 2, (self.height - 1) / 2)
