"""Place recognition: matches features of brightness images and solves for the pose with depth (SIFT, PnP)."""

import cv2
import numpy as np

from edslam_ti.camera import Camera
from edslam_ti.geometry import inverse
from edslam_ti.tracking.keyframes import BrightnessKeyframe

MIN_MATCHES = 15  # features that must agree with one pose


def pose_by_features(
    old: BrightnessKeyframe, new: BrightnessKeyframe, camera: Camera
) -> np.ndarray | None:  # [4, 4]
    """Return T_old_new from features that both keyframes' images show, or None. `camera`: of these images."""
    detector = cv2.SIFT.create(nfeatures=500, contrastThreshold=0.02)
    found = [detector.detectAndCompute(_as_picture(k.log_brightness), None) for k in (old, new)]
    (old_points, old_features), (new_points, new_features) = found
    if old_features is None or new_features is None or min(len(old_points), len(new_points)) < 2:
        return None
    pairs = cv2.BFMatcher().knnMatch(old_features, new_features, k=2)
    matches = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    at_old = np.array([old_points[m.queryIdx].pt for m in matches]).reshape(-1, 2)
    at_new = np.array([new_points[m.trainIdx].pt for m in matches]).reshape(-1, 2)
    u, v = np.rint(at_old).astype(int).T
    z = old.depth.small[v, u].astype(float)
    known = z > 0
    if known.sum() < MIN_MATCHES:
        return None
    points = camera.back_project_pixels(at_old[:, 0], at_old[:, 1], z)
    cv2.setRNGSeed(0)
    is_solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points[known], at_new[known], camera.matrix, None, reprojectionError=2.0
    )
    if not is_solved or inliers is None or len(inliers) < MIN_MATCHES:
        return None
    T_new_old = np.eye(4)
    T_new_old[:3, :3], T_new_old[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return inverse(T_new_old)


def _as_picture(log_brightness: np.ndarray) -> np.ndarray:  # [h, w] uint8
    low, high = np.percentile(log_brightness, (1, 99))
    return np.clip(255 * (log_brightness - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)
