"""The page of a run in progress: what it shows, what it costs, who reaches it."""

import http.client
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from sequences import make_slam, settings

from edslam_ti.camera import Camera
from edslam_ti.config import Config, MappingConfig
from edslam_ti.datasets import EventDepthSequence, Sample
from edslam_ti.errors import EdSlamError, MissingExtraError
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.slam import Slam
from edslam_ti.viewer import Moment, make_viewers
from edslam_ti.viewer.live import OFTEN, BrowserViewer
from edslam_ti.viewer.server import is_local, open_server
from edslam_ti.viewer.splats import BLOCK, MOST_BLOCKS, Splats, SplatStream, pixel_sigmas
from edslam_ti.viewer.throttle import Throttle

viser = pytest.importorskip("viser", reason="viser (extra viewer) is not installed")


@pytest.fixture
def viewer() -> Iterator[BrowserViewer]:
    viewer = BrowserViewer("127.0.0.1", 0, lambda line: None)
    yield viewer
    viewer.close()


@pytest.fixture
def page(viewer: BrowserViewer) -> Iterator[Any]:
    """Keep a page open: a client that takes all messages and looks at none."""
    import msgspec
    from websockets.sync.client import connect

    protocol: Any = f"viser-v{viser.__version__}"
    camera = {
        **{"type": "ViewerCameraMessage", "wxyz": (1.0, 0, 0, 0), "position": (0.0, 0, 0), "fov": 1.0},
        **{"near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640},
        **{"look_at": (0.0, 0, 1), "up_direction": (0.0, -1, 0)},
    }
    with connect(f"ws://127.0.0.1:{viewer.port}", subprotocols=[protocol], max_size=None) as client:
        client.send(msgspec.msgpack.encode(camera))  # viser counts a page from its first message on
        is_open = threading.Event()
        is_open.set()

        def take() -> None:
            while is_open.is_set():
                try:
                    client.recv(timeout=0.1)
                except TimeoutError:
                    continue
                except Exception:
                    return

        thread = threading.Thread(target=take)
        thread.start()
        wait_for(lambda: len(viewer._server.get_clients()) == 1)
        yield client
        is_open.clear()
        thread.join()


def wait_for(condition: Any, seconds: float = 20.0) -> None:
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it did not happen"
        time.sleep(0.02)


def tiny_slam(sequence: EventDepthSequence, samples: list[Sample]) -> Slam:
    return make_slam(sequence, samples, settings("ed_slam", mapping={"iterations": 1}))


def moment(slam: Slam, sample: Sample | None, sequence: EventDepthSequence) -> Moment:
    return Moment(slam, sequence.camera, sample, 10, sequence.truth, 0.5)


def test_page_shows_path_splats_and_images(
    viewer: BrowserViewer, page: Any, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    slam, scene = tiny_slam(tiny_sequence, tiny_samples), viewer._server.scene
    viewer._throttle = Throttle(share=1, allowance=100)  # this machine may be slow
    for sample in tiny_samples[:5]:
        slam.process(sample)
        viewer.update(moment(slam, sample, tiny_sequence))
        wait_for(lambda: viewer._updates.empty())
    images = viewer._page._images
    wait_for(lambda: "frame 5 of 10" in viewer._page._status.content)
    wait_for(lambda: images["render"].image.shape == (*tiny_sequence.camera.shape, 3))
    assert images["events"].image.std() > 10
    assert images["depth"].image.shape[:2] == tiny_sequence.camera.shape
    path = scene.get_handle_by_name("/path").points  # [4, 2, 3]
    np.testing.assert_allclose(path[-1, 1], slam.trajectory.pose(-1)[:3, 3], atol=1e-5)
    assert tiny_sequence.truth is not None
    assert len(scene.get_handle_by_name("/truth").points) == len(tiny_sequence.truth) - 1
    assert scene.get_handle_by_name("/keyframes") is not None
    shown = scene.get_handle_by_name("/map/0")
    means = slam.mapper.gaussians.raw["means"].detach().numpy()
    assert len(shown.centers) == BLOCK
    is_seen = shown.opacities[:, 0] > 0
    assert is_seen.sum() == min(len(means), BLOCK)
    np.testing.assert_allclose(shown.centers[is_seen].mean(0), means[:BLOCK].mean(0), atol=0.02)
    time.sleep(OFTEN)  # refinement takes many short steps
    viewer.update(moment(slam, None, tiny_sequence))
    wait_for(lambda: "refining" in viewer._page._status.content)


def test_without_a_page_nothing_is_copied(
    viewer: BrowserViewer,
    tiny_sequence: EventDepthSequence,
    tiny_samples: list[Sample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slam = tiny_slam(tiny_sequence, tiny_samples)
    monkeypatch.setattr(viewer, "_copied", lambda moment: pytest.fail("nobody looks"))
    for sample in tiny_samples[:3]:
        slam.process(sample)
        viewer.update(moment(slam, sample, tiny_sequence))
        viewer.wait(lambda: pytest.fail("nobody can pause it"))
    assert viewer._throttle.spent == 0


def test_page_changes_no_result(
    viewer: BrowserViewer, page: Any, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    watched, alone = (tiny_slam(tiny_sequence, tiny_samples) for _ in range(2))
    for sample in tiny_samples[:6]:
        watched.process(sample)
        viewer.update(moment(watched, sample, tiny_sequence))
        alone.process(sample)
    np.testing.assert_array_equal(watched.trajectory.poses, alone.trajectory.poses)
    for name, values in alone.mapper.gaussians.raw.items():
        assert (values == watched.mapper.gaussians.raw[name]).all(), name


def test_pause_holds_the_run_and_step_lets_one_frame_pass(viewer: BrowserViewer, page: Any) -> None:
    viewer.wait(lambda: pytest.fail("it is not paused"))
    viewer._page._set_paused(True)
    asked: list[int] = []

    def has_ended() -> bool:  # a signal ends the run
        asked.append(0)
        return len(asked) > 3

    viewer.wait(has_ended)
    assert len(asked) == 4
    viewer._page._make_step()
    viewer.wait(lambda: pytest.fail("a step passes"))
    assert viewer._page.is_held()
    page.close()  # nobody could let it go on any more
    wait_for(lambda: not viewer._server.get_clients())
    viewer.wait(lambda: False)


def test_failure_of_the_page_is_told_by_the_next_update(
    viewer: BrowserViewer,
    page: Any,
    tiny_sequence: EventDepthSequence,
    tiny_samples: list[Sample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(update: Any) -> None:
        raise OSError("gone")

    monkeypatch.setattr(viewer._page, "show", fail)
    slam = tiny_slam(tiny_sequence, tiny_samples)
    slam.process(tiny_samples[0])
    viewer.update(moment(slam, tiny_samples[0], tiny_sequence))
    wait_for(lambda: viewer._problem is not None)
    with pytest.raises(OSError, match="gone"):
        viewer.update(moment(slam, tiny_samples[0], tiny_sequence))


# --- who reaches it ---


OUTSIDE = [
    "/" + 8 * "../" + "etc/passwd",
    "/" + 8 * "%2e%2e/" + "etc/passwd",
    "/" + 8 * "..%2f" + "etc/passwd",
    "/" + 8 * "..\\" + "etc\\passwd",
    *("//etc/passwd", "/etc/passwd", "/%2fetc%2fpasswd", "/file:///etc/passwd", "/?file=/etc/passwd/../.."),
    *("/./../server.py", "/../__init__.py", "/%252e%252e/__init__.py", "/assets/../../__init__.py"),
]


def test_no_file_of_the_machine_is_reached(viewer: BrowserViewer) -> None:
    for target in OUTSIDE:
        connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=10)
        connection.request("GET", target)
        answer = connection.getresponse()
        body = answer.read()
        assert answer.status == 404 or b"<!doctype html>" in body[:200].lower(), target
        assert b"root:" not in body, target
        assert b"import" not in body[:100], target


def test_page_is_for_this_machine_unless_told_otherwise() -> None:
    assert Config().viewer_address == "127.0.0.1"
    assert all(is_local(address) for address in ("127.0.0.1", "::1", "localhost"))
    assert not any(is_local(address) for address in ("0.0.0.0", "192.168.0.7", "example"))
    lines: list[str] = []
    server = open_server("0.0.0.0", 0, lines.append)
    server.stop()
    assert lines[0].startswith("warning: the page is open to other machines at 0.0.0.0")
    assert lines[1].startswith("page: http://localhost:")
    with pytest.raises(
        EdSlamError, match=r"expected one of this machine, such as 127.0.0.1, got '203.0.113.1'"
    ):
        open_server("203.0.113.1", 0, lines.append)


def test_nobody_can_open_a_tunnel(viewer: BrowserViewer) -> None:
    assert viewer._server.request_share_url() is None


def test_without_the_extra_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'edslam-ti\[viewer\]'"):
        make_viewers(Config(viewer=True), lambda line: None)


# --- splats ---


def gaussian_map(count: int) -> GaussianMap:
    import torch

    gaussians, random = GaussianMap(MappingConfig()), torch.Generator().manual_seed(0)
    means = torch.rand((count, 3), generator=random)
    quats = torch.randn((count, 4), generator=random)
    gaussians.add(means, quats, torch.full((count, 3), 0.01), 0.9, torch.full((count, 1), 0.5))
    return gaussians


def test_new_blocks_come_first_then_the_oldest() -> None:
    stream = SplatStream(None)
    assert stream.copied(gaussian_map(0)) is None
    growing = [2 * BLOCK, 2 * BLOCK, 2 * BLOCK + 5, *[3 * BLOCK] * 4]
    assert [stream.copied(gaussian_map(count)).index for count in growing] == [0, 1, 2, 2, 1, 2, 0]
    assert stream.num_blocks == 3


def test_large_map_is_thinned_evenly_and_its_splats_grow() -> None:
    gaussians, stream = gaussian_map(2 * MOST_BLOCKS * BLOCK), SplatStream(None)
    block = stream.copied(gaussians)
    assert stream.num_blocks == pytest.approx(MOST_BLOCKS, abs=1)
    np.testing.assert_allclose(block.splats.scales, 0.01 * 2**0.5, rtol=1e-4)
    reach = gaussians.raw["means"].detach().numpy()[: 3 * BLOCK]
    near = np.abs(reach[:, None, 0] - block.splats.means[None, :50, 0]).min(0)
    assert near.max() < 1e-6  # they are Gaussians of the map, from its beginning on


def test_covariance_has_the_axes_of_the_splat() -> None:
    half = np.sqrt(0.5)  # a quarter turn about z
    quats = np.array([[half, 0, 0, half]], np.float32)
    one = Splats(np.zeros((1, 3)), quats, np.array([[0.1, 0.2, 0.3]]), np.ones(1), np.ones((1, 3)))
    np.testing.assert_allclose(one.covariances()[0], np.diag([0.04, 0.01, 0.09]), atol=1e-7)
    padded = one.padded(4)
    np.testing.assert_array_equal(padded.opacities, [1, 0, 0, 0])
    np.testing.assert_allclose(one.widened(np.array([0.4])).scales[0, 2], 0.5, rtol=1e-6)


def test_blur_is_that_of_a_pixel_seen_from_the_nearest_camera() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = [0, 0, 2]
    camera = Camera(width=100, height=100, fx=50.0, fy=50.0, cx=49.5, cy=49.5)
    sigmas = pixel_sigmas(np.array([[0, 0, 3.0], [0, 0, -0.5]], np.float32), poses, camera)
    np.testing.assert_allclose(sigmas, 0.3**0.5 * np.array([1, 0.5]) / 50, rtol=1e-6)


def test_throttle_keeps_work_below_its_share() -> None:
    def busy(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    throttle = Throttle(share=0.1, allowance=0.05)
    started = time.process_time()
    while time.process_time() - started < 0.5:
        if throttle.is_due:
            with throttle.counted():
                busy(0.01)
        busy(0.005)
    assert 0.05 < throttle.spent < 0.05 + 0.1 * 0.6 + 0.03
    throttle.restart()
    assert throttle.is_due
