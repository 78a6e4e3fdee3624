"""What events say about their sensor: dead time, noise and hot pixels, and nothing where there is nothing."""

import functools
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sequences import record_tiny_room

from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.datasets.rpg import RpgSequence
from edslam_ti.event_images.contrast import contrast_from_images
from edslam_ti.event_images.intervals import MOST_WORTH, event_worth, intervals
from edslam_ti.event_images.sensor import SensorEstimate, estimate_from_events, estimate_sensor
from edslam_ti.events import Events
from edslam_ti.results.sensor import plot_sensor, sensor_lines, sensor_metrics
from edslam_ti.simulation import SimulationConfig
from edslam_ti.simulation.event_sensor import make_sensor

SHAPE = (100, 140)  # (H, W)
STEP = 0.004  # s, between frames
NUM_FRAMES = 150


@functools.cache
def pattern() -> np.ndarray:  # [100, 140 + frames] brightness
    """Return blots on a wall that is plain elsewhere, wide enough to move past the camera."""
    rng = np.random.default_rng(0)
    wall = np.full((SHAPE[0], SHAPE[1] + 2 * NUM_FRAMES), 0.4, np.float32)
    for _ in range(14):
        x, y = int(rng.integers(0, wall.shape[1])), int(rng.integers(0, 40))
        cv2.circle(wall, (x, y), int(rng.integers(3, 9)), float(rng.choice([0.03, 0.08, 0.9])), -1)
    return cv2.GaussianBlur(wall, (0, 0), 0.7)


@functools.cache
def moving(sensor: str) -> Events:
    """Return the events of a sensor (settings as JSON) that the wall moves past, one pixel a frame."""
    config = SimulationConfig(contrast_threshold=0.15, sensor=json.loads(sensor))
    frames = (np.log(pattern()[:, k : k + SHAPE[1]] + config.log_epsilon) for k in range(NUM_FRAMES))
    camera = make_sensor(config, next(frames))
    parts = [camera.advance(frame, round((k + 1) * STEP * 1e9)) for k, frame in enumerate(frames)]
    x, y, t, p = (np.concatenate([getattr(e, n) for e in parts]) for n in ("x", "y", "t", "polarity"))
    return Events(x, y, t / 1e9, p)


def estimated(**sensor: Any) -> SensorEstimate:
    return estimate_from_events(moving(json.dumps(sensor)), SHAPE)


def test_nothing_is_found_in_ideal_events() -> None:
    found = estimated()
    assert found.dead_time is None
    assert len(found.hot_pixels) == 0
    assert found.noise_rate is not None
    assert found.noise_rate < 0.3


@pytest.mark.parametrize("dead_time", [5e-4, 2e-3])
def test_dead_time_is_the_shortest_interval_of_either_kind(dead_time: float) -> None:
    found = estimated(dead_time=dead_time, shot_noise=10.0)
    assert found.dead_time == pytest.approx(dead_time, rel=0.1)
    assert found.short_share > 0.0005


def test_noise_alone_is_measured_and_gives_no_dead_time() -> None:
    found = estimated(shot_noise=4.0)
    assert found.dead_time is None
    assert found.noise_rate == pytest.approx(4.0 * (1 - 0.75 * 0.4), rel=0.15)  # the wall's brightness is 0.4
    assert found.noise_positive_share == pytest.approx(0.5, abs=0.05)


def test_leak_is_noise_of_one_polarity() -> None:
    found = estimated(leak_rate=1.0)
    assert found.noise_rate == pytest.approx(1.0, rel=0.35)  # neighbours that a blot has passed leak together
    assert found.noise_positive_share is not None
    assert found.noise_positive_share > 0.95


def test_hot_pixels_are_found_where_little_else_fires() -> None:
    found = estimated(hot_pixels=12, hot_rate=400.0)
    assert 9 <= len(found.hot_pixels) <= 12
    events = moving(json.dumps({"hot_pixels": 12, "hot_rate": 400.0}))
    numbers = np.zeros(SHAPE, int)
    np.add.at(numbers, (events.y, events.x), 1)
    x, y = found.hot_pixels.T
    assert (numbers[y, x] > 150).all()


def test_few_events_say_nothing_and_do_no_harm() -> None:
    for events in (Events.empty(), moving(json.dumps({}))[:10]):
        found = estimate_from_events(events, SHAPE)
        assert found.dead_time is None
        assert found.shortest_interval is None
        assert sensor_metrics(found, None)["dead_time_ms"] is None
        assert len(sensor_lines(found, None)) == 3


def test_intervals_are_those_of_each_pixel() -> None:
    x, y = np.array([0, 1, 0, 0, 1], np.int16), np.zeros(5, np.int16)
    events = Events(x, y, np.array([0.0, 0.1, 0.3, 0.7, 0.8]), np.array([1, 1, 1, -1, 1], np.int8))
    since, is_same = intervals(events, 2)
    np.testing.assert_allclose(since, [np.inf, np.inf, 0.3, 0.4, 0.7])
    assert is_same.tolist() == [False, False, True, False, True]


def test_an_event_is_worth_the_change_since_the_last_one() -> None:
    # Brightness rises by 100 a second: a threshold of 0.1 takes 1 ms, after 0.5 ms of blindness.
    worth = event_worth(np.array([np.inf, 1.5e-3, 1.5e-3, 1e-4]), np.array([0, 1, 0, 1], bool), 5e-4)
    np.testing.assert_allclose(worth, [1.0, 1.5, 1.0, MOST_WORTH])
    assert (event_worth(np.array([1e-4, np.inf]), np.array([True, False]), None) == 1).all()


def test_images_decide_between_a_dead_time_and_steep_edges(tmp_path: Path) -> None:
    # A dead time of which no noise tells: the shortest interval is longer, and images say by how much.
    times = {"duration": 0.5, "speed": 2.0, "image_rate": 30.0}
    estimates = {}
    for name, sensor in (("ideal", {}), ("blind", {"dead_time": 1e-3})):
        sequence = EventReplicaSequence(record_tiny_room(tmp_path / name, **times, sensor=sensor))
        estimates[name] = estimate_sensor(sequence, *sequence.time_range)
    assert estimates["ideal"].dead_time is None
    assert estimates["blind"].dead_time == pytest.approx(1e-3, rel=0.25)
    contrast = contrast_from_images(sequence, *sequence.time_range)
    assert contrast is not None
    assert contrast.deviations is not None
    metrics = sensor_metrics(estimates["blind"], contrast)
    assert metrics["threshold_positive_deviation"] < 0.02
    assert 0.7 < metrics["dead_time_ms"] < 1.3
    plot_sensor(estimates["blind"], contrast, tmp_path / "sensor.png")
    assert cv2.imread(str(tmp_path / "sensor.png")).shape[1] > 1000


def test_a_real_recording_of_slow_motion_shows_no_dead_time(shared_data: Path) -> None:
    sequence = RpgSequence(shared_data / "slider_depth")
    found = estimate_sensor(sequence, *sequence.time_range)
    assert found.dead_time is None
    assert found.positive_share == pytest.approx(0.43, abs=0.03)
    assert found.noise_rate is not None
    assert found.noise_rate < 0.2
