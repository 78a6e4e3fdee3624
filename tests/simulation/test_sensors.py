"""Sensors of simulated recordings: presets, read-out, lens, and depth out of step with the events."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sequences import record_tiny_room, tiny_room

from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import open_sequence
from edslam_ti.datasets.builtin import key_of
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError
from edslam_ti.kernels.event_simulation import EventArrays
from edslam_ti.sensor_config import DEPTH_PRESETS, PRESETS, DepthSensor, SensorConfig
from edslam_ti.simulation import HandHeldPath, SimulationConfig
from edslam_ti.simulation.depth_noise import measured_depth
from edslam_ti.simulation.event_sensor import make_sensor
from edslam_ti.simulation.readout import QUEUE, Readout
from edslam_ti.simulation.renderer import Renderer

MILLISECOND = 1_000_000  # nanoseconds


# --- settings ---


def test_what_is_given_differs_from_the_preset() -> None:
    config = SensorConfig(preset="davis346", dead_time=0.0)
    assert config.sensor.dead_time == 0
    assert config.sensor.bandwidth == PRESETS["davis346"].bandwidth
    assert SensorConfig.validated({"preset": "davis346", "dead_time": 0.0}, "x") == config
    assert Config().updated({"sensor": "typical"}).sensor == SensorConfig(preset="typical")
    assert not any(sensor.is_ideal for name, sensor in PRESETS.items() if name != "ideal")


def test_each_fault_makes_a_recording_of_its_own() -> None:
    configs = [
        SimulationConfig(sensor=s) for s in ({"dead_time": 1e-3}, {"hot_pixels": 3}, "typical", "ideal")
    ]
    configs.append(SimulationConfig(depth_sensor={"rotation": 1.0}))
    assert len({key_of(config) for config in configs}) == len(configs)
    assert "sensor" not in key_of(SimulationConfig())  # recordings made before sensors had faults stay valid


def test_size_and_lens_are_the_sensors_unless_given() -> None:
    config = SimulationConfig(sensor="davis346")
    assert (config.width, config.height) == (346, 260)
    assert config.camera.fx == pytest.approx(226.3)
    half = SimulationConfig(sensor="davis346", width=173, height=130)
    assert half.camera.fx == pytest.approx(226.3 / 2)
    assert half.lens is not None
    assert SimulationConfig(sensor={"preset": "davis346", "distortion": [0.0] * 4}).lens is None


def test_the_older_refractory_period_and_depth_noise_exclude_sensors() -> None:
    config = SimulationConfig(sensor="typical", refractory_period=1e-3)
    with pytest.raises(ConfigError, match=r"refractory_period: .*use sensor\.dead_time"):
        make_sensor(config, np.zeros((4, 4), np.float32))
    with pytest.raises(ConfigError, match="depth_noise: expected it alone"):
        _ = SimulationConfig(depth_sensor="realsense", depth_noise="kinect").depth_measured_by


# --- pixels ---


def test_thresholds_are_spread_over_pixels_and_differ_by_polarity() -> None:
    config = SimulationConfig(
        sensor={"positive_threshold": 0.23, "negative_threshold": 0.18, "threshold_spread": 0.15}
    )
    low, shape = np.float32(-2.0), (80, 100)
    thresholds = {}
    for p, name in ((1, "positive"), (-1, "negative")):
        sensor = make_sensor(config, np.full(shape, low))
        events = sensor.advance(np.full(shape, low + np.float32(0.6 * p)), 600 * MILLISECOND)
        first = np.full(shape, 2**62)
        np.minimum.at(first, (events.y, events.x), events.t)
        thresholds[name] = first / 1e9
        assert (events.polarity == p).all()
    # 8000 pixels: standard errors of 0.0004 (mean) and 0.0003 (spread).
    assert thresholds["positive"].mean() == pytest.approx(0.23, abs=0.0015)
    assert thresholds["negative"].mean() == pytest.approx(0.18, abs=0.0012)
    assert thresholds["positive"].std() == pytest.approx(0.15 * 0.23, abs=0.001)
    together = np.corrcoef(thresholds["positive"].ravel(), thresholds["negative"].ravel())[0, 1]
    assert abs(together) < 0.05


def test_hot_pixels_are_as_many_as_stated_and_stay_the_same() -> None:
    config = SimulationConfig(sensor={"hot_pixels": 7, "hot_rate": 500.0})
    log = np.full((40, 60), -1.0, np.float32)
    sensor = make_sensor(config, log)
    seen = [sensor.advance(log, k * 100 * MILLISECOND) for k in (1, 2)]
    pixels = [set(zip(events.x.tolist(), events.y.tolist())) for events in seen]
    assert len(pixels[0]) == 7
    assert pixels[0] == pixels[1]


# --- read-out ---


def burst(count: int, t: int, width: int = 100) -> EventArrays:
    k = np.arange(count)
    return EventArrays(
        (k % width).astype(np.int16), (k // width).astype(np.int16),
        np.full(count, t, np.int64), np.ones(count, np.int8),
    )  # fmt: skip


def test_scanned_rows_have_one_time_stamp_each() -> None:
    readout = Readout(height=10, period=1e-3, rate=0.0)
    first = readout.passed_on(burst(1000, 50_000), MILLISECOND)
    # Row r is read at (r + 1) / 10 ms: all of them after 0.05 ms.
    np.testing.assert_array_equal(first.t, 100_000 * (first.y.astype(int) + 1))
    assert len(first.t) == 1000
    again = EventArrays(*(np.concatenate([a, a]) for a in (first.x, first.y, first.t - 1, first.polarity)))
    later = Readout(10, 1e-3, 0.0).passed_on(again, 2 * MILLISECOND)
    assert len(later.t) == 1000  # a pixel has one event in a scan


def test_a_scan_that_is_not_over_waits_for_the_next_call() -> None:
    readout = Readout(height=10, period=1e-3, rate=0.0)
    first = readout.passed_on(burst(1000, 50_000), 500_000)
    second = readout.passed_on(burst(0, 0), MILLISECOND)
    assert len(first.t) == 500
    assert len(second.t) == 500
    assert first.t.max() <= 500_000 < second.t.min()


def test_a_limited_rate_delays_events_as_a_queue_does() -> None:
    readout = Readout(height=10, period=0.0, rate=1e6)  # one in a microsecond
    times = np.array([0, 100, 200, 5000, 5100, 5100])
    zeros = np.zeros(6, np.int16)
    events = readout.passed_on(EventArrays(zeros, zeros, times, np.ones(6, np.int8)), 10_000)
    assert events.t.tolist() == [1000, 2000, 3000, 6000, 7000, 8000]
    free_at, expected = 0, []
    rng = np.random.default_rng(0)
    times = np.sort(rng.integers(10_000, 400_000, 500))
    for t in times:
        free_at = max(t, free_at) + 1000
        expected.append(free_at)
    zeros = np.zeros(500, np.int16)
    parts = [
        readout.passed_on(EventArrays(zeros[m], zeros[m], times[m], np.ones(m.sum(), np.int8)), until)
        for m, until in ((times <= 200_000, 200_000), (times > 200_000, 400_000))
    ]
    assert np.abs(np.concatenate([p.t for p in parts]) - expected).max() <= 1


def test_what_finds_no_room_is_lost() -> None:
    readout = Readout(height=300, period=0.0, rate=1e6)
    events = readout.passed_on(burst(30_000, 0), MILLISECOND)
    assert len(events.t) == pytest.approx(QUEUE / 1000, rel=0.02)  # what the buffers hold
    assert (np.diff(events.t) > 0).all()


# --- lens ---


def test_distorted_recording_is_the_undistorted_one_once_it_is_opened(tmp_path: Path) -> None:
    times = {"duration": 0.12, "max_motion": 4.0, "image_rate": 10.0, "depth_rate": 10.0}
    strong = {"distortion": (-0.08, 0.02, 0.0, 0.0)}
    straight = EventReplicaSequence(record_tiny_room(tmp_path / "a", **times))
    bent = EventReplicaSequence(record_tiny_room(tmp_path / "b", **times, sensor=strong))
    assert bent.description.endswith(" (simulated sensor ideal with changes)")
    assert bent.contrast_threshold == 0.1  # a lens alone leaves C known
    raw = cv2.imread(str(tmp_path / "b/images/frame000100.png"), cv2.IMREAD_GRAYSCALE) / 255
    inner = np.s_[12:-12, 18:-18]
    expected = straight.image(1)[inner]
    assert np.abs(bent.image(1)[inner] - expected).mean() < 0.3 * np.abs(raw[inner] - expected).mean()
    np.testing.assert_array_equal(bent.depth(1), straight.depth(1))
    views = [sequence.novel_views()[0] for sequence in (straight, bent)]
    np.testing.assert_array_equal(views[0].depth, views[1].depth)
    assert np.abs(views[0].image[inner] - views[1].image[inner]).mean() < 0.02
    # Of the events, the pattern over the image is the same.
    counts = []
    for sequence in (straight, bent):
        events = sequence.events(0, 1)
        image = np.zeros(sequence.camera.shape, np.float32)
        np.add.at(image, (events.y, events.x), events.polarity)
        counts.append(cv2.GaussianBlur(image, (0, 0), 1.5)[inner].ravel())
    assert np.corrcoef(counts[0], counts[1])[0, 1] > 0.8


# --- depth ---

CAMERA = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)


def step_image() -> np.ndarray:
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    depth[:, :80] = 1.0
    return depth


def measured(**faults: Any) -> np.ndarray:
    depth = step_image()
    sensor = DepthSensor(**faults)
    grey = np.where(np.arange(160) % 2 == 0, 0.004, 0.8) * np.ones(CAMERA.shape)
    return measured_depth(depth, np.ones(CAMERA.shape), grey, CAMERA, sensor, np.random.default_rng(0))


def test_each_fault_of_depth_does_what_it_says_and_nothing_else() -> None:
    depth = step_image()
    edge = np.zeros(CAMERA.shape, bool)
    edge[:, 79:81] = True
    np.testing.assert_array_equal(measured(), depth)
    for width in (0.0, 2.0):
        noisy = measured(axial_noise=0.01, axial_growth=0.01, noise_width=width) - depth
        assert noisy[:, 2:70].std() == pytest.approx(0.02, rel=0.15)
        assert noisy[:, 90:].std() == pytest.approx(0.05, rel=0.15)
        beside = np.corrcoef(noisy[:, :70].ravel(), noisy[:, 1:71].ravel())[0, 1]
        assert beside > 0.8 if width else abs(beside) < 0.05
    flying = measured(flying_pixels=0.5)
    assert (flying[~edge] == depth[~edge]).all()
    between = (flying > 1.01) & (flying < 1.99)
    assert between[edge].mean() == pytest.approx(0.5, abs=0.12)
    lost = measured(edge_loss=0.4) == 0
    assert lost[edge].mean() == pytest.approx(0.4, abs=0.12)
    assert not lost[~edge].any()
    for size in (0.0, 5.0):
        lost = measured(dropout=0.05, hole_size=size) == 0
        assert lost.mean() == pytest.approx(0.05, abs=0.008)
        together = (lost[:, 1:] & lost[:, :-1]).sum() / lost.sum()
        assert together > 0.6 if size else together < 0.1
    lost = measured(dark_loss=0.01) == 0
    assert lost[:, :80:2].mean() == pytest.approx(1 - 0.004 / 0.02, abs=0.03)  # dark columns, 1 m away
    assert not lost[:, 1::2].any()
    assert (measured(nearest=1.5)[:, :80] == 0).all()
    assert (measured(farthest=1.5)[:, 80:] == 0).all()


def test_depth_is_of_the_moment_and_the_place_that_the_sensor_states(tmp_path: Path) -> None:
    times = {"duration": 0.3, "max_motion": 8.0, "image_rate": 10.0, "depth_rate": 20.0}
    late = {"rate": 25.0, "phase": 0.007, "time_offset": 0.02}
    folder = record_tiny_room(tmp_path / "late", **times, depth_sensor=late)
    names = sorted(path.name for path in (folder / "depth").iterdir())
    assert names[:3] == ["frame000007.png", "frame000047.png", "frame000087.png"]
    # A stamp that is 20 ms late: what the camera saw 20 ms before.
    sequence = EventReplicaSequence(folder)
    path = HandHeldPath(tiny_room(), 0.3)
    renderer = Renderer(tiny_room().scene, sequence.camera, 1)
    exact = renderer.render(path.pose(0.067)).depth
    assert np.abs(sequence.depth(2) - exact).max() < 2e-4  # units of depth
    there = record_tiny_room(tmp_path / "turned", **times, depth_sensor={"rotation": 2.0})
    turned = EventReplicaSequence(there).depth(2)
    assert np.median(np.abs(turned - renderer.render(path.pose(0.1)).depth)) > 5e-3


def test_images_come_with_depth_that_has_a_rate_of_its_own() -> None:
    assert SimulationConfig(depth_sensor="kinect").image_rhythm == (20.0, 0.0)
    assert SimulationConfig(depth_sensor="realsense").image_rhythm == (30.0, 0.011)
    assert SimulationConfig(depth_sensor="realsense", image_rate=10.0).image_rhythm == (10.0, 0.0)


def test_only_built_in_rooms_have_simulated_sensors(tiny_folder: Path) -> None:
    settings = {"scene": tiny_folder.name, "data_dir": tiny_folder.parent, "dataset": "event_replica"}
    for key, value in (("sensor", "typical"), ("depth_sensor", "kinect")):
        with pytest.raises(ConfigError, match=f"{key}: expected with built-in rooms alone"):
            open_sequence(Config(**settings).updated({key: value}))


def test_presets_of_depth_sensors_measure_most_of_a_wall_to_a_few_millimetres() -> None:
    for name, sensor in DEPTH_PRESETS.items():
        depth = step_image()
        found = measured_depth(
            depth, np.ones(CAMERA.shape), None, CAMERA, sensor, np.random.default_rng(1)
        )  # fmt: skip
        is_measured = found[:, 2:70] > 0
        assert is_measured.mean() > 0.97, name
        assert np.abs(found[:, 2:70] - 1)[is_measured].mean() < 0.004, name
