"""The event sensor of a simulated recording, ideal or with faults."""

from typing import Protocol

import numpy as np

from edslam_ti.errors import ConfigError
from edslam_ti.kernels.event_sensor import PixelState, PixelTraits, sensed_events
from edslam_ti.kernels.event_simulation import (
    MIN_THRESHOLD,
    NEVER,
    EventArrays,
    EventSensorState,
    simulate_events,
)
from edslam_ti.sensor_config import EventSensor
from edslam_ti.simulation.readout import Readout
from edslam_ti.simulation.settings import SimulationConfig

SECOND = 1_000_000_000  # nanoseconds


class SimulatedSensor(Protocol):
    """A sensor that sees log brightness frame by frame."""

    def advance(self, log_next: np.ndarray, until: int) -> EventArrays:  # [H, W] float32, ns
        """Return the events since the last frame."""
        ...


def make_sensor(config: SimulationConfig, log_first: np.ndarray) -> SimulatedSensor:  # [H, W] float32
    """Return the sensor that the settings state, adapted to a first frame at time 0."""
    sensor = config.sensor.sensor
    if sensor.is_ideal:
        return _IdealSensor(config, log_first)
    if config.refractory_period > 0:
        raise ConfigError(
            "refractory_period: expected it of the ideal sensor alone, got it with faults; use "
            "sensor.dead_time"
        )
    return _FaultySensor(config, log_first)


class _IdealSensor:
    """ESIM's sensor."""

    def __init__(self, config: SimulationConfig, log_first: np.ndarray) -> None:
        self._positive, self._negative = thresholds(config)
        self._config = config
        self._state = EventSensorState.start(log_first)
        self._log, self._now = log_first, 0

    def advance(self, log_next: np.ndarray, until: int) -> EventArrays:
        events = simulate_events(
            self._log,
            log_next,
            self._now,
            until,
            self._state,
            self._positive,
            self._negative,
            self._config.threshold_noise,
            round(self._config.refractory_period * 1e9),
            self._config.seed,
        )
        self._log, self._now = log_next, until
        return events


class _FaultySensor:
    """A sensor whose pixels differ, are slow and blind for a while, and fire without cause."""

    def __init__(self, config: SimulationConfig, log_first: np.ndarray) -> None:
        self._sensor = config.sensor.sensor
        self._epsilon, self._seed = config.log_epsilon, config.seed
        rng = np.random.default_rng([config.seed, 0x5E2509])
        self._traits = _traits(self._sensor, *thresholds(config), log_first.shape, rng)
        self._jitter = np.hypot(
            self._sensor.threshold_jitter, config.threshold_noise / np.mean(thresholds(config))
        )
        self._state = _first_state(self._traits, log_first, rng)
        self._log, self._now = log_first, 0
        sensor = self._sensor
        self._readout = Readout(log_first.shape[0], sensor.scan_period, sensor.event_rate)

    def advance(self, log_next: np.ndarray, until: int) -> EventArrays:
        events = sensed_events(
            self._log,
            log_next,
            self._now,
            until,
            self._traits,
            self._state,
            self._epsilon,
            self._sensor.bandwidth,
            float(self._jitter),
            round(self._sensor.dead_time * SECOND),
            self._seed,
        )
        self._log, self._now = log_next, until
        return self._readout.passed_on(events, until)


def thresholds(config: SimulationConfig) -> tuple[float, float]:
    """Return C+ and C-."""
    sensor = config.sensor.sensor
    positive = sensor.positive_threshold or config.contrast_threshold
    stated = config.negative_contrast_threshold if sensor.positive_threshold is None else None
    return positive, sensor.negative_threshold or stated or positive


def _traits(
    sensor: EventSensor, positive: float, negative: float, shape: tuple[int, ...], rng: np.random.Generator
) -> PixelTraits:
    """Draw what tells pixels from each other."""

    def spread(mean: float) -> np.ndarray:
        drawn = mean * (1 + sensor.threshold_spread * rng.standard_normal(shape))
        return np.maximum(drawn, MIN_THRESHOLD)

    def rates(mean: float) -> np.ndarray:
        return mean * 10 ** (sensor.noise_spread * rng.standard_normal(shape))

    traits = PixelTraits(
        spread(positive),
        spread(negative),
        rates(sensor.leak_rate),
        rates(sensor.shot_noise),
        np.zeros(shape, np.int32),
    )
    hot = rng.choice(traits.noise.size, min(sensor.hot_pixels, traits.noise.size), replace=False)
    traits.noise.ravel()[hot] = sensor.hot_rate
    traits.is_hot.ravel()[hot] = 1
    return traits


def _first_state(traits: PixelTraits, log_first: np.ndarray, rng: np.random.Generator) -> PixelState:
    """Return pixels that have adapted to a first frame; with leak, each is somewhere between two events."""
    filtered = log_first.astype(np.float64)
    leaking = traits.leak > 0
    reference = filtered - np.where(leaking, traits.positive * rng.random(filtered.shape), 0.0)
    rate = np.maximum(traits.noise, 1e-9)
    wait = np.minimum(rng.exponential(1.0, filtered.shape) / rate, 1e9) * SECOND
    return PixelState(
        filtered,
        reference,
        np.full(filtered.shape, -1, np.int64),
        np.where(traits.noise > 0, wait, float(-NEVER)).astype(np.int64),
        np.zeros(filtered.shape, np.int32),
        np.zeros(filtered.shape, np.int32),
    )
