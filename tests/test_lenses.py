"""Lens models against OpenCV's, and events undistorted as images are."""

import cv2
import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.errors import DataError
from edslam_ti.events import Events
from edslam_ti.lenses import Lens, Undistortion, model_name

KINECT = (5.3633, 3.35493, -1e-5, -1e-5, 0.163, 5.69, 5.134, 0.888)
LENSES = [
    Lens(Camera(80, 60, 41, 41, 38, 29.5), "plumb_bob", (-0.031982, 0.041966, -0.000507, -0.001031, 0.0)),
    Lens(Camera(80, 60, 50, 51, 38, 29.5), "plumb_bob", (-0.3, 0.1, 1e-3, -1e-3)),
    Lens(Camera(80, 72, 63, 63, 40, 42), "rational", KINECT),
    Lens(Camera(87, 65, 56, 56, 43, 33), "equidistant", (-0.048, 0.011, -0.056, 0.021)),
]  # fmt: skip


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_rays_hit_their_pixels_in_opencv(lens: Lens) -> None:
    rays = lens.rays.reshape(-1, 2).astype(np.float64)
    assert np.isfinite(rays).all()
    points, zero = np.concatenate([rays, np.ones((len(rays), 1))], 1).reshape(-1, 1, 3), np.zeros(3)
    project = cv2.fisheye.projectPoints if lens.model == "equidistant" else cv2.projectPoints
    pixels, _ = project(points, zero, zero, lens.pinhole.matrix, np.array(lens.coefficients))
    expected = np.indices(lens.pinhole.shape)[::-1].reshape(2, -1).T
    assert np.abs(pixels.reshape(-1, 2) - expected).max() < 0.01
    assert np.abs(pixels.reshape(-1, 2) - lens.project(rays)).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_maps_and_rays_are_inverse(lens: Lens) -> None:
    camera = lens.best_fit
    u, v = lens.maps(camera)
    rays = camera.rays().reshape(-1, 3)[:, :2]
    assert np.abs(lens.project(rays) - np.stack([u.ravel(), v.ravel()], -1)).max() < 0.01
    seen = (u > -0.51) & (u < camera.width - 0.49) & (v > -0.51) & (v < camera.height - 0.49)
    assert seen.mean() > 0.97  # the best fit has hardly an empty pixel


def test_a_turned_camera_of_another_size_sees_the_same_events() -> None:
    lens, angle = LENSES[1], 0.1
    R = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    camera = Camera(100, 50, 45, 45, 49.5, 24.5)
    undistortion = Undistortion(lens, camera, R)
    point = R.T @ np.array([0.2, -0.1, 1.0])  # in the sensor's frame
    pixel = np.rint(lens.project(point[None, :2] / point[2])[0]).astype(np.int16)
    one = Events(pixel[:1], pixel[1:], np.array([0.5]), np.array([-1], np.int8))
    events = undistortion.events(one)
    assert len(events) >= 1
    assert np.abs(events.x - (45 * 0.2 + 49.5)).max() <= 1.5
    assert np.abs(events.y - (45 * -0.1 + 24.5)).max() <= 1.5
    assert (events.t == 0.5).all()
    assert (events.polarity == -1).all()


def test_tables_of_a_large_sensor_are_light() -> None:
    lens = Lens(Camera(1280, 720, 1049, 1049, 634, 364), "equidistant", (0.034, -0.02, 0.022, -0.0048))
    undistortion = Undistortion(lens)
    arrays = [a for a in vars(undistortion.events).values() if isinstance(a, np.ndarray)]
    assert sum(a.nbytes for a in arrays) < 8e6


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("plumb_bob", (0.1,), r"distortion plumb_bob: expected 4 or 5 coefficients k1 k2 p1 p2 k3, got 1"),
        ("plumb_bob", (np.nan, 0, 0, 0), r"expected distortion .* within \+-1000, got nan"),
        ("magic", (), r"distortion model: expected one of plumb_bob"),
    ],
)
def test_a_lens_that_cannot_be_is_refused(model: str, coefficients: tuple, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Lens(Camera(8, 8, 8, 8, 4, 4), model, coefficients)


def test_names_of_other_programs_are_understood() -> None:
    assert model_name("Radtan") == "plumb_bob"
    assert model_name("Brown Conrady") == "plumb_bob"
    assert model_name("kb4") == "equidistant"
    with pytest.raises(DataError, match="got 'fov'"):
        model_name("fov")
