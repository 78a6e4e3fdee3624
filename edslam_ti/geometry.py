"""SE(3): one name for each operation, on numpy arrays or torch tensors; the result has the input's type.

Poses are 4x4 matrices `T_a_b` that map points of frame b into frame a. Twists are 6-vectors in the
order (translation, rotation). Formulas: Barfoot, State Estimation for Robotics, ch. 7; the small-angle
branches are Taylor series, so that values and gradients stay right at and below 1e-7 rad.

Tensors may have any batch shape and are differentiable. A single pose or twist as a numpy array takes a path
without torch, forty times as fast, for the loops of the tracker; it may differ in the last bit.
"""

import math
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Array = TypeVar("Array", np.ndarray, Tensor)

SMALL_ANGLE_SQUARED = 1e-6  # rad^2; the fourth-order series below is exact to 1e-16 there


def skew(w: Tensor) -> Tensor:  # [..., 3] -> [..., 3, 3], skew(w) @ v = w x v
    """Return the cross-product matrix of each vector."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _exp_coefficients(theta_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3."""
    small = theta_squared < SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(theta_squared), theta_squared)
    theta = safe.sqrt()
    t2 = theta_squared
    a = torch.where(small, 1 - t2 / 6 + t2 * t2 / 120, theta.sin() / theta)
    # (1 - cos t) as 2 sin^2(t/2), which does not cancel in single precision
    b = torch.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, 2 * (theta / 2).sin().square() / safe)
    c = torch.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (theta - theta.sin()) / (safe * theta))
    return a, b, c


def _exp_of_tensors(twist: Tensor) -> Tensor:  # [..., 6] -> [..., 4, 4]
    v, w = twist[..., :3], twist[..., 3:]
    W = skew(w)
    W2 = W @ W
    a, b, c = (x[..., None, None] for x in _exp_coefficients((w * w).sum(-1)))
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = eye + a * W + b * W2
    translation = ((eye + b * W + c * W2) @ v[..., None])[..., 0]
    return from_rotation_translation(rotation, translation)


def _log_of_tensors(T: Tensor) -> Tensor:  # [..., 4, 4] -> [..., 6]
    R, t = T[..., :3, :3], T[..., :3, 3]
    vee = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    sine2 = 0.25 * (vee * vee).sum(-1)  # sin^2(theta)
    cosine = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    small = (sine2 < SMALL_ANGLE_SQUARED) & (cosine > 0)
    safe_sine = torch.where(small, torch.ones_like(sine2), sine2).clamp_min(1e-24).sqrt()
    theta = torch.atan2(safe_sine, cosine)
    # theta / (2 sin theta), as a series in sin^2 near zero: asin(s)/s = 1 + s^2/6 + 3 s^4/40 + ...
    scale = torch.where(small, 0.5 + sine2 / 12 + 3 * sine2 * sine2 / 80, 0.5 * theta / safe_sine)
    w = scale[..., None] * vee
    W = skew(w)
    _, b, _ = _exp_coefficients((w * w).sum(-1))
    theta2 = (w * w).sum(-1)
    a, _, _ = _exp_coefficients(theta2)
    near = theta2 < 1e-4
    safe2 = torch.where(near, torch.ones_like(theta2), theta2)
    d = torch.where(near, 1 / 12 + theta2 / 720 + theta2 * theta2 / 30240, (1 - a / (2 * b)) / safe2)
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    v = ((eye - 0.5 * W + d[..., None, None] * (W @ W)) @ t[..., None])[..., 0]
    return torch.cat([v, w], -1)


def from_rotation_translation(R: Tensor, t: Tensor) -> Tensor:  # [..., 3, 3], [..., 3] -> [..., 4, 4]
    """Return the 4x4 matrix [R t; 0 1]."""
    top = torch.cat([R, t[..., None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device)
    return torch.cat([top, bottom.expand(*top.shape[:-2], 1, 4)], -2)


def _exp_of_twist(twist: np.ndarray) -> np.ndarray:  # [6] -> [4, 4]
    R, V = _rotation_and_jacobian(twist[3:])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, V @ twist[:3]
    return T


def _log_of_pose(T: np.ndarray) -> np.ndarray:  # [4, 4] -> [6]
    R = T[:3, :3]
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = math.sqrt(float(axis @ axis))
    angle = math.atan2(sine, 0.5 * (float(np.trace(R)) - 1))
    if angle > 3:
        return _log_of_tensors(torch.from_numpy(T)).numpy()  # near 180 degrees the sine is inaccurate
    w = axis * (angle / sine if sine > SMALL_ANGLE_SQUARED else 1.0)
    return np.concatenate([np.linalg.solve(_rotation_and_jacobian(w)[1], T[:3, 3]), w])


def _rotation_and_jacobian(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [3] -> two [3, 3]
    """Return the rotation exp(w) and V, with exp of a twist (v, w) translating by V v."""
    x, y, z = w
    theta2 = float(w @ w)
    if theta2 < SMALL_ANGLE_SQUARED:
        a = 1 - theta2 / 6 + theta2 * theta2 / 120
        b = 0.5 - theta2 / 24 + theta2 * theta2 / 720
        c = 1 / 6 - theta2 / 120 + theta2 * theta2 / 5040
    else:
        theta = math.sqrt(theta2)
        a, b = math.sin(theta) / theta, 2 * math.sin(theta / 2) ** 2 / theta2
        c = (theta - math.sin(theta)) / (theta2 * theta)
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    W2 = W @ W
    return np.eye(3) + (a * W + b * W2), np.eye(3) + (b * W + c * W2)


def se3_exp(twist: Array) -> Array:  # [..., 6] -> [..., 4, 4]
    """Return the rigid motion exp(twist)."""
    if isinstance(twist, Tensor):
        return _exp_of_tensors(twist)
    return _exp_of_twist(twist) if twist.ndim == 1 else _exp_of_tensors(torch.from_numpy(twist)).numpy()


def se3_log(T: Array) -> Array:  # [..., 4, 4] -> [..., 6]
    """Return the twist of each rigid motion; rotations by pi have no unique logarithm."""
    if isinstance(T, Tensor):
        return _log_of_tensors(T)
    return _log_of_pose(T) if T.ndim == 2 else _log_of_tensors(torch.from_numpy(T)).numpy()


def inverse(T: Array) -> Array:  # [..., 4, 4]
    """Return the inverse rigid motion, from the transposed rotation."""
    if isinstance(T, Tensor):
        R_t = T[..., :3, :3].transpose(-1, -2)
        return from_rotation_translation(R_t, -(R_t @ T[..., :3, 3:])[..., 0])
    if T.ndim == 2:
        single = np.eye(4)
        single[:3, :3] = T[:3, :3].T
        single[:3, 3] = -(T[:3, :3].T @ T[:3, 3])
        return single
    result = np.tile(np.eye(4), (*T.shape[:-2], 1, 1))
    result[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    result[..., :3, 3:] = -(result[..., :3, :3] @ T[..., :3, 3:])
    return result


def interpolate(T_start: Array, T_end: Array, fraction: "Array | float") -> Array:  # [..., 4, 4], [...]
    """Return T_start exp(fraction log(T_start^-1 T_end)), the geodesic of Eq. 9; extrapolates too."""
    twist = se3_log(inverse(T_start) @ T_end)
    if not isinstance(fraction, int | float) and fraction.ndim:
        fraction = fraction[..., None]
    return T_start @ se3_exp(fraction * twist)


def adjoint(T: np.ndarray) -> np.ndarray:  # [4, 4] -> [6, 6]
    """Return Ad(T) for twists (translation, rotation): T exp(xi) = exp(Ad(T) xi) T."""
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = R
    result[:3, 3:] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    return result


def transformed(T: np.ndarray, points: np.ndarray) -> np.ndarray:  # [4, 4], [..., 3] -> [..., 3]
    """Return points of frame b in frame a, T = T_a_b."""
    return points @ T[:3, :3].T + T[:3, 3]


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:  # [..., 4] wxyz each
    """Return the quaternion of the rotation by b followed by the rotation by a."""
    (w, x, y, z), (p, q, r, s) = a.unbind(-1), b.unbind(-1)
    product = (
        *(w * p - x * q - y * r - z * s, w * q + x * p + y * s - z * r),
        *(w * r - x * s + y * p + z * q, w * s + x * r - y * q + z * p),
    )
    return torch.stack(product, -1)


def orthonormalized(T: np.ndarray) -> np.ndarray:  # [4, 4]
    """Return the nearest rigid motion (SVD), which removes the drift of long products."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    result[:3, 3] = T[:3, 3]
    return result


def rotation_angle_deg(T: np.ndarray) -> float:  # [4, 4] -> degrees
    """Return the angle of the rotation part."""
    return float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1.0, 1.0))))


def is_near(T: np.ndarray, distance: float, angle: float) -> bool:  # [4, 4], metres, degrees
    """Return whether a motion has a translation below `distance` and a rotation below `angle`."""
    return float(np.linalg.norm(T[:3, 3])) < distance and rotation_angle_deg(T) < angle
