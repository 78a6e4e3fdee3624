"""Numbers of a result: trajectory errors through evo; PSNR, SSIM, LPIPS and depth L1 of rendered views.

Peers call different things ATE and PSNR, so every variant has a name of its own: SE(3) or Sim(3) alignment,
rmse, mean, median or maximum; raw images or EventNeRF's linear fit; pixels with true depth, or all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from edslam_ti.errors import DataError
from edslam_ti.geometry import orthonormalized
from edslam_ti.trajectory import Trajectory

# --- trajectories ---

LONGEST_TRUTH_GAP = 0.5  # s: motion capture drops out; truth is not interpolated over longer gaps


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an estimated path against the truth at its own times (Eq. 9 between the truth's stamps).

    ATE: distance of positions after Umeyama alignment of all poses, with rotation and translation (SE(3)) or
    scale too (Sim(3)). RPE: error of the motion between consecutive poses, of the path without scaling.
    """

    timestamps: np.ndarray  # [P] s, the poses compared
    indices: np.ndarray  # [P] of the poses compared in the estimate
    T_truth_estimate: np.ndarray  # [4, 4] SE(3) alignment
    aligned_positions: np.ndarray  # [P, 3] m, estimate in the truth's frame, SE(3)
    true_positions: np.ndarray  # [P, 3] m
    errors_cm: np.ndarray  # [P] SE(3)
    errors_sim3_cm: np.ndarray  # [P]
    motion_errors_cm: np.ndarray  # [P - 1] RPE, translation
    motion_errors_deg: np.ndarray  # [P - 1] RPE, rotation angle
    scale: float  # by which Sim(3) alignment multiplies the estimate

    @property
    def num_poses(self) -> int:
        return len(self.timestamps)

    @property
    def ate_rmse_cm(self) -> float:
        return _rms(self.errors_cm)

    @property
    def ate_mean_cm(self) -> float:
        return float(self.errors_cm.mean())

    @property
    def ate_median_cm(self) -> float:
        return float(np.median(self.errors_cm))

    @property
    def ate_max_cm(self) -> float:
        return float(self.errors_cm.max())

    @property
    def ate_rmse_sim3_cm(self) -> float:
        return _rms(self.errors_sim3_cm)

    @property
    def rpe_trans_cm(self) -> float:
        """Rmse between consecutive poses."""
        return _rms(self.motion_errors_cm)

    @property
    def rpe_rot_deg(self) -> float:
        """Rmse between consecutive poses."""
        return _rms(self.motion_errors_deg)


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compare the poses of an estimate whose times the truth covers with the truth at those times."""
    from evo.core.metrics import APE, RPE, PoseRelation
    from evo.core.trajectory import PosePath3D

    common = _common_times(estimate, truth)
    if common.sum() < 3:
        raise DataError(
            f"trajectory: expected at least 3 poses at times that the truth covers, got {common.sum()} of "
            f"{len(estimate)} ({_span(estimate)}; truth {_span(truth)}); are both in seconds, on one clock?"
        )
    timestamps = estimate.timestamps[common]
    estimated = np.array([orthonormalized(T) for T in estimate.poses[common]])
    true = truth.resampled(timestamps).poses
    reference = PosePath3D(poses_se3=list(true))
    aligned, errors, rigid = [], [], np.eye(4)
    for with_scale in (False, True):
        R, t, scale = align(estimated, true, with_scale)
        if not with_scale:
            rigid[:3, :3], rigid[:3, 3] = R, t
        moved = np.tile(np.eye(4), (len(estimated), 1, 1))
        moved[:, :3, :3] = R @ estimated[:, :3, :3]
        moved[:, :3, 3] = scale * estimated[:, :3, 3] @ R.T + t
        ape = APE(PoseRelation.translation_part)
        ape.process_data((reference, PosePath3D(poses_se3=list(moved))))
        aligned.append(moved[:, :3, 3])
        errors.append(100 * np.asarray(ape.error))
    motion = {}
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        rpe = RPE(relation)  # over one frame
        rpe.process_data((reference, PosePath3D(poses_se3=list(estimated))))
        motion[relation] = np.asarray(rpe.error)
    return TrajectoryErrors(
        timestamps=timestamps,
        indices=np.flatnonzero(common),
        T_truth_estimate=rigid,
        aligned_positions=aligned[0],
        true_positions=true[:, :3, 3],
        errors_cm=errors[0],
        errors_sim3_cm=errors[1],
        motion_errors_cm=100 * motion[PoseRelation.translation_part],
        motion_errors_deg=motion[PoseRelation.rotation_angle_deg],
        scale=scale,
    )


def ate_rmse_cm(estimate: Trajectory, truth: Trajectory, with_scale: bool = False) -> float | None:
    """Return the ATE of `TrajectoryErrors` alone, 20 times as fast; None below three common poses."""
    common = _common_times(estimate, truth)
    if common.sum() < 3:
        return None
    estimated = estimate.poses[common]
    true = truth.resampled(estimate.timestamps[common]).poses
    R, t, scale = align(estimated, true, with_scale)
    distances = np.linalg.norm(scale * estimated[:, :3, 3] @ R.T + t - true[:, :3, 3], axis=1)
    return 100 * _rms(distances)


def align(
    estimated: np.ndarray,  # [P, 4, 4]
    true: np.ndarray,  # [P, 4, 4]
    with_scale: bool = False,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return R [3, 3], t [3], s that bring the estimated positions closest to the true ones: s R p + t.

    Umeyama 1991 through evo. Positions on a line (a slider) or at one point leave R free, which evo refuses:
    among the rotations that fit the positions equally well, the one that fits the orientations is taken.
    """
    from evo.core.geometry import GeometryException, umeyama_alignment

    p, q = estimated[:, :3, 3], true[:, :3, 3]
    try:
        R, t, scale = umeyama_alignment(p.T, q.T, with_scale)
        if np.isfinite(scale):
            return R, t, float(scale)
    except GeometryException:
        pass
    centred_p, centred_q = p - p.mean(0), q - q.mean(0)
    covariance = centred_q.T @ centred_p
    orientations = np.einsum("nij,nkj->ik", true[:, :3, :3], estimated[:, :3, :3])
    tie_break = 1e-6 * (np.linalg.norm(covariance) + 1e-12) / len(p)
    U, _, Vt = np.linalg.svd(covariance + tie_break * orientations)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    spread = float((centred_p**2).sum())
    scale = float((R * covariance).sum()) / spread if with_scale and spread > 1e-12 else 1.0
    return R, q.mean(0) - scale * R @ p.mean(0), scale


def align_views(
    estimated: np.ndarray,  # [P, 4, 4]
    true: np.ndarray,  # [P, 4, 4]
    distance: float = 1.0,  # metres to what the cameras see
) -> np.ndarray:  # [4, 4]
    """Return the rigid motion from the estimate's frame to the truth's under which the cameras see alike.

    Positions alone leave the rotation loose where the path is short: 1 mm over 10 cm is half a degree,
    two pixels. Here the points `distance` metres along the axes of every camera are brought together, too:
    Procrustes with the orientations added to the covariance of the positions.
    """
    p, q = estimated[:, :3, 3], true[:, :3, 3]
    covariance = (q - q.mean(0)).T @ (p - p.mean(0))
    covariance += distance**2 * np.einsum("nij,nkj->ik", true[:, :3, :3], estimated[:, :3, :3])
    U, _, Vt = np.linalg.svd(covariance)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = q.mean(0) - T[:3, :3] @ p.mean(0)
    return T


def statistics(errors: np.ndarray) -> dict[str, float]:
    """Return the seven numbers that evo prints, in its order."""
    return {
        "max": float(errors.max()),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "min": float(errors.min()),
        "rmse": _rms(errors),
        "sse": float((errors**2).sum()),
        "std": float(errors.std()),
    }


def _common_times(estimate: Trajectory, truth: Trajectory) -> np.ndarray:  # [F] bool
    """Return which poses of the estimate lie inside the truth and not in a gap of it."""
    stamps, times = truth.timestamps, estimate.timestamps
    if len(stamps) < 2 or len(times) == 0:
        return np.isin(times, stamps)
    steps = np.diff(stamps)
    k = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(steps) - 1)
    at_a_stamp = np.minimum(np.abs(times - stamps[k]), np.abs(times - stamps[k + 1])) < 1e-6
    inside = (times >= stamps[0]) & (times <= stamps[-1])
    return at_a_stamp | (inside & (steps[k] <= max(LONGEST_TRUTH_GAP, 3 * float(np.median(steps)))))


def _span(trajectory: Trajectory) -> str:
    t = trajectory.timestamps
    return f"{t[0]:.6g} to {t[-1]:.6g} s" if len(t) else "empty"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


# Slices of EventReplica's scenes that IncEventGS evaluates on, as (first, end) of every second written pose
# (configs/SimuEvent/replica_*.yaml of WU-CVGL/IncEventGS at 28d070f).
INCEVENTGS_SLICES = {
    "office0": (10, 60),
    "office2": (350, 400),
    "office3": (100, 150),
    "room0": (90, 140),
    "room2": (20, 70),
}


def inceventgs_slice(
    scene: str, truth: Trajectory, estimate: Trajectory
) -> tuple[float, float] | None:  # seconds
    """Return IncEventGS's slice of one of EventReplica's scenes; None: the estimate does not cover it."""
    first, end = (2 * k for k in INCEVENTGS_SLICES.get(scene, (0, 0)))
    if end == 0 or end >= len(truth):
        return None
    start, stop = float(truth.timestamps[first]), float(truth.timestamps[end])
    tolerance = 0.1  # seconds; the first sample comes a little after the first event
    covered = estimate.timestamps[0] <= start + tolerance and estimate.timestamps[-1] >= stop - tolerance
    return (start, stop) if covered else None


# --- images ---
# Lists hold one array per view. A mask says which pixels count; images of one set share one fit.

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
    """Return EventNeRF's colour correction: events fix brightness only up to a slope and an offset in log.

    Least squares in closed form over the pixels in the masks of all views (EventNeRF, metric/main.py):
    slope = covariance / variance of the prediction, offset = mean(truth) - slope * mean(prediction). The
    renders are taken as they are, without rounding to 8 bits.
    """
    x = np.concatenate([_log_brightness(p)[m] for p, m in zip(predictions, masks)])  # [P, C]
    y = np.concatenate([_log_brightness(t)[m] for t, m in zip(truths, masks)])
    if len(x) == 0:
        raise DataError("image metrics: no pixel to compare; expected true depth in at least one view")
    variance = x.var(0)
    covariance = ((x - x.mean(0)) * (y - y.mean(0))).mean(0)
    flat = variance < 1e-12  # an image of one brightness: only the offset can be fitted
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

    A pixel where nothing is rendered counts with its whole depth. None: no true depth at all.
    """
    errors = np.concatenate([np.abs(r - t)[t > 0].astype(np.float64) for r, t in zip(rendered, true)])
    return 100 * float(errors.mean()) if len(errors) else None


# --- LPIPS (Zhang et al. 2018, version 0.1, AlexNet) ---


class Lpips:
    """Perceptual distance: AlexNet features, normalised per pixel, squared differences, learned weights."""

    # torchvision's AlexNet: (index of the convolution, stride, padding, max-pooling before it)
    LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))

    def __init__(self, weights: Path) -> None:
        """Read a torch state dict with `features.N.{weight,bias}` and `linK.model.1.weight`."""
        if not weights.is_file():
            raise FileNotFoundError(f"{weights}: LPIPS weights not found")
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
            self._convolutions = [
                (state[f"features.{k}.weight"], state[f"features.{k}.bias"], stride, padding, pool)
                for k, stride, padding, pool in self.LAYERS
            ]
            self._linear = [state[f"lin{k}.model.1.weight"] for k in range(len(self.LAYERS))]
        except Exception as error:  # torch.load raises whatever unpickling does
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise DataError(
                f"{weights}: expected LPIPS weights (a torch state dict with features.N.weight, "
                f"features.N.bias and linK.model.1.weight); {reason}"
            ) from error
        self._shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        self._scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance of two images [H, W] or [H, W, 3] (RGB) in [0, 1], at least 32x32 pixels."""
        distance = 0.0
        for linear, f, g in zip(self._linear, self._features(a), self._features(b)):
            distance += float(F.conv2d((f - g) ** 2, linear).mean())
        return distance

    def _features(self, image: np.ndarray) -> list[Tensor]:
        x = (2 * _rgb_tensor(image) - 1 - self._shift) / self._scale
        features = []
        for weight, bias, stride, padding, pool in self._convolutions:
            if pool:
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            features.append(_unit_length(x))
        return features


def _unit_length(x: Tensor) -> Tensor:  # [1, C, h, w], along the channels
    return x / (x.norm(dim=1, keepdim=True) + 1e-10)


def _rgb_tensor(image: np.ndarray) -> Tensor:  # [H, W] or [H, W, 3] -> [1, 3, H, W]
    x = torch.from_numpy(np.ascontiguousarray(np.clip(image, 0, 1), np.float32))
    return (x[..., None].expand(-1, -1, 3) if x.ndim == 2 else x).permute(2, 0, 1)[None]


class _PackageLpips:
    """The `lpips` package's own network."""

    def __init__(self, package: Any) -> None:
        self._network = package.LPIPS(net="alex", verbose=False)

    @torch.no_grad()
    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        return float(self._network(2 * _rgb_tensor(a) - 1, 2 * _rgb_tensor(b) - 1))


@cache
def load_lpips(weights: Path | None) -> "Lpips | _PackageLpips | None":
    """Return LPIPS from a weights file, else from the `lpips` package, else None."""
    if weights is not None:
        return Lpips(weights)
    try:
        import lpips
    except ImportError:
        return None
    try:
        return _PackageLpips(lpips)
    except OSError:  # the package downloads AlexNet; there is no network
        return None


# --- all of it ---


@dataclass(frozen=True)
class ViewMetrics:
    """One view of a set, over its pixels with true depth (all pixels where the set has none)."""

    psnr_corrected_db: float | None  # None: the view has no such pixel
    ssim_corrected: float | None
    lpips_corrected: float | None


@dataclass(frozen=True)
class ImageMetrics:
    """Metrics of a set of views: over pixels with true depth (the headline), and over all pixels.

    `corrected` is after EventNeRF's fit over the same pixels. LPIPS knows no mask: for the headline, pixels
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
    corrected: np.ndarray, truth: np.ndarray, mask: np.ndarray, distance: "Lpips | _PackageLpips | None"
) -> ViewMetrics:
    if not mask.any():
        return ViewMetrics(None, None, None)
    return ViewMetrics(
        psnr([corrected], [truth], [mask]),
        ssim([corrected], [truth], [mask]),
        distance(_filled(corrected, truth, mask), truth) if distance else None,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of what there is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _filled(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the prediction inside the mask, the truth outside."""
    return np.where(mask if truth.ndim == 2 else mask[..., None], prediction, truth)
