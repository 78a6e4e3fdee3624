"""The examples run, on recordings so small that they take seconds."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edslam_ti import kernels
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


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_begin_with_their_command_and_are_short(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert lines[0].startswith(f'"""python examples/{path.name}')
    assert len(lines) < 60
