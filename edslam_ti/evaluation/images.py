"""PSNR, SSIM, LPIPS and depth L1 of rendered views against the truth.

Publications use the name PSNR for different measures, so every variant has its own name here: raw images or
EventNeRF's linear fit; pixels with true depth, or all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.errors import DataError
from edslam_ti.evaluation.lpips import ImageDistance, load_lpips

# Lists hold one array per view. A mask selects the pixels that count; images of one set share one fit.

Images = Sequence[np.ndarray]  # V of [H, W] or [H, W, C], brightness in gamma space, [0, 1]
Masks = Sequence[np.ndarray]  # V of [H, W] bool

GAMMA, LOG_OFFSET = 2.2, 0.1  # EventNeRF's metric: log(x^2.2 + 0.1)


@dataclass(frozen=True)
class LinearFit:
    """Corrected log brightness = slope * log brightness + offset, one pair per channel of the image set."""

    slope: np.ndarray  # [C]
    offset: np.ndarray  # [C]

    def __call__(self, image: np.ndarray) -> np.ndarray:  # [H, W] or [H, W, C]
        """Return the corrected image, not clipped above."""
        log = self.slope * _log_brightness(image) + self.offset
        result = np.maximum(0.0, np.exp(log) - LOG_OFFSET) ** (1 / GAMMA)
        return np.asarray(result.reshape(image.shape))


def fit_event_nerf(predictions: Images, truths: Images, masks: Masks) -> LinearFit:
    """Return EventNeRF's colour correction: events determine log brightness only up to slope and offset.

    Least squares in closed form over the pixels in the masks of all views (EventNeRF, metric/main.py):
    slope = covariance / variance of the prediction, offset = mean(truth) - slope * mean(prediction). The
    renders are not rounded to 8 bits.
    """
    x = np.concatenate([_log_brightness(p)[m] for p, m in zip(predictions, masks)])  # [P, C]
    y = np.concatenate([_log_brightness(t)[m] for t, m in zip(truths, masks)])
    if len(x) == 0:
        raise DataError("image metrics: no pixel to compare; expected true depth in at least one view")
    variance = x.var(0)
    covariance = ((x - x.mean(0)) * (y - y.mean(0))).mean(0)
    flat = variance < 1e-12  # with uniform brightness only the offset can be fitted
    slope = np.where(flat, 1.0, covariance / np.where(flat, 1.0, variance))
    return LinearFit(slope, y.mean(0) - slope * x.mean(0))


def _log_brightness(image: np.ndarray) -> np.ndarray:  # [H, W] or [H, W, C] -> [H, W, C] float64
    channels = image if image.ndim == 3 else image[..., None]
    return np.log(np.maximum(channels.astype(np.float64), 0.0) ** GAMMA + LOG_OFFSET)


def psnr(predictions: Images, truths: Images, masks: Masks) -> float:
    """Return the PSNR in dB of the mean square error over all pixels of all views (peak 1)."""
    errors = [((p.astype(np.float64) - t) ** 2)[m].ravel() for p, t, m in zip(predictions, truths, masks)]
    mean_square = float(np.concatenate(errors).mean())
    return -10 * float(np.log10(max(mean_square, 1e-12)))  # 120 dB: identical


def ssim(predictions: Images, truths: Images, masks: Masks) -> float:
    """Return the mean over views of the mean SSIM over the mask (scikit-image, 7x7 windows, data range 1)."""
    from skimage.metrics import structural_similarity

    values = []
    for prediction, truth, mask in zip(predictions, truths, masks):
        if mask.any():
            _, similarity = structural_similarity(
                np.clip(prediction, 0, 1).astype(np.float64),
                truth.astype(np.float64),
                data_range=1.0,
                channel_axis=2 if truth.ndim == 3 else None,
                full=True,
            )
            values.append(float(similarity[mask].mean()))
    return float(np.mean(values))


def depth_l1_cm(rendered: Images, true: Images) -> float | None:
    """Return the mean absolute depth error over the pixels with true depth, centimetres.

    A pixel where nothing is rendered counts with its full depth. None: there is no true depth.
    """
    errors = np.concatenate([np.abs(r - t)[t > 0].astype(np.float64) for r, t in zip(rendered, true)])
    return 100 * float(errors.mean()) if len(errors) else None


@dataclass(frozen=True)
class ViewMetrics:
    """One view of a set, over its pixels with true depth (all pixels where the set has none)."""

    psnr_corrected_db: float | None  # None: the view has no such pixel
    ssim_corrected: float | None
    lpips_corrected: float | None


@dataclass(frozen=True)
class ImageMetrics:
    """Metrics of a set of views: over pixels with true depth (the headline), and over all pixels.

    `corrected`: after EventNeRF's fit over the same pixels. LPIPS has no mask: for the headline, pixels
    without true depth are filled with the truth.
    """

    num_views: int
    fit: LinearFit  # over pixels with true depth (all pixels where there are none)
    views: list[ViewMetrics]
    psnr_db: float | None
    psnr_corrected_db: float | None
    ssim_corrected: float | None
    lpips_corrected: float | None
    psnr_db_all: float
    psnr_corrected_db_all: float
    ssim_corrected_all: float
    lpips_corrected_all: float | None
    ssim_all: float
    lpips_all: float | None


def evaluate_images(
    predictions: Images,
    truths: Images,
    depth_masks: Sequence[np.ndarray | None],  # V of [H, W] bool, true depth is known; None: nowhere
    lpips_weights: Path | None = None,
) -> ImageMetrics:
    """Return the metrics of rendered views against true images of the same size."""
    if not predictions or len(predictions) != len(truths) or len(truths) != len(depth_masks):
        raise DataError(
            f"image metrics: expected as many views as truths and masks, at least 1, got {len(predictions)}, "
            f"{len(truths)} and {len(depth_masks)}"
        )
    for prediction, truth in zip(predictions, truths):
        if prediction.shape != truth.shape:
            raise DataError(
                f"image metrics: render {prediction.shape} and truth {truth.shape} differ in size"
            )
    everywhere = [np.ones(t.shape[:2], bool) for t in truths]
    nowhere = [np.zeros(t.shape[:2], bool) for t in truths]
    masks = [n if m is None else np.asarray(m, bool) for m, n in zip(depth_masks, nowhere)]
    distance = load_lpips(lpips_weights)
    whole_fit = fit_event_nerf(predictions, truths, everywhere)
    whole = [whole_fit(p) for p in predictions]
    over_all = [_view_metrics(c, t, m, distance) for c, t, m in zip(whole, truths, everywhere)]
    has_depth = any(m.any() for m in masks)
    fit = fit_event_nerf(predictions, truths, masks) if has_depth else whole_fit
    corrected = [fit(p) for p in predictions]
    views = over_all
    if has_depth and not all(m.all() for m in masks):
        views = [_view_metrics(c, t, m, distance) for c, t, m in zip(corrected, truths, masks)]
    return ImageMetrics(
        num_views=len(predictions),
        fit=fit,
        views=views,
        psnr_db=psnr(predictions, truths, masks) if has_depth else None,
        psnr_corrected_db=psnr(corrected, truths, masks) if has_depth else None,
        ssim_corrected=_mean(v.ssim_corrected for v in views) if has_depth else None,
        lpips_corrected=_mean(v.lpips_corrected for v in views) if has_depth else None,
        psnr_db_all=psnr(predictions, truths, everywhere),
        psnr_corrected_db_all=psnr(whole, truths, everywhere),
        ssim_corrected_all=float(np.mean([v.ssim_corrected for v in over_all])),
        lpips_corrected_all=_mean(v.lpips_corrected for v in over_all),
        ssim_all=ssim(predictions, truths, everywhere),
        lpips_all=_mean(distance(p, t) for p, t in zip(predictions, truths)) if distance else None,
    )


def _view_metrics(
    corrected: np.ndarray, truth: np.ndarray, mask: np.ndarray, distance: ImageDistance | None
) -> ViewMetrics:
    if not mask.any():
        return ViewMetrics(None, None, None)
    return ViewMetrics(
        psnr([corrected], [truth], [mask]),
        ssim([corrected], [truth], [mask]),
        distance(_filled(corrected, truth, mask), truth) if distance else None,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _filled(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the prediction inside the mask, the truth outside."""
    return np.where(mask if truth.ndim == 2 else mask[..., None], prediction, truth)
