"""Numbers of rendered views: EventNeRF's fit, PSNR, SSIM and depth errors."""

import cv2
import numpy as np
import pytest

from edslam_ti.errors import DataError
from edslam_ti.evaluation.images import depth_l1_cm, evaluate_images, fit_event_nerf, psnr, ssim


def pictures(count: int = 3, height: int = 40, width: int = 48) -> list[np.ndarray]:
    """Smooth random pictures in [0, 1]."""
    random = np.random.default_rng(0)
    result = [cv2.GaussianBlur(random.random((height, width)), (0, 0), 2) for _ in range(count)]
    return [(image - image.min()) / np.ptp(image) for image in result]


def distorted(image: np.ndarray, slope: float, offset: float) -> np.ndarray:
    """Return an image whose corrected log brightness is the original's."""
    log = (np.log(image**2.2 + 0.1) - offset) / slope
    return np.asarray(np.maximum(np.exp(log) - 0.1, 0) ** (1 / 2.2))


def test_fit_removes_slope_and_offset_in_log_for_the_whole_set() -> None:
    truths = [0.4 + 0.5 * image for image in pictures()]  # bright: nothing is clipped
    predictions = [distorted(image, slope=0.9, offset=-0.05) for image in truths]
    everywhere = [np.ones(t.shape, bool) for t in truths]
    fit = fit_event_nerf(predictions, truths, everywhere)
    assert fit.slope == pytest.approx(0.9)
    assert fit.offset == pytest.approx(-0.05)
    assert psnr([fit(p) for p in predictions], truths, everywhere) > 100


def test_the_fit_and_psnr_count_masked_pixels_only() -> None:
    truths = [0.4 + 0.5 * image for image in pictures()]  # bright: nothing is clipped
    masks = [np.arange(48)[None] < np.full((40, 1), 30) for _ in truths]
    predictions = [np.where(m, distorted(t, 0.9, 0.0), 7.0) for t, m in zip(truths, masks)]
    fit = fit_event_nerf(predictions, truths, masks)
    assert fit.slope == pytest.approx(0.9)
    assert psnr([fit(p) for p in predictions], truths, masks) > 100
    metrics = evaluate_images(predictions, truths, masks)
    assert metrics.psnr_corrected_db is not None
    assert metrics.psnr_corrected_db > 100 > 40 > metrics.psnr_corrected_db_all


def test_psnr_is_of_the_error_of_all_images_together() -> None:
    truths = [np.zeros((4, 4)), np.zeros((4, 4))]
    predictions = [np.zeros((4, 4)), np.full((4, 4), 0.2)]
    everywhere = [np.ones((4, 4), bool)] * 2
    assert psnr(predictions, truths, everywhere) == pytest.approx(-10 * np.log10(0.02))


def test_ssim_is_scikit_images_where_everything_counts() -> None:
    from skimage.metrics import structural_similarity

    a, b, _ = pictures()
    everywhere = np.ones(a.shape, bool)
    assert ssim([a], [a], [everywhere]) == 1
    _, similarity = structural_similarity(a, b, data_range=1.0, full=True)
    assert ssim([a], [b], [everywhere]) == pytest.approx(similarity.mean())
    half = everywhere.copy()
    half[:, 20:] = False
    assert ssim([a], [b], [half]) == pytest.approx(similarity[:, :20].mean())


def test_views_without_depth_count_only_over_all_pixels() -> None:
    truths = pictures(2)
    metrics = evaluate_images([0.9 * t for t in truths], truths, [None, None])
    assert metrics.psnr_corrected_db is None
    assert metrics.psnr_db_all > 20
    with pytest.raises(DataError, match="differ in size"):
        evaluate_images([truths[0][1:]], truths[:1], [None])


def test_every_view_has_its_numbers_and_they_make_the_sets() -> None:
    truths = pictures(3)
    random = np.random.default_rng(1)
    predictions = [t + random.normal(0, 0.05 * k, t.shape) for k, t in enumerate(truths, 1)]
    masks = [np.ones(t.shape, bool) for t in truths]
    masks[0][:, 20:] = False
    masks[2][:] = False
    metrics = evaluate_images(predictions, truths, masks)
    one, two, three = metrics.views
    assert one.psnr_corrected_db is not None
    assert two.psnr_corrected_db is not None
    assert three.psnr_corrected_db is None
    squares = [
        10 ** (-v / 10) * m.sum()
        for v, m in ((one.psnr_corrected_db, masks[0]), (two.psnr_corrected_db, masks[1]))
    ]
    expected = -10 * np.log10(sum(squares) / (masks[0].sum() + masks[1].sum()))
    assert metrics.psnr_corrected_db == pytest.approx(expected)
    assert metrics.ssim_corrected == pytest.approx(np.mean([one.ssim_corrected, two.ssim_corrected]))
    assert metrics.ssim_all == pytest.approx(
        ssim(predictions, truths, [np.ones(t.shape, bool) for t in truths])
    )


def test_a_render_of_one_brightness_is_only_offset() -> None:
    truths = pictures(1)
    metrics = evaluate_images([np.full_like(truths[0], 0.3)], truths, [np.ones(truths[0].shape, bool)])
    assert metrics.psnr_corrected_db is not None
    assert np.isfinite(metrics.psnr_corrected_db)


def test_depth_l1_counts_unrendered_pixels_whole() -> None:
    true = np.array([[1.0, 2.0], [0.0, 4.0]])
    assert depth_l1_cm([np.array([[1.1, 2.0], [5.0, 0.0]])], [true]) == pytest.approx(
        100 * (0.1 + 0 + 4.0) / 3
    )
    assert depth_l1_cm([true], [np.zeros((2, 2))]) is None
