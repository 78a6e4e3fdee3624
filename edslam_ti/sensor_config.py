"""Settings of a simulated event sensor and its faults; docs/sensors.md gives the presets' sources."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator

from edslam_ti.stage import Stage

SensorName = Literal["ideal", "typical", "davis346", "dvxplorer", "prophesee_gen4"]


@dataclass(frozen=True)
class EventSensor:
    """What a simulated event sensor is like; each fault is absent at its default."""

    size: tuple[int, int] | None = None  # width and height in pixels; None: the recording's own
    positive_threshold: float | None = None  # C+; None: the recording's contrast threshold
    negative_threshold: float | None = None  # C-; None: the same as C+
    threshold_spread: float = 0.0  # standard deviation from pixel to pixel, relative
    threshold_jitter: float = 0.0  # standard deviation from event to event, relative
    bandwidth: float = 0.0  # Hz at brightness 1; 0: unlimited
    leak_rate: float = 0.0  # Hz, brighter events of a pixel that sees no change
    shot_noise: float = 0.0  # Hz, noise events of a pixel in the dark
    noise_spread: float = 0.0  # standard deviation of leak and shot noise from pixel to pixel, decades
    dead_time: float = 0.0  # seconds
    hot_pixels: int = 0
    hot_rate: float = 200.0  # Hz, events of a hot pixel

    @property
    def is_ideal(self) -> bool:
        """Whether it has no fault; its size and its thresholds are none."""
        return (
            max(
                *(self.threshold_spread, self.threshold_jitter, self.bandwidth, self.leak_rate),
                *(self.shot_noise, self.dead_time, self.hot_pixels),
            )
            == 0
        )


# Sources in docs/sensors.md.
PRESETS: dict[SensorName, EventSensor] = {
    "ideal": EventSensor(),
    "typical": EventSensor(
        positive_threshold=0.23,
        negative_threshold=0.18,
        threshold_spread=0.15,
        bandwidth=200.0,
        leak_rate=0.1,
        shot_noise=1.5,
        dead_time=5e-4,
        hot_pixels=20,
    ),
    "davis346": EventSensor(
        size=(346, 260),
        positive_threshold=0.25,
        negative_threshold=0.2,
        threshold_spread=0.1,
        threshold_jitter=0.03,
        bandwidth=300.0,
        leak_rate=0.2,
        shot_noise=1.0,
        noise_spread=0.2,
        dead_time=5e-4,
        hot_pixels=20,
    ),
    "dvxplorer": EventSensor(
        size=(640, 480),
        positive_threshold=0.25,
        negative_threshold=0.25,
        threshold_spread=0.08,
        threshold_jitter=0.03,
        bandwidth=400.0,
        leak_rate=0.05,
        shot_noise=0.5,
        noise_spread=0.2,
        dead_time=2e-4,
        hot_pixels=40,
    ),
    "prophesee_gen4": EventSensor(
        size=(1280, 720),
        positive_threshold=0.2,
        negative_threshold=0.2,
        threshold_spread=0.06,
        threshold_jitter=0.02,
        bandwidth=800.0,
        leak_rate=0.02,
        shot_noise=0.3,
        noise_spread=0.2,
        dead_time=2e-4,
        hot_pixels=60,
    ),
}


class SensorConfig(Stage):
    """Simulated event sensor: a preset, and what differs from it."""

    model_config = ConfigDict(allow_inf_nan=False)
    shorthand: ClassVar[str | None] = "preset"

    preset: SensorName = "ideal"
    """ideal; typical: every fault, at sizes between those of real sensors; or a sensor that there is
    (docs/sensors.md). `--sensor NAME` for short. Of a recording that is simulated."""
    size: Annotated[tuple[int, int] | None, Field()] = None
    """Width and height in pixels. Of this and of all below: omitted, the preset's."""
    positive_threshold: float | None = Field(None, ge=0.01, le=10)
    """C+: change of log brightness that fires a brighter event."""
    negative_threshold: float | None = Field(None, ge=0.01, le=10)
    """C- of darker events."""
    threshold_spread: float | None = Field(None, ge=0, le=1)
    """Standard deviation of the thresholds from pixel to pixel, as a share of them."""
    threshold_jitter: float | None = Field(None, ge=0, le=1)
    """Standard deviation of a pixel's threshold from event to event, as a share of it."""
    bandwidth: float | None = Field(None, ge=0, le=1e6)
    """Hz at brightness 1, in proportion to brightness: log brightness passes a low pass; 0: none."""
    leak_rate: float | None = Field(None, ge=0, le=1e3)
    """Hz, at which a pixel that sees no change fires brighter events."""
    shot_noise: float | None = Field(None, ge=0, le=1e3)
    """Hz, at which a dark pixel fires noise events of either polarity; a quarter of it at brightness 1."""
    noise_spread: float | None = Field(None, ge=0, le=2)
    """Standard deviation of both rates from pixel to pixel, decades."""
    dead_time: float | None = Field(None, ge=0, lt=1)
    """Seconds after an event in which a pixel is blind; its reference then is the brightness at their end."""
    hot_pixels: int | None = Field(None, ge=0, le=1_000_000)
    """Number of pixels that fire without cause."""
    hot_rate: float | None = Field(None, ge=0, le=1e5)
    """Hz, at which they fire."""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, values: Any) -> Any:
        """Take a preset's name alone, too."""
        return {"preset": values} if isinstance(values, str) else values

    @property
    def sensor(self) -> EventSensor:
        """The preset with what differs from it."""
        given = {name: value for name, value in self.model_dump(exclude={"preset"}).items()}
        return replace(PRESETS[self.preset], **{k: v for k, v in given.items() if v is not None})

    @property
    def facts(self) -> dict[str, Any]:
        """All values, for what is kept under a name of its own."""
        return asdict(self.sensor)


DepthSensorName = Literal["exact", "kinect", "kinect_azure", "realsense"]


@dataclass(frozen=True)
class DepthSensor:
    """What a simulated depth sensor is like; each fault is absent at its default."""

    axial_noise: float = 0.0  # metres, standard deviation at `noise_from`
    axial_growth: float = 0.0  # 1/m: it grows by this times the square of the distance beyond `noise_from`
    noise_from: float = 0.0  # metres
    noise_width: float = 0.0  # pixels over which noise is alike (standard deviation of a blur)
    disparity_step: float = 0.0  # 1/m: inverse depth is a multiple of it
    lateral_noise: float = 0.0  # pixels: at edges, depth is that of a pixel so far away
    edge_loss: float = 0.0  # share of pixels at edges that are lost
    flying_pixels: float = 0.0  # share of pixels at edges whose depth is between the two surfaces
    dropout: float = 0.0  # share of pixels lost anywhere
    hole_size: float = 0.0  # pixels across such losses; 0: single pixels
    grazing_loss: tuple[float, float] = (0.0, 0.0)  # cosines: lost below the first, kept above the second
    dark_loss: float = 0.0  # brightness at 1 m below which half the pixels are lost
    nearest: float = 0.0  # metres
    farthest: float = 1000.0  # metres
    rate: float | None = None  # Hz; None: the recording's depth rate
    phase: float = 0.0  # seconds, of the first image
    time_offset: float = 0.0  # seconds that stamps are late
    rotation: float = 0.0  # degrees, by which it is turned from where its calibration says
    translation: float = 0.0  # metres, by which it is displaced

    @property
    def is_exact(self) -> bool:
        """Whether what it measures is exact, wherever it stands and whenever it measures."""
        exact = DepthSensor()
        where = ("rate", "phase", "time_offset", "rotation", "translation")
        return replace(self, **{name: getattr(exact, name) for name in where}) == exact

    @property
    def is_displaced(self) -> bool:
        """Whether it sees another view than the event camera has at the stamp."""
        return (self.time_offset, self.rotation, self.translation) != (0.0, 0.0, 0.0)


# Sources in docs/sensors.md.
DEPTH_PRESETS: dict[DepthSensorName, DepthSensor] = {
    "exact": DepthSensor(),
    "kinect": DepthSensor(
        axial_noise=0.0012,
        axial_growth=0.0019,
        noise_from=0.4,
        disparity_step=1 / 351.3,
        lateral_noise=0.5,
        edge_loss=0.75,
        dropout=0.002,
        grazing_loss=(0.10, 0.25),
        nearest=0.4,
        farthest=5.0,
    ),
    "kinect_azure": DepthSensor(
        axial_noise=0.0012,
        axial_growth=0.0004,
        noise_from=0.5,
        edge_loss=0.2,
        flying_pixels=0.35,
        dropout=0.001,
        grazing_loss=(0.08, 0.2),
        dark_loss=0.01,
        nearest=0.5,
        farthest=3.86,
        rate=30.0,
        phase=0.007,
        time_offset=0.002,
        rotation=0.15,
        translation=0.002,
    ),
    "realsense": DepthSensor(
        axial_growth=0.0025,
        noise_width=1.5,
        disparity_step=1 / 1000,
        lateral_noise=1.0,
        edge_loss=0.3,
        flying_pixels=0.2,
        dropout=0.01,
        hole_size=4.0,
        grazing_loss=(0.10, 0.25),
        nearest=0.28,
        farthest=10.0,
        rate=30.0,
        phase=0.011,
        time_offset=0.002,
        rotation=0.15,
        translation=0.002,
    ),
}


class DepthSensorConfig(Stage):
    """Simulated depth sensor: a preset, and what differs from it."""

    model_config = ConfigDict(allow_inf_nan=False)
    shorthand: ClassVar[str | None] = "preset"

    preset: DepthSensorName = "exact"
    """exact, or a sensor that there is (docs/sensors.md). `--depth-sensor NAME` for short. Of a recording
    that is simulated."""
    axial_noise: float | None = Field(None, ge=0, le=1)
    """Standard deviation of depth at the distance `noise_from`, metres. Of this and of all below: omitted,
    the preset's."""
    axial_growth: float | None = Field(None, ge=0, le=1)
    """1/m: it grows by this times the square of the distance beyond `noise_from`."""
    noise_from: float | None = Field(None, ge=0, le=100)
    """Metres."""
    noise_width: float | None = Field(None, ge=0, le=50)
    """Pixels over which noise is alike; 0: every pixel has its own."""
    disparity_step: float | None = Field(None, ge=0, le=1)
    """1/m: inverse depth is a multiple of it; 0: not quantised."""
    lateral_noise: float | None = Field(None, ge=0, le=10)
    """Pixels: at edges, depth is that of a pixel so far away (standard deviation)."""
    edge_loss: float | None = Field(None, ge=0, le=1)
    """Share of pixels at edges that are lost."""
    flying_pixels: float | None = Field(None, ge=0, le=1)
    """Share of pixels at edges whose depth is between those of the two surfaces."""
    dropout: float | None = Field(None, ge=0, le=1)
    """Share of pixels lost anywhere."""
    hole_size: float | None = Field(None, ge=0, le=100)
    """Pixels across such holes; 0: single pixels."""
    grazing_loss: tuple[float, float] | None = None
    """Cosines between ray and surface normal: lost below the first, kept above the second."""
    dark_loss: float | None = Field(None, ge=0, le=1)
    """Brightness below which half of the pixels at 1 m are lost; it grows with the square of depth."""
    nearest: float | None = Field(None, ge=0, le=100)
    """Metres; nothing nearer is measured."""
    farthest: float | None = Field(None, gt=0, le=1000)
    """Metres; nothing beyond is measured."""
    rate: float | None = Field(None, ge=1e-3, le=1000)
    """Hz; omitted where the preset has none: --depth-rate."""
    phase: float | None = Field(None, ge=0, le=10)
    """Seconds, time stamp of the first image: above 0, depth and images are out of step."""
    time_offset: float | None = Field(None, ge=-1, le=1)
    """Seconds by which time stamps are late."""
    rotation: float | None = Field(None, ge=-10, le=10)
    """Degrees by which the sensor is turned from where its calibration says."""
    translation: float | None = Field(None, ge=-1, le=1)
    """Metres by which it is displaced."""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, values: Any) -> Any:
        """Take a preset's name alone, too."""
        return {"preset": values} if isinstance(values, str) else values

    @property
    def sensor(self) -> DepthSensor:
        """The preset with what differs from it."""
        given = self.model_dump(exclude={"preset"}, exclude_none=True)
        return replace(DEPTH_PRESETS[self.preset], **given)

    @property
    def facts(self) -> dict[str, Any]:
        """All values, for what is kept under a name of its own."""
        return asdict(self.sensor)
