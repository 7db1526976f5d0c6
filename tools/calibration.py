"""The colour–depth time offset, from the rotation of the camera in each, and the offset of inverse depth, from right angles."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from trihedron.pipeline.core.geometry import exp_so3, log_so3, tangent_basis
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Planes, Tracks

LEAST_POINTS = 20
REPROJECTION_PX = 2.0
COLOR_SIGMA = np.radians(0.05)  # of the rotation between two colour images
WEAKEST = 1e4  # least information (1/rad²) about a rotation in any direction: two planes that are not parallel
SMOOTHING = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0  # of the rates, over frames
HUBER = 1.345
ROUNDS = 20


@dataclass(frozen=True)
class FrameRotation:
    """Rotation vectors (rad) since the previous frame, by the colour and by the depth images, and the covariance of the latter."""

    color: F64
    depth: F64
    covariance: F64


@dataclass(frozen=True)
class DepthDelay:
    """Seconds from the colour image to the depth image, its standard deviation, and the frames it rests on; NaN and infinite without any."""

    seconds: float
    sigma_s: float
    frames: int


def rotation_of_frame(tracks: Tracks, keypoints: Keypoints, planes: Planes, camera: Camera) -> FrameRotation | None:
    """Rotations from the previous frame by the normals of planes and by pixels of the earlier points; None when either is not observable."""
    depth = _rotation_by_planes(tracks, planes)
    color = _rotation_by_points(tracks, keypoints, camera)
    return None if depth is None or color is None else FrameRotation(color, *depth)


def _rotation_by_planes(tracks: Tracks, planes: Planes) -> tuple[F64, F64] | None:
    """Rotation vector that aligns the earlier normals with the current ones, by weighted least squares, and its covariance."""
    rows = tracks.planes[:, 1]
    before, after = tracks.coefficients[:, :3], planes.coefficients[rows, :3]
    variance = 0.5 * (np.trace(planes.covariance[rows, :2, :2], axis1=1, axis2=2) + np.trace(tracks.plane_covariance[:, :2, :2], axis1=1, axis2=2))
    R, information = tracks.R_current_previous, np.zeros((3, 3))
    for _ in range(3):
        rotated = before @ R.T
        information = ((np.eye(3) - rotated[:, :, None] * rotated[:, None, :]) / variance[:, None, None]).sum(axis=0)
        if len(rows) < 2 or np.linalg.eigvalsh(information)[0] < WEAKEST:
            return None
        R = exp_so3(np.linalg.solve(information, (np.cross(rotated, after) / variance[:, None]).sum(axis=0))) @ R
    return log_so3(R), np.asarray(np.linalg.inv(information), np.float64)


def _rotation_by_points(tracks: Tracks, keypoints: Keypoints, camera: Camera) -> F64 | None:
    """Rotation vector of the pose from which the earlier points project to their pixels in this image (PnP; deterministic)."""
    known = np.isfinite(tracks.points_m).all(axis=1)
    points = tracks.points_m[known].astype(np.float64)
    pixels = keypoints.pixels[tracks.keypoints[known, 1]].astype(np.float64)
    if len(points) < LEAST_POINTS:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(points, pixels, camera.K, None, reprojectionError=REPROJECTION_PX)
    if not found or inliers is None or len(inliers) < LEAST_POINTS:
        return None
    chosen = inliers[:, 0]
    rotation, _ = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], camera.K, None, rotation, translation)
    return np.asarray(rotation, np.float64)[:, 0]


def estimate_depth_delay(rotations: list[FrameRotation], seconds: float) -> DepthDelay:
    """Robust least squares of τ in `depth − color = τ · change of the angular rate`, over frames `seconds` apart, in order.

    Only a changing angular rate observes it, as the standard deviation shows."""
    if len(rotations) < len(SMOOTHING):
        return DepthDelay(np.nan, np.inf, 0)
    color, depth = np.array([t.color for t in rotations]), np.array([t.depth for t in rotations])
    rates = np.apply_along_axis(np.convolve, 0, np.pad(color, ((2, 2), (0, 0)), "edge"), SMOOTHING, "valid") / seconds
    change, apart = np.gradient(rates, axis=0), depth - color
    information = np.linalg.inv(np.array([t.covariance for t in rotations]) + COLOR_SIGMA**2 * np.eye(3))
    weights, tau, scale = np.ones(len(rotations)), 0.0, 1.0
    for _ in range(ROUNDS):
        known = (weights * np.einsum("ni,nij,nj->n", change, information, change)).sum()
        if not known > 0.0:
            return DepthDelay(np.nan, np.inf, 0)
        tau = float((weights * np.einsum("ni,nij,nj->n", change, information, apart)).sum() / known)
        left = apart - tau * change
        size = np.sqrt(np.einsum("ni,nij,nj->n", left, information, left) / 3.0)
        scale = max(float(np.median(size)), 1e-6)
        weights = np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-12))
    return DepthDelay(tau, float(scale / np.sqrt(known)), len(rotations))


# The offset of a depth sensor's inverse depths, from walls and floors that should meet at right angles.
#
# A sensor that triangulates errs in disparity first: `1 / z_true = 1 / z + δ` with one δ for all pixels. A plane stays a plane then, but is rotated:
# with `1 / z = q·r` along the rays r (`q = -n / d`), q becomes `q + δ e_z`. So right angles become oblique, the more the further away, and their
# mean departure determines δ. A scale of all depths rotates no plane and is not observable.

RIGHT_DEG = 8.0  # planes that meet within this of a right angle are taken for perpendicular
BUILT_DEG = 0.5  # standard deviation of a built right angle


@dataclass(frozen=True)
class RightAngle:
    """Two planes of one frame: the sine of their departure from a right angle, its derivative by the offset (m), and its variance."""

    sine: float
    lever_m: float
    variance: float


@dataclass(frozen=True)
class DepthOffset:
    """δ in 1/m, its standard deviation, and the pairs of planes it rests on; NaN and infinite without any."""

    per_m: float
    sigma_per_m: float
    pairs: int


def right_angles(planes: Planes, landmarks: dict[int, int]) -> dict[tuple[int, int], RightAngle]:
    """The right angles between planes of one frame, by the landmarks they belong to (`landmarks`: row -> id)."""
    found: dict[tuple[int, int], RightAngle] = {}
    n, d = planes.coefficients[:, :3], planes.coefficients[:, 3]
    tangents = tangent_basis(n)
    rows = sorted(landmarks)
    for a in rows:
        for b in rows:
            sine = float(n[a] @ n[b])
            if landmarks[a] < landmarks[b] and abs(sine) < np.sin(np.radians(RIGHT_DEG)):
                across = tangents[a].T @ n[b], tangents[b].T @ n[a]
                variance = sum(float(g @ planes.covariance[k, :2, :2] @ g) for g, k in zip(across, (a, b)))
                lever = -float(n[a, 2] * d[b] + n[b, 2] * d[a])
                found[landmarks[a], landmarks[b]] = RightAngle(sine, lever, variance)
    return found


def estimate_depth_offset(pairs: dict[tuple[int, int], list[RightAngle]]) -> DepthOffset:
    """Robust least squares over pairs of landmarks, each with all frames that observe it and a common angle that is right within BUILT_DEG.

    The standard deviation is enlarged when the pairs disagree by more than theirs."""
    information, estimates = np.array([_of_pair(seen) for seen in pairs.values()]).reshape(-1, 2).T
    used = information > 0.0
    information, estimates = information[used], estimates[used]
    if not len(information):
        return DepthOffset(np.nan, np.inf, 0)
    weights, delta = np.ones(len(information)), 0.0
    for _ in range(ROUNDS):
        delta = float((weights * information * estimates).sum() / (weights * information).sum())
        weights = np.minimum(1.0, HUBER / np.maximum(np.sqrt(information) * np.abs(estimates - delta), 1e-12))
    total = float((weights * information).sum())
    spread = float((weights * information * (estimates - delta) ** 2).sum()) / max(len(information) - 1, 1)
    return DepthOffset(delta, float(np.sqrt(max(spread, 1.0) / total)), len(information))


def _of_pair(seen: list[RightAngle]) -> tuple[float, float]:
    """Information about δ and its estimate from one pair of landmarks: frames err independently, the angle they share does not."""
    rows: F64 = np.array([(s.sine, s.lever_m, 1.0 / s.variance) for s in seen])
    sine, lever, weight = rows.T
    shared = 1.0 / np.radians(BUILT_DEG) ** 2
    mixed = (weight * lever).sum()
    information = (weight * lever * lever).sum() - mixed * mixed / (weight.sum() + shared)
    score = -(weight * lever * sine).sum() + mixed * (weight * sine).sum() / (weight.sum() + shared)
    return float(information), float(score / information) if information > 0.0 else 0.0
