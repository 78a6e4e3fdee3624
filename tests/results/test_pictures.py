"""Pictures of rendered views: every pixel where it belongs, and a video that opens."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edslam_ti.errors import DataError
from edslam_ti.results.pictures import (
    CAPTION,
    GAP,
    HEAD,
    PictureRow,
    fly_through_frames,
    smooth_path,
    write_contact_sheet,
    write_video,
)
from edslam_ti.trajectory import Trajectory


def row(height: int = 60, width: int = 320, seed: int = 0) -> PictureRow:
    random = np.random.default_rng(seed)
    render, truth = random.random((2, height, width))
    depth = np.tile(np.linspace(0.5, 3.0, width), (height, 1))
    depth[:, :10] = 0
    return PictureRow("PSNR 30 dB", truth, render, depth)


def test_every_row_shows_truth_render_error_and_depth_pixel_by_pixel(tmp_path: Path) -> None:
    rows = [row(seed=0), row(seed=1)]
    write_contact_sheet(tmp_path / "contact.png", rows, panel_width=320)  # one image pixel, one picture pixel
    picture = cv2.imread(str(tmp_path / "contact.png")).astype(int)  # BGR
    height, width = rows[0].render.shape
    assert picture.shape == (HEAD + 2 * (CAPTION + height) + GAP, 4 * width + 5 * GAP, 3)
    for k, shown in enumerate(rows):
        top = HEAD + k * (CAPTION + height) + CAPTION
        panels = [
            picture[top : top + height, left : left + width]
            for left in (GAP + column * (width + GAP) for column in range(4))
        ]
        for panel, expected in zip(panels, (shown.truth, shown.render)):
            assert np.abs(panel[..., 0] - 255 * expected).max() <= 1  # 8 bits
        assert shown.truth is not None
        error = np.abs(shown.render - shown.truth)
        assert panels[2][error > 0.25].min() > 150  # magma ends near white,
        assert panels[2][error < 0.01].max() < 60  # and begins near black
        assert (panels[3][:, :10] == 255).all()  # nothing drawn: white
        near, far = panels[3][30, 15], panels[3][30, width - 5]
        assert near[0] > near[1]  # viridis: violet near,
        assert far[1] > far[0]  # yellow far


def test_missing_truth_leaves_labelled_blanks(tmp_path: Path) -> None:
    image = np.zeros((60, 320))
    write_contact_sheet(tmp_path / "a.png", [PictureRow("", None, image, image)], panel_width=320)
    panel = cv2.imread(str(tmp_path / "a.png"))[HEAD + CAPTION :][:60, GAP : GAP + 320]
    assert (panel[:10] == 255).all()
    assert (panel[20:40] < 100).any()  # dark letters


@pytest.mark.parametrize(("width", "shown"), [(120, 360), (384, 384), (768, 320)])
def test_images_of_any_size_become_panels_of_about_one_size(tmp_path: Path, width: int, shown: int) -> None:
    write_contact_sheet(tmp_path / "a.png", [row(width // 2, width)], panel_width=320)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape[:2] == (HEAD + CAPTION + shown // 2 + GAP, 4 * shown + 5 * GAP)


def test_image_of_another_size_is_an_error(tmp_path: Path) -> None:
    wrong = PictureRow("", np.zeros((8, 6)), np.zeros((6, 8)), np.zeros((6, 8)))
    with pytest.raises(DataError, match=r"truth: expected shape \(6, 8\)"):
        write_contact_sheet(tmp_path / "a.png", [wrong])
    with pytest.raises(DataError, match="at least one view"):
        write_contact_sheet(tmp_path / "a.png", [])
    assert list(tmp_path.iterdir()) == []


def test_smoothed_path_drops_tremor_and_keeps_the_way() -> None:
    t = np.linspace(0, 2, 101)
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = t
    poses[:, 1, 3] = 0.01 * np.where(np.arange(101) % 2, 1, -1)  # a tremor of 1 cm
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(t, [0, 0.5, 0])).as_matrix()
    smoothed = np.array(list(smooth_path(Trajectory(t, poses), fps=10, max_frames=100)))
    assert len(smoothed) == 20
    np.testing.assert_allclose(smoothed[:, 0, 3], np.linspace(0, 2, 20), atol=1e-6)  # symmetric windows
    assert np.abs(smoothed[1:-1, 1, 3]).max() < 0.004
    angles = Rotation.from_matrix(smoothed[:, :3, :3]).as_rotvec()[:, 1]
    np.testing.assert_allclose(angles, 0.5 * np.linspace(0, 2, 20), atol=1e-6)
    assert len(list(smooth_path(Trajectory(t, poses), fps=10, max_frames=7))) == 7


def test_path_of_one_pose_is_one_frame() -> None:
    (T,) = smooth_path(Trajectory(np.array([3.0]), np.eye(4)[None]), fps=10, max_frames=5)
    np.testing.assert_allclose(T, np.eye(4))


def test_video_shows_render_and_depth_side_by_side(tmp_path: Path) -> None:
    y = np.linspace(0, 1, 61)[:, None].repeat(91, 1)  # odd sizes: the last row is cut off
    views = [(y, 1 + y), (1 - y, 1 + y)]
    write_video(tmp_path / "a.mp4", fly_through_frames(views), fps=10)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = [video.read()[1] for _ in range(2)]
    assert not video.read()[0]
    assert frames[0].shape == (60, 182, 3)
    assert frames[0][5, 40].max() < 60 < 200 < frames[0][55, 40].min()  # the first view darkens upwards,
    assert frames[1][55, 40].max() < 60 < 200 < frames[1][5, 40].min()  # the second downwards
    blue, green, _ = frames[0][2, 150].astype(int)
    assert blue > green  # near: violet
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_video_without_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least one frame"):
        write_video(tmp_path / "a.mp4", [], fps=10)
    assert list(tmp_path.iterdir()) == []
