"""The examples run, on recordings so small that they take seconds."""

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from edslam_ti import kernels
from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.trajectory import read_tum

pytestmark = pytest.mark.slow

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.fixture(scope="module", autouse=True)
def taichi_is_started_once() -> Any:
    """Examples start Taichi themselves, which recompiles every kernel; here it runs already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "init", lambda *arguments, **options: None)
        yield


def example(number: int) -> Callable[..., Any]:
    main: Callable[..., Any] = runpy.run_path(str(EXAMPLES[number - 1]))["main"]
    return main


@pytest.fixture(scope="module")
def result(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = example(1)(tiny_folder.name, tiny_folder.parent, tmp_path_factory.mktemp("results"))
    return folder


def test_a_run_from_python(result: Path) -> None:
    metrics = json.loads((result / "metrics.json").read_text())
    assert metrics["scene"] == "tiny"
    assert metrics["ate_rmse_cm"] < 0.3


def test_own_depth_and_events(tmp_path: Path) -> None:
    folder = example(2)(tmp_path / "data" / "wall", tmp_path / "results")
    path = read_tum(folder / "trajectory_tum.txt")
    moved = path.poses[-1, :3, 3] - path.poses[0, :3, 3]  # metres; depth at 50 and 350 ms, 0.2 m/s
    np.testing.assert_allclose(moved, [0.06, 0, 0], atol=0.01)
    assert json.loads((folder / "metrics.json").read_text())["num_lost_frames"] == 0


def test_a_map_is_rendered_from_a_new_pose(result: Path, tmp_path: Path) -> None:
    intensity = example(3)(result, tmp_path / "view.png")
    picture = cv2.imread(str(tmp_path / "view.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.shape == intensity.shape == (400, 640)
    assert np.abs(picture / 255 - intensity.clip(0, 1)).max() < 0.003  # half a grey level
    assert intensity.std() > 0.05  # discs and bars, not one grey


def test_a_session_in_a_loop(tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = example(4)(tiny_folder.name, tiny_folder.parent, tmp_path)
    assert len(read_tum(folder / "trajectory_tum.txt")) > 5
    assert (folder / "map.ply").is_file()
    assert "0.30 s: camera at [" in capsys.readouterr().out


def test_a_stream_is_tracked_and_looked_at(tmp_path: Path) -> None:
    path = example(5)(tmp_path / "views.png")
    np.testing.assert_allclose(path[-1] - path[0], [0.1, 0, 0], atol=0.015)  # m: 0.5 s at 0.2 m/s
    views = cv2.imread(str(tmp_path / "views.png"), cv2.IMREAD_GRAYSCALE)
    assert views is not None
    assert views.shape == (120, 2 * 160)
    assert views[:, 160:].std() > 10  # not one grey


def test_own_recording_to_a_map(tiny_sequence: EventDepthSequence, tmp_path: Path) -> None:
    events, stamps = tiny_sequence.events(0, 0.4), tiny_sequence.depth_timestamps[:8]
    np.savez(
        tmp_path / "mine.npz",
        x=events.x,
        y=events.y,
        t=np.rint(events.t * 1e6).astype(np.int64),
        p=events.polarity > 0,
        depth=np.array([np.rint(1000 * tiny_sequence.depth(k)).astype(np.uint16) for k in range(8)]),
        depth_times=np.rint(stamps * 1e6).astype(np.int64),
        intrinsics=tiny_sequence.camera.intrinsics,
        distortion=[-0.01, 0.0, 0.0, 0.0, 0.0],
    )
    folder = example(6)(tmp_path / "mine.npz", tmp_path / "results")
    assert folder.relative_to(tmp_path / "results").parts[:2] == ("session", "mine")
    assert (folder / "map.ply").stat().st_size > 1000


def test_a_ros_node_with_stand_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    published: list[Any] = []

    class Node:
        def __init__(self, name: str) -> None:
            self.callbacks: dict[str, Any] = {}

        def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
            self.callbacks[topic] = callback

        def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
            return SimpleNamespace(publish=published.append)

    class Decoder:
        def decode(self, message: Any) -> None:
            self.events = message.events

        def get_cd_events(self) -> np.ndarray:
            return self.events

    def header(microseconds: int) -> Any:
        sec, rest = divmod(microseconds, 1_000_000)
        return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=1000 * rest))

    def spin(node: Any) -> None:
        random, start = np.random.default_rng(0), 1_700_000_000_000_000
        kinds = {"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "i1", "<i4"]}
        for k in range(0, 300_000, 10_000):
            events: Any = np.zeros(200, np.dtype(kinds))  # type: ignore[call-overload]
            events["x"], events["y"] = random.integers(0, 32, 200), random.integers(0, 24, 200)
            events["t"] = np.sort(random.integers(0, 10_000, 200)) + 77
            message = SimpleNamespace(header=header(start + k), events=events)
            node.callbacks["events"](message)
            if k % 50_000 == 0:
                depth = np.full((24, 32), 1500, np.uint16)
                data = SimpleNamespace(header=header(start + k), data=depth.tobytes(), height=24, width=32)
                node.callbacks["depth"](data)
        raise KeyboardInterrupt

    def message() -> Any:
        return SimpleNamespace(header=SimpleNamespace(), pose=SimpleNamespace(position=SimpleNamespace()))

    modules = {
        "rclpy": SimpleNamespace(init=lambda: None, spin=spin),
        "rclpy.node": SimpleNamespace(Node=Node),
        "event_camera_msgs.msg": SimpleNamespace(EventPacket=object),
        "event_camera_py": SimpleNamespace(Decoder=Decoder),
        "geometry_msgs.msg": SimpleNamespace(PoseStamped=message),
        "sensor_msgs.msg": SimpleNamespace(Image=object),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    camera = Camera(32, 24, 25.0, 25.0, 15.5, 11.5)
    session = example(7)(camera, out=tmp_path, mapping={"enabled": False})
    assert len(session.trajectory) >= 4
    assert len(published) > 10
    assert published[-1].header.frame_id == "map"


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_begin_with_their_command_and_are_short(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert lines[0].startswith(f'"""python examples/{path.name}')
    assert len(lines) < 75
