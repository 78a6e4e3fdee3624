"""Rooms, meshes, rendering, paths and recordings on disk."""

import functools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_meshes import SQUARE, write_glb, write_textured_square

from edslam_ti.camera import Camera
from edslam_ti.datasets.builtin import builtin_sequence_folder
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.open3d_loader import load_open3d
from edslam_ti.ray_casting import RayCaster
from edslam_ti.simulation import (
    ROOM_NAMES,
    SCENE_NAMES,
    HandHeldPath,
    RecordedPath,
    Room,
    SimulationConfig,
    load_mesh,
    look_at,
    make_path,
    make_room,
    simulate,
)
from edslam_ti.simulation.catalogue import UNSEEN_ROOM_NAMES
from edslam_ti.simulation.depth_noise import kinect_depth
from edslam_ti.simulation.moving import MovingRenderer, moving_object
from edslam_ti.simulation.paths import TourPath
from edslam_ti.simulation.renderer import Renderer
from edslam_ti.simulation.scene import Material, SceneBuilder
from edslam_ti.trajectory import Trajectory, read_tum

pytestmark = pytest.mark.slow  # whole runs, or processes of their own


TINY = SimulationConfig(width=96, height=64, duration=0.3)


@functools.cache
def cached_room(name: str) -> Room:
    return make_room(name)


@pytest.fixture(scope="module")
def office() -> Room:
    return cached_room("office0")


@pytest.fixture(scope="module")
def recording(office: Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "office0"
    simulate(office.scene, HandHeldPath(office, TINY.duration), TINY, folder)
    return folder


def read_events(folder: Path) -> np.ndarray:
    return np.load(folder / "event_threshold_0.1" / "gray_events_data.npy", mmap_mode="r")


def read_poses(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)


def checker_box() -> SceneBuilder:
    builder = SceneBuilder(seed=0)
    y, x = np.mgrid[0:64, 0:64]
    texture = builder.texture(np.where((x // 16 + y // 16) % 2 == 0, 0.2, 0.8).astype(np.float32))
    builder.box((-1, 2, -0.5), (1, 3, 1.5), Material(texture, texel=0.01))
    return builder


def test_depth_of_a_box_is_exact() -> None:
    camera = Camera(33, 21, 20.0, 20.0, 16.0, 10.0)
    eye = np.array([0.0, 0.0, 0.5])
    render = Renderer(checker_box().build("box"), camera).render(
        look_at(eye, eye + [0, 1, 0], np.array([0, 0, 1.0]))
    )
    inside = np.zeros(camera.shape, bool)
    inside[1:20, 7:26] = True  # the front face spans +-1 m at 2 m: +-10 pixels
    np.testing.assert_allclose(render.depth[inside], 2.0, rtol=1e-6)
    assert render.depth[:, 5].max() == 0  # beside the box there is nothing


def test_texture_is_averaged_over_the_pixel() -> None:
    # Checks of 0.16 m seen by pixels of 0.8 m, and a floor-like grazing view of them: their mean remains.
    builder = SceneBuilder(seed=0)
    y, x = np.mgrid[0:64, 0:64]
    checks = builder.texture(np.where((x // 16 + y // 16) % 2 == 0, 0.2, 0.8).astype(np.float32))
    builder.quad((-40, 80, 40), (80, 0, 0), (0, 0, -80), Material(checks, texel=0.01))
    builder.quad((-40, 80, -1), (80, 0, 0), (0, -70, 0), Material(checks, texel=0.01))
    camera = Camera(41, 41, 100.0, 100.0, 20.0, 20.0)
    render = Renderer(builder.build("checks"), camera).render(
        look_at(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]))
    )
    assert np.abs(render.grey[:19] - 0.5).max() < 0.06
    assert np.abs(render.grey[24] - 0.5).max() < 0.2  # 25 m away, 25 times as long as wide


def test_edge_pixels_hold_the_covered_share() -> None:
    builder = SceneBuilder(seed=0)
    white = builder.texture(np.full((8, 8), 0.9, np.float32))
    builder.quad((-2, 2, 2), (4, 0, 0), (0, 0, -4), Material(white))
    black = builder.texture(np.full((8, 8), 0.1, np.float32))
    builder.quad((-2, 1, 2), (2.02, 0, 0), (0, 0, -4), Material(black))
    camera = Camera(9, 9, 20.0, 20.0, 4.0, 4.0)  # the black edge at x = 0.02 m, 1 m away, is at u = 4.4
    render = Renderer(builder.build("edge"), camera, samples_per_edge_pixel=16).render(
        look_at(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]))
    )
    # Pixel 4 spans 3.5 to 4.5: 0.9 of it is black. One of 16 samples is 0.05.
    np.testing.assert_allclose(render.grey[4], [0.1] * 4 + [0.1 * 0.9 + 0.9 * 0.1] + [0.9] * 4, atol=0.051)


def test_image_warped_by_true_depth_and_pose_matches(office: Room) -> None:
    camera = Camera(160, 100, 80.0, 80.0, 79.5, 49.5)
    renderer = Renderer(office.scene, camera)
    path = HandHeldPath(office, 1.0)
    T_a, T_b = path.pose(0.3), path.pose(0.4)
    a, b = renderer.render(T_a), renderer.render(T_b)
    points = camera.rays() * a.depth[..., None]
    T = np.linalg.inv(T_b) @ T_a
    moved = points @ T[:3, :3].T + T[:3, 3]
    u = camera.fx * moved[..., 0] / moved[..., 2] + camera.cx
    v = camera.fy * moved[..., 1] / moved[..., 2] + camera.cy

    def difference(shift: float) -> float:
        at = ((u + shift).astype(np.float32), (v + shift).astype(np.float32))
        grey = cv2.remap(b.grey, *at, cv2.INTER_LINEAR, borderValue=-1)
        depth = cv2.remap(b.depth, *at, cv2.INTER_NEAREST, borderValue=0)
        seen = (grey >= 0) & (np.abs(depth - moved[..., 2]) < 0.03)
        assert seen.mean() > 0.6
        return float(np.median(np.abs(grey - a.grey)[seen]))

    assert np.hypot(u - np.arange(160), v - np.arange(100)[:, None]).mean() > 2  # pixels of motion
    assert difference(0.0) < 0.015
    # Half a pixel off, in either direction, is clearly worse: centres are at integer coordinates.
    assert difference(0.0) < 0.7 * min(difference(0.5), difference(-0.5))


@pytest.mark.parametrize("name", [*ROOM_NAMES, *UNSEEN_ROOM_NAMES])
def test_room_is_closed_and_textured(name: str) -> None:
    room = cached_room(name)
    config = SimulationConfig(width=120, height=76)
    path = HandHeldPath(room, 6.0, seed=0)
    renderer = Renderer(room.scene, config.camera)
    for t in (0.0, 1.3, 2.5):
        render = renderer.render(path.pose(t))
        assert (render.depth > 0).all()
        assert 0.15 < render.grey.mean() < 0.75
        # Nearly every region has contrast: blocks of 12 x 12 pixels that are flat are rare.
        blocks = np.log(render.grey[:72, :120] + 0.004).reshape(6, 12, 10, 12).swapaxes(1, 2)
        assert (np.ptp(blocks, axis=(2, 3)) > 0.1).mean() > 0.85


def test_wall_is_flat_textured_and_fills_the_view() -> None:
    room = cached_room("wall")
    config = SimulationConfig(width=120, height=76)
    renderer = Renderer(room.scene, config.camera)
    for seed in (0, 1):
        path = HandHeldPath(room, 6.0, seed)
        for t in (0.0, 1.3, 2.5, 4.1):
            T = path.pose(t)
            render = renderer.render(T)
            v, u = np.mgrid[0:76, 0:120]
            rays = np.stack([(u - config.camera.cx) / 60, (v - config.camera.cy) / 60, np.ones_like(u)], -1)
            points = (rays * render.depth[..., None]) @ T[:3, :3].T + T[:3, 3]
            assert (render.depth > 0).all()
            np.testing.assert_allclose(points[..., 1], 2.5, atol=1e-4)
            blocks = np.log(render.grey[:72, :120] + 0.004).reshape(6, 12, 10, 12).swapaxes(1, 2)
            assert (np.ptp(blocks, axis=(2, 3)) > 0.1).mean() > 0.95


def test_corridor_is_long_and_has_less_texture_than_a_room() -> None:
    config = SimulationConfig(width=120, height=76)

    def contrast(name: str) -> float:
        room = cached_room(name)
        render = Renderer(room.scene, config.camera).render(HandHeldPath(room, 6.0, seed=0).pose(1.0))
        assert (render.depth > 0).all()
        assert name != "corridor" or render.depth.max() > 9
        return float(np.median(np.abs(np.diff(np.log(render.grey + 0.004), axis=1))))

    assert contrast("corridor") < 0.75 * contrast("office0")


def test_room_is_the_same_every_time(office: Room) -> None:
    first, again = office.scene, make_room("office0").scene
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.texture_table().texels, again.texture_table().texels)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_path_is_hand_held_and_clear_of_furniture(name: str) -> None:
    o3d = load_open3d()
    room = cached_room(name)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(room.scene.vertices), o3d.core.Tensor(room.scene.triangles))
    times = np.arange(0, 12, 0.02)
    for seed in (0, 1):
        path = HandHeldPath(room, 12.0, seed)
        poses = np.array([path.pose(t) for t in times])
        positions = poses[:, :3, 3].astype(np.float32)
        assert scene.compute_distance(o3d.core.Tensor(positions)).numpy().min() > 0.25
        speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.02
        relative = poses[:-1, :3, :3].swapaxes(1, 2) @ poses[1:, :3, :3]
        turn = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))) / 0.02
        assert 0.25 < speed.mean() < 0.6
        assert 0.6 < speed.max() < 1.6
        slowest = 8 if name in ("wall", "corridor") else 15  # little to look at on either side
        assert slowest < turn.mean() < 60
        assert 3 * slowest < turn.max() < 200


@pytest.mark.parametrize("name", [n for n in SCENE_NAMES if n != "wall"])
def test_loop_turns_around_returns_and_stays_clear_of_furniture(name: str) -> None:
    o3d = load_open3d()
    room = cached_room(name)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(room.scene.vertices), o3d.core.Tensor(room.scene.triangles))
    path = make_path(room, SimulationConfig(path="loop", duration=30.0, seed=1))
    poses = np.array([path.pose(t) for t in np.arange(0, 30.01, 0.05)])
    positions = poses[:, :3, 3].astype(np.float32)
    assert scene.compute_distance(o3d.core.Tensor(positions)).numpy().min() > 0.25
    assert 8 < np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() < 18
    np.testing.assert_allclose(path.pose(30.0), path.pose(0.0), atol=1e-9)
    forward = poses[:, :3, 2]
    np.testing.assert_array_less((forward @ forward[0]).min(), -0.8)  # looks behind on the way


def test_loop_needs_a_closed_room() -> None:
    with pytest.raises(DataError, match="expected a closed room, got scene 'wall'"):
        make_path(cached_room("wall"), SimulationConfig(path="loop"))


def test_rotation_turns_on_the_spot(office: Room) -> None:
    path = make_path(office, SimulationConfig(path="rotation"))
    poses = np.array([path.pose(t) for t in (0.0, 0.5, 1.0)])
    np.testing.assert_array_equal(poses[1:, :3, 3], poses[:2, :3, 3])
    assert np.degrees(np.arccos(poses[0, :3, 2] @ poses[2, :3, 2])) > 10


def test_stop_and_go_rests_without_a_tremor(office: Room) -> None:
    path = make_path(office, SimulationConfig(path="stop_and_go"))
    np.testing.assert_array_equal(path.pose(1.0), path.pose(1.6))  # STOP
    assert np.linalg.norm(path.pose(1.6)[:3, 3] - path.pose(2.6)[:3, 3]) > 0.05  # GO


def test_recording_can_lose_a_stretch_of_each_stream(office: Room, tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"event_gap": (0.1, 0.08), "depth_gap": (0.08, 0.05)})
    simulate(office.scene, HandHeldPath(office, TINY.duration), settings, tmp_path / "gaps")
    t = read_events(tmp_path / "gaps")[:, 2]
    assert not ((t >= 0.1) & (t < 0.18)).any()
    assert ((t >= 0.18) & (t < 0.19)).any()
    depths = sorted(p.name for p in (tmp_path / "gaps" / "depth").glob("*.png"))
    assert depths == [f"frame000{t:03d}.png" for t in (0, 50, 150, 200, 250, 300)]


def test_compact_events_and_dense_poses(office: Room, recording: Path, tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"compact_events": True, "pose_rate": 100.0})
    simulate(office.scene, HandHeldPath(office, TINY.duration), settings, tmp_path / "compact")
    full, compact = read_events(recording), read_events(tmp_path / "compact")
    assert compact.dtype == np.float32
    np.testing.assert_array_equal(compact[:, [0, 1, 3]], full[:, [0, 1, 3]])
    np.testing.assert_allclose(compact[:, 2], full[:, 2], rtol=0, atol=3e-8)  # float32 below 0.5 s
    np.testing.assert_allclose(np.loadtxt(tmp_path / "compact" / "poses_ts.txt"), np.arange(31) * 0.01)
    np.testing.assert_allclose(read_poses(tmp_path / "compact")[::5], read_poses(recording), atol=1e-12)


def test_recording_has_the_published_layout(recording: Path) -> None:
    stamps = np.loadtxt(recording / "poses_ts.txt")
    images = sorted((recording / "images").glob("frame*.png"))
    depths = sorted((recording / "depth").glob("frame*.png"))
    np.testing.assert_allclose(stamps, np.arange(7) * 0.05)
    assert [p.name for p in images] == [f"frame{round(1e3 * t):06d}.png" for t in stamps]
    assert [p.name for p in depths] == [p.name for p in images]
    assert read_poses(recording).shape == (7, 4, 4)
    image = cv2.imread(str(images[0]), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(depths[0]), cv2.IMREAD_UNCHANGED)
    assert (image.dtype, image.shape) == (np.uint8, (64, 96))
    assert (depth.dtype, depth.shape) == (np.uint16, (64, 96))
    camera = json.loads((recording / "camera.json").read_text())
    assert (camera["fx"], camera["cx"], camera["cy"]) == (48.0, 47.5, 31.5)
    assert camera["pixel_centres"] == "integer"
    assert camera["depth_scale"] == 5000
    assert "not Replica" in camera["description"]
    assert "not Replica" in (recording / "README.txt").read_text()


def test_events_are_sorted_inside_and_plausibly_many(recording: Path) -> None:
    events = read_events(recording)
    x, y, t, p = np.asarray(events).T
    assert events.dtype == np.float64
    assert (np.diff(t) >= 0).all()
    assert t[0] > 0
    assert t[-1] <= TINY.duration
    assert x.min() >= 0
    assert x.max() == 95
    assert y.min() >= 0
    assert y.max() == 63
    assert set(np.unique(p)) == {-1.0, 1.0}
    # Edges are a quarter as long as in the default camera, and move at a quarter of the pixels per second.
    rate = len(events) / TINY.duration
    assert 0.1e6 < rate < 3e6


def test_summed_events_equal_the_change_of_the_images(recording: Path) -> None:
    events = np.asarray(read_events(recording))
    first, last = (
        cv2.imread(str(recording / "images" / f"frame{ms:06d}.png"), cv2.IMREAD_UNCHANGED) / 255.0
        for ms in (0, 300)
    )
    summed = np.zeros(first.shape)
    np.add.at(summed, (events[:, 1].astype(int), events[:, 0].astype(int)), 0.1 * events[:, 3])
    eps = TINY.log_epsilon
    change = np.log(last + eps) - np.log(first + eps)
    # One threshold, and what 8-bit images lose of the logarithm.
    rounding = 0.5 / 255 / (first + eps) + 0.5 / 255 / (last + eps)
    assert (np.abs(change - summed) < 0.1 + 1.1 * rounding + 1e-3).all()


def test_depth_image_is_the_rendered_depth(recording: Path, office: Room) -> None:
    depth = cv2.imread(str(recording / "depth" / "frame000150.png"), cv2.IMREAD_UNCHANGED) / 5000.0
    exact = Renderer(office.scene, TINY.camera).render(read_poses(recording)[3]).depth
    # Half a unit of the PNG; poses are written with 12 digits.
    assert np.abs(depth - exact).max() < 0.0001 + 1e-4


def test_two_recordings_with_one_seed_are_identical(recording: Path, office: Room, tmp_path: Path) -> None:
    simulate(office.scene, HandHeldPath(office, TINY.duration), TINY, tmp_path / "again")
    np.testing.assert_array_equal(read_events(recording), read_events(tmp_path / "again"))


def test_depth_and_images_have_their_own_rates_and_blur(office: Room, tmp_path: Path) -> None:
    config = SimulationConfig(
        width=48, height=32, duration=0.2, depth_rate=10, image_rate=30, exposure=0.03, speed=3.0
    )
    path = HandHeldPath(office, config.duration, speed=config.speed)
    simulate(office.scene, path, config, tmp_path / "blurred")
    names = sorted(p.name for p in (tmp_path / "blurred" / "images").iterdir())
    assert names == [f"frame{ms:06d}.png" for ms in (0, 33, 67, 100, 133, 167, 200)]
    assert len(np.loadtxt(tmp_path / "blurred" / "poses_ts.txt")) == 7
    assert len(list((tmp_path / "blurred" / "depth").iterdir())) == 3
    sharp = Renderer(office.scene, config.camera).render(path.pose(0.1)).grey
    blurred = (
        cv2.imread(str(tmp_path / "blurred" / "images" / "frame000100.png"), cv2.IMREAD_UNCHANGED) / 255.0
    )
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.97 * np.abs(np.diff(sharp, axis=1)).mean()
    assert np.abs(blurred - sharp).mean() < 0.1


def test_kinect_depth_is_noisy_quantised_and_has_holes(office: Room) -> None:
    camera = SimulationConfig(width=160, height=100).camera
    exact = Renderer(office.scene, camera).render(HandHeldPath(office, 1.0).pose(0.2))
    noisy = kinect_depth(exact.depth, exact.cosine, camera, np.random.default_rng(0))
    assert 0.01 < (noisy == 0).mean() < 0.35
    assert noisy.max() <= 5.0
    near = (np.abs(exact.depth - 2.0) < 0.2) & (noisy > 0) & (np.abs(noisy - exact.depth) < 0.1)
    deviation = (noisy - exact.depth)[near].std()
    # 6 mm of axial noise and 11 mm / sqrt(12) of quantisation at 2 m, some pixels beside edges.
    assert 0.005 < deviation < 0.012
    steps = 351.3 / noisy[noisy > 0]
    assert np.abs(steps - np.rint(steps)).max() < 1e-3
    wall = np.full(camera.shape, 5.6, np.float32)
    assert (kinect_depth(wall, np.ones(camera.shape), camera, np.random.default_rng(0)) == 0).all()


def test_recorded_path_starts_at_zero_where_it_is_put() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [5, 6, 8]
    recorded = Trajectory(np.array([1e9, 1e9 + 1, 1e9 + 2]), poses)
    first = look_at(np.array([1.0, 2, 3]), np.array([1.0, 5, 3]), np.array([0, 0, 1.0]))
    path = RecordedPath(recorded, scale=0.5, first_pose=first)
    assert path.duration == 2
    np.testing.assert_allclose(path.pose(0.0), first, atol=1e-12)
    np.testing.assert_allclose(path.pose(2.0)[:3, 3], [2.5, 2, 3], atol=1e-9)  # camera x is world x here
    with pytest.raises(DataError, match="longer trajectory"):
        RecordedPath(recorded, start=5.0)


def test_builtin_sequence_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr("edslam_ti.datasets.builtin.make_room", cached_room)
    config = SimulationConfig(width=48, height=32, duration=0.1)
    folder = builtin_sequence_folder("room0", config)
    assert tmp_path in folder.parents
    stamp = (folder / "camera.json").stat().st_mtime_ns
    assert builtin_sequence_folder("room0", config) == folder
    assert (folder / "camera.json").stat().st_mtime_ns == stamp
    assert builtin_sequence_folder("room0", config.model_copy(update={"seed": 1})) != folder


def test_failed_recording_leaves_nothing(office: Room, tmp_path: Path) -> None:
    def stop(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(office.scene, HandHeldPath(office, 0.3), TINY, tmp_path / "out", stop)
    assert list(tmp_path.iterdir()) == []


def test_unusable_settings_are_named(office: Room, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"duration: .* greater than 0, got -1"):
        SimulationConfig(duration=-1.0)
    with pytest.raises(DataError, match="choose from room0"):
        make_room("offce0")
    with pytest.raises(DataError, match="at least two images"):
        simulate(office.scene, HandHeldPath(office, 0.04), SimulationConfig(duration=0.04), tmp_path / "x")


def test_obj_texture_is_the_right_way_up(tmp_path: Path) -> None:
    scene = load_mesh(write_textured_square(tmp_path), scale=2.0)
    camera = Camera(20, 20, 8.0, 8.0, 9.5, 9.5)
    grey = (
        Renderer(scene, camera)
        .render(look_at(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, 1.0])))
        .grey
    )
    assert abs(grey[4:8, 12:16].mean() - 220 / 255) < 0.02
    for rows, columns in (
        (slice(4, 8), slice(4, 8)),
        (slice(12, 16), slice(4, 8)),
        (slice(12, 16), slice(12, 16)),
    ):
        assert abs(grey[rows, columns].mean() - 60 / 255) < 0.02


def test_missing_texture_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"square.mtl: its texture 'lost.png' is missing"):
        load_mesh(write_textured_square(tmp_path, texture="lost.png"))
    (tmp_path / "square.mtl").unlink()
    with pytest.raises(DataError, match=r"material library 'square\.mtl' is missing"):
        load_mesh(tmp_path / "square.obj")


def view_of_glb(path: Path) -> np.ndarray:
    """Look along -z (y up) at the square, which its node moves to z = -1."""
    camera = Camera(20, 20, 8.0, 8.0, 9.5, 9.5)
    return (
        Renderer(load_mesh(path), camera)
        .render(look_at(np.zeros(3), np.array([0, 0, -1.0]), np.array([0, 1.0, 0])))
        .grey
    )


def test_glb_texture_is_the_right_way_up_and_tinted(tmp_path: Path) -> None:
    write_textured_square(tmp_path)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # glTF: v points down
    material = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.5, 0.5, 1]}
    write_glb(tmp_path / "s.glb", {"POSITION": SQUARE, "TEXCOORD_0": uv}, material, tmp_path / "square.png")
    grey = view_of_glb(tmp_path / "s.glb")
    assert abs(grey[4:8, 12:16].mean() - 0.5 * 220 / 255) < 0.02
    for rows, columns in (
        (slice(4, 8), slice(4, 8)),
        (slice(12, 16), slice(4, 8)),
        (slice(12, 16), slice(12, 16)),
    ):
        assert abs(grey[rows, columns].mean() - 0.5 * 60 / 255) < 0.02


def test_vertex_coloured_meshes_keep_their_brightness(tmp_path: Path) -> None:
    colour = np.full((4, 3), 0.6, np.float32)
    colour[1:3] = 0.9  # brighter to the right
    write_glb(tmp_path / "s.glb", {"POSITION": SQUARE, "COLOR_0": colour}, {}, None)
    grey = view_of_glb(tmp_path / "s.glb")
    np.testing.assert_allclose(grey[10, [4, 9, 15]], [0.646, 0.741, 0.853], atol=0.01)
    (tmp_path / "quads.ply").write_text(  # as Replica's meshes: polygons, not triangles
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
        "-1 -1 -1 153 153 153\n1 -1 -1 153 153 153\n1 1 -1 153 153 153\n-1 1 -1 153 153 153\n4 0 1 2 3\n"
    )
    scene = load_mesh(tmp_path / "quads.ply")
    assert len(scene.triangles) == 2
    np.testing.assert_allclose(scene.tints, 0.6, atol=0.003)


def test_mesh_without_colour_or_triangles_is_refused(tmp_path: Path) -> None:
    o3d = load_open3d()
    o3d.io.write_triangle_mesh(str(tmp_path / "plain.ply"), o3d.geometry.TriangleMesh.create_box())
    with pytest.raises(DataError, match="texture or vertex colours"):
        load_mesh(tmp_path / "plain.ply")
    (tmp_path / "broken.ply").write_text("not a mesh")
    with pytest.raises(DataError, match="begins with 'not a mesh'"):
        load_mesh(tmp_path / "broken.ply")
    with pytest.raises(FileNotFoundError):
        load_mesh(tmp_path / "absent.obj")


def test_real_mesh_and_real_motion(shared_data: Path, tmp_path: Path) -> None:
    scene = load_mesh(shared_data / "scenes" / "viking_room" / "viking_room.obj", scale=4.0)
    recorded = read_tum(shared_data / "trajectories" / "hdr_normal.txt")
    first = look_at(np.array([1.6, 1.6, 1.6]), np.array([-0.5, -0.5, 0.8]), np.array([0, 0, 1.0]))
    config = SimulationConfig(width=96, height=64, duration=0.2)
    summary = simulate(
        scene, RecordedPath(recorded, first_pose=first, start=10.0), config, tmp_path / "viking"
    )
    depth = cv2.imread(str(tmp_path / "viking" / "depth" / "frame000100.png"), cv2.IMREAD_UNCHANGED)
    assert (depth > 0).mean() > 0.8
    assert summary.num_events > 2000


def test_tour_goes_through_all_rooms_stays_clear_and_returns() -> None:
    room = cached_room("flat")
    caster = RayCaster(room.scene.vertices, room.scene.triangles)
    path = make_path(room, SimulationConfig(path="tour", duration=60.0, seed=1))
    assert isinstance(path, TourPath)
    poses = np.array([path.pose(t) for t in np.arange(0, 60.01, 0.1)])
    assert caster.distances_to(poses[:, :3, 3].astype(np.float32)).min() > 0.4  # doorways are 1.1 m wide
    quarters = {(x > 4.3, y > 4.0) for x, y, _ in poses[:, :3, 3]}
    assert len(quarters) == 4
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.1
    assert 0.25 < speed.mean() < 0.45
    np.testing.assert_allclose(path.pose(60.0), path.pose(0.0), atol=1e-9)
    five = make_path(room, SimulationConfig(path="tour", duration=300.0))
    assert isinstance(five, TourPath)
    assert five.rounds == 7
    short = make_path(room, SimulationConfig(path="tour", duration=2.0))
    assert np.linalg.norm(short.pose(2.0)[:3, 3] - short.pose(0.0)[:3, 3]) < 1.0  # at walking pace, too
    with pytest.raises(DataError, match="expected the scene 'flat', got 'office0'"):
        make_path(cached_room("office0"), SimulationConfig(path="tour"))


def test_a_moving_object_is_seen_where_it_is_and_hides_what_is_behind() -> None:
    room = cached_room("office0")
    config = SimulationConfig(width=120, height=76, duration=3.0)
    path = make_path(room, config)
    moving = moving_object(room, path)
    renderer = MovingRenderer(room.scene, moving, config.camera, 2)
    empty = Renderer(room.scene, config.camera, 2)
    T = look_at(np.array([2.4, 1.4, 1.4]), moving.place(0.0) + (0, 0, 0.6), np.array([0.0, 0.0, 1.0]))
    there, later, without = renderer.render(T, 0.0), renderer.render(T, 1.5), empty.render(T)
    changed = there.depth != without.depth
    assert 0.02 < changed.mean() < 0.6
    assert (there.depth <= without.depth).all()
    np.testing.assert_array_equal(there.grey[~changed], without.grey[~changed])
    assert (changed != (later.depth != without.depth)).any()  # it has moved on
    # What is seen of it lies on the box: within its half diagonal of where it stands.
    v, u = np.nonzero(changed)
    points = config.camera.back_project_pixels(u, v, there.depth[changed].astype(np.float64))
    world = points @ T[:3, :3].T + T[:3, 3]
    assert np.linalg.norm(world[:, :2] - moving.place(0.0)[:2], axis=1).max() < 0.31
    assert (there.cosine[changed] > 0).any()
