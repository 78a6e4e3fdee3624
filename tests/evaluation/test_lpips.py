"""LPIPS gives the published distances and refuses files that hold no weights."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from edslam_ti.errors import DataError
from edslam_ti.evaluation.images import evaluate_images
from edslam_ti.evaluation.lpips import Lpips, load_lpips


def test_lpips_reproduces_published_distances(shared_data: Path) -> None:
    def picture(name: str) -> np.ndarray:
        image = cv2.imread(str(shared_data / "lpips" / name))
        assert image is not None
        return image[..., ::-1] / 255.0

    network = load_lpips(shared_data / "lpips" / "lpips_alex.pth")
    assert network is not None
    reference = picture("ex_ref.png")
    # The three images and distances come with the LPIPS repository (README, alex, v0.1).
    assert network(reference, picture("ex_p0.png")) == pytest.approx(0.7219, abs=1e-3)
    assert network(reference, picture("ex_p1.png")) == pytest.approx(0.1376, abs=1e-3)
    grey = reference.mean(-1)
    assert network(grey, np.repeat(grey[..., None], 3, -1)) == 0
    truths = [grey, grey]
    metrics = evaluate_images(
        [grey, grey[::-1]],
        truths,
        [np.ones(grey.shape, bool), np.zeros(grey.shape, bool)],
        shared_data / "lpips" / "lpips_alex.pth",
    )
    assert metrics.lpips_corrected == pytest.approx(0, abs=1e-6)
    assert metrics.lpips_corrected_all is not None
    assert metrics.lpips_corrected_all > 0.1


def test_unreadable_lpips_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="LPIPS weights not found"):
        Lpips(tmp_path / "none.pth")
    (tmp_path / "bad.pth").write_text("not weights")
    with pytest.raises(DataError, match=r"bad\.pth: expected LPIPS weights"):
        Lpips(tmp_path / "bad.pth")
