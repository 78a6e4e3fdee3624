"""The page of finished runs: what it shows, where it flies, what it measures."""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from saved_results import CAMERA, curve, write_result

from edslam_ti.commands.view import main
from edslam_ti.mapping.gaussian_ply import write_gaussian_ply
from edslam_ti.results import browse
from edslam_ti.results.browse import FinishedPage
from edslam_ti.results.pictures import PictureRow, write_contact_sheet
from edslam_ti.results.reading import write_camera
from edslam_ti.results.shown_run import ShownRun, first_hit
from edslam_ti.viewer.server import open_server, wxyz_of

pytest.importorskip("viser", reason="viser (extra viewer) is not installed")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Make two results; the first has a map and a held-out view, the second only points and a mesh."""
    first, second = (tmp_path_factory.mktemp(name) for name in ("first", "second"))
    for folder in (first, second):
        write_result(folder)
    write_camera(first, CAMERA)
    y, x = np.mgrid[-1:1:30j, -1:1:40j]
    wall = np.stack([x, y, np.full_like(x, 2.0)], -1).reshape(-1, 3)
    count = len(wall)
    write_gaussian_ply(
        first / "map.ply",
        wall,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), np.log(0.02)),
        np.full(count, 2.0),
        np.full(count, 0.5),
    )
    truth, render = np.full(CAMERA.shape, 0.9), np.full(CAMERA.shape, 0.1)
    row = PictureRow("held out", truth, render, np.ones(CAMERA.shape))
    (first / "renders").mkdir()
    write_contact_sheet(first / "renders/001000.png", [row])
    write_contact_sheet(first / "renders/novel_000500.png", [row])
    return [first, second]


@pytest.fixture
def server() -> Iterator[Any]:
    server = open_server("127.0.0.1", 0, lambda line: None)
    yield server
    server.stop()


@pytest.fixture
def page(server: Any, folders: list[Path]) -> Iterator[FinishedPage]:
    page = FinishedPage(server, [ShownRun.load(folder) for folder in folders])
    yield page
    page.close()


def test_runs_stand_side_by_side_or_in_one_place(page: FinishedPage, server: Any) -> None:
    first, second = (server.scene.get_handle_by_name(f"/runs/{k}") for k in range(2))
    np.testing.assert_array_equal(first.position, 0)
    assert second.position[0] > 2  # beyond the wall, which is 2 m wide
    eye = server.initial_camera
    paths = np.concatenate([curve().poses[:, :3, 3], curve().poses[:, :3, 3] + second.position])
    forward = np.array(eye.look_at) - eye.position
    np.testing.assert_allclose(forward, curve().pose(0)[:3, 2], atol=1e-6)
    x, y, z = (paths - eye.position).T  # the first camera looks along z
    half = np.tan(eye.fov / 2)
    assert half == pytest.approx(CAMERA.height / 2 / CAMERA.fy)
    assert np.abs(y / z).max() < half
    assert np.abs(x / z).max() < 1.1 * half
    page._beside.value = False
    page._arrange()
    np.testing.assert_array_equal(second.position, 0)


def test_kinds_are_shown_where_they_are(page: FinishedPage, server: Any) -> None:
    def shown(k: int) -> set[str]:
        handles = {
            kind: server.scene.get_handle_by_name(f"/runs/{k}/{kind}")
            for kind in ("splats", "mesh", "points")
        }
        return {kind for kind, handle in handles.items() if handle is not None and handle.visible}

    assert (shown(0), shown(1)) == ({"splats"}, {"mesh"})  # the second has no splats
    assert len(server.scene.get_handle_by_name("/runs/0/splats").centers) == 1200
    for kind in ("points", "mesh", "splats"):
        page._kind.value = kind
        page._show_kind()
        assert shown(0) == {kind}


def test_camera_is_where_it_was_at_the_time_of_the_slider(page: FinishedPage, server: Any) -> None:
    for seconds in (0.0, 0.73, 2.0):
        page._time.value = seconds
        page._show_time()
        apex = server.scene.get_handle_by_name("/runs/0/camera").points[4, 0]
        np.testing.assert_allclose(apex, curve().at(seconds)[:3, 3], atol=2e-3)


def test_it_flies_along_the_path_at_the_pace_of_the_recording(
    page: FinishedPage, server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[np.ndarray] = []
    monkeypatch.setattr(server, "get_clients", lambda: {0: None})
    monkeypatch.setattr(browse, "look_through", lambda client, T, angle: flown.append(T))
    page._fly.value = True
    page._show_time()
    page._time.value = 1.8
    started = time.perf_counter()
    page._toggle_play()
    while page._is_playing.is_set():
        assert time.perf_counter() < started + 30
        time.sleep(0.02)
    assert time.perf_counter() - started >= 0.2
    assert len(flown) >= 3
    np.testing.assert_allclose(flown[0], curve().pose(0), atol=1e-6)
    np.testing.assert_allclose(flown[-1], curve().pose(-1), atol=1e-6)
    assert not server.scene.get_handle_by_name("/runs/0/camera").visible  # it is around the eye
    assert np.allclose(wxyz_of(np.eye(4)), [1, 0, 0, 0])


def test_two_clicks_measure_a_distance(page: FinishedPage, server: Any) -> None:
    page._beside.value = False
    page._measure.value = True
    page._begin_measuring()
    spacing = 2 / 39  # metres between the columns of the wall
    for column in (10, 20):
        page.pick([0, 0, 0], [-1 + column * spacing, 1 / 29, 2.0])
    assert f"{10 * spacing:.3f} m" in page._distance.content
    assert server.scene.get_handle_by_name("/measured/line") is not None
    page.pick([0, 0, 0], [0, 0, -1])  # the other way there is nothing
    assert "no point" in page._distance.content
    assert server.scene.get_handle_by_name("/measured/line") is None
    page._measure.value = False
    page._begin_measuring()
    assert page._distance.content == ""


def test_first_surface_along_a_ray_is_hit() -> None:
    near, far = np.array([0.005, 0, 1.0]), np.array([0, 0, 3.0])
    hit = first_hit(np.stack([far, near, [0, 0.5, 0.5]]), np.zeros(3), np.array([0, 0, 2.0]))
    assert hit is not None
    np.testing.assert_array_equal(hit, near)
    assert first_hit(np.empty((0, 3)), np.zeros(3), np.array([0, 0, 1.0])) is None


def test_render_and_truth_are_compared_at_held_out_times(page: FinishedPage) -> None:
    assert list(page._views) == ["1: 1.000 s"]  # novel views have no time
    truth, render = (handle.image for handle in page._pictures)
    assert truth.mean() > 200
    assert render.mean() < 60
    page._choose_view()
    assert page._time.value == pytest.approx(1.0, abs=0.01)


def test_names_cannot_become_markup(
    server: Any, folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folders[1], tmp_path / "run")
    nasty = "<script>{alert(1)}</script>"
    (tmp_path / "run/metrics.json").write_text(json.dumps({"scene": nasty, "method": "ed_slam"}))
    contents: list[str] = []
    add_html = server.gui.add_html

    def noted(text: str) -> Any:
        contents.append(text)
        return add_html(text)

    monkeypatch.setattr(server.gui, "add_html", noted)
    FinishedPage(server, [ShownRun.load(tmp_path / "run")])
    shown = contents[0]
    assert "<script>" not in shown
    assert "&lt;script&gt;{alert(1)}" in shown


def test_command_serves_until_ctrl_c(
    folders: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(browse.time, "sleep", interrupted)
    main([str(folders[1]), "--viewer", "--viewer-port", "0"])
    assert capsys.readouterr().out.startswith("page: http://127.0.0.1:")
