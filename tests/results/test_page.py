"""index.html of a results folder: it is whole, harmless, needs no network and says what is good."""

import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edslam_ti.results.page import FILES, PAGE, Scale, number_rows, write_page

METRICS: dict[str, Any] = {
    **{"scene": "office0", "description": "a room", "method": "ed_slam", "is_interrupted": False},
    **{"num_frames": 50, "num_events": 1000, "num_lost_frames": 0, "device": "cpu", "wall_s": 3.0},
    **{"peak_memory_mb": 500.0, "total_fps": 2.0, "tracking_hz": 40.0, "path_length_m": 2.0},
    **{"ate_rmse_cm": 0.5, "truth_coverage": 1.0, "num_truth_poses_compared": 50, "ate_scale_sim3": 1.02},
    **{"sigma_position_end_cm": 7.0, "psnr_corrected_db": 31.0, "ssim_corrected": 0.8},
    **{"lpips_corrected": None, "depth_l1_cm": 0.4, "mesh_accuracy_cm": None, "num_gaussians": 12345},
    **{"mesh_completion_ratio_5cm": None, "problems": [], "data_notes": [], "truth_notes": []},
}
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Which tags are open, what links lead to, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.targets: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.targets += [value or "" for name, value in attributes if name in ("href", "src")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read_page(folder: Path) -> Page:
    page = Page()
    page.feed((folder / PAGE).read_text(encoding="utf-8"))
    assert page.open == []
    return page


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "renders").mkdir()
    picture = np.full((40, 60, 3), 128, np.uint8)
    cv2.imwrite(str(tmp_path / "trajectory.png"), picture)
    cv2.imwrite(str(tmp_path / "renders/contact.png"), cv2.resize(picture, (1600, 300)))
    for name in ("flythrough.mp4", "map.ply", "trajectory_tum.txt"):
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def test_page_is_whole_and_needs_no_network(folder: Path) -> None:
    write_page(folder, METRICS, 2.5, [])
    page = read_page(folder)
    assert "script" not in page.tags
    for target in page.targets:
        is_inside = target.startswith("data:image/jpeg;base64,")
        assert is_inside or (folder / target.split("#")[0]).is_file(), target[:80]
    assert "://" not in (folder / PAGE).read_text()
    assert {"flythrough.mp4#t=0.1", "map.ply", "renders/contact.png"} <= set(page.targets)
    assert f"edslam view {folder} --viewer" in page.text
    assert "--resume" not in page.text
    assert "Warnings" not in page.text


def test_names_and_warnings_cannot_become_markup(folder: Path) -> None:
    nasty = "<script>alert('1')</script>\x1b[31m\udc80&amp;"
    metrics = METRICS | {"scene": nasty, "problems": [nasty], "description": nasty, "is_interrupted": True}
    write_page(folder, metrics, 2.5, ["left out: " + nasty])
    page = read_page(folder)
    assert "script" not in page.tags
    assert page.text.count("<script>alert('1')</script>\\x1b[31m\\udc80&amp;") >= 4
    assert f"edslam slam --resume {folder}" in page.text


def test_folder_with_a_strange_name_gives_commands_that_run(folder: Path) -> None:
    strange = folder / "a b'$(x)<i>"
    shutil.copytree(folder, strange, ignore=shutil.ignore_patterns("a b*"))
    write_page(strange, METRICS, 2.5, [])
    text = read_page(strange).text
    assert """a b'"'"'$(x)<i>' --viewer""" in text


def test_page_without_pictures_and_truth(tmp_path: Path) -> None:
    nothing = {key: None for key in METRICS if key.endswith(("_cm", "_db", "_corrected", "_m", "_sim3"))}
    (tmp_path / "trajectory.png").write_bytes(b"no picture")
    write_page(tmp_path, METRICS | nothing | {"num_gaussians": 0, "tracking_hz": None}, 0.0, [])
    page = read_page(tmp_path)
    assert not {"img", "video"} & page.tags
    assert "no true path is known" in page.text


def test_words_follow_the_numbers() -> None:
    words = {row.name: row.word for row in number_rows(METRICS, duration_s=2.45)}
    assert words["error of the path (ATE)"] == "good"  # 0.25 % of the path
    assert words["lost frames"] == "good"
    assert words["scale (Sim(3))"] == "fair"
    assert words["standard deviation at the end"] == "poor"
    assert words["render: SSIM"] == "fair"
    assert words["tracking speed"] == "good"  # 20 Hz is what comes
    lost = {row.name: row.word for row in number_rows(METRICS | {"num_lost_frames": 6}, duration_s=2.45)}
    assert lost["lost frames"] == "poor"


@pytest.mark.parametrize(("value", "word"), [(1.0, "good"), (2.0, "fair"), (3.0, "poor")])
def test_scales_go_both_ways(value: float, word: str) -> None:
    assert Scale(1.5, 2.5).word(value) == word
    assert Scale(-1.5, -2.5).word(-value) == word


def test_every_file_has_a_word(folder: Path) -> None:
    for name in FILES:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")
    write_page(folder, METRICS, 2.5, [])
    assert set(FILES) <= set(read_page(folder).targets)
