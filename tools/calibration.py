"""How much later than colour the depth images are taken than their stamps say, from how the camera turns in each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from trihedron.pipeline.core.geometry import exp_so3, log_so3, tangent_basis
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Planes, Tracks

LEAST_POINTS = 20
REPROJECTION_PX = 2.0
COLOR_SIGMA = np.radians(0.05)  # of a frame's turn seen in the colour images
WEAKEST = 1e4  # information about a turn (1/rad²) in the direction the planes know least: two planes that are not parallel
SMOOTHING = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0  # of the rates, over frames
HUBER = 1.345
ROUNDS = 20


@dataclass(frozen=True)
class Turn:
    """How the camera turned since the previous frame (rad, rotation vectors), in the colour and in the depth images; the covariance of the second."""

    color: F64
    depth: F64
    covariance: F64


@dataclass(frozen=True)
class DepthDelay:
    """Seconds from the colour image to the depth image, its standard deviation, and the frames it rests on; NaN and infinite without any."""

    seconds: float
    sigma_s: float
    frames: int


def turn_of(tracks: Tracks, keypoints: Keypoints, planes: Planes, camera: Camera) -> Turn | None:
    """The turns from the previous frame: of the normals of planes, and of pixels under the earlier points; None when either cannot tell."""
    depth = _turn_of_planes(tracks, planes)
    color = _turn_of_points(tracks, keypoints, camera)
    return None if depth is None or color is None else Turn(color, *depth)


def _turn_of_planes(tracks: Tracks, planes: Planes) -> tuple[F64, F64] | None:
    """The rotation vector that turns the earlier normals onto these, by weighted least squares, and its covariance."""
    rows = tracks.planes[:, 1]
    before, after = tracks.coefficients[:, :3], planes.coefficients[rows, :3]
    variance = 0.5 * (np.trace(planes.covariance[rows, :2, :2], axis1=1, axis2=2) + np.trace(tracks.plane_covariance[:, :2, :2], axis1=1, axis2=2))
    R, information = tracks.R_current_previous, np.zeros((3, 3))
    for _ in range(3):
        turned = before @ R.T
        information = ((np.eye(3) - turned[:, :, None] * turned[:, None, :]) / variance[:, None, None]).sum(axis=0)
        if len(rows) < 2 or np.linalg.eigvalsh(information)[0] < WEAKEST:
            return None
        R = exp_so3(np.linalg.solve(information, (np.cross(turned, after) / variance[:, None]).sum(axis=0))) @ R
    return log_so3(R), np.asarray(np.linalg.inv(information), np.float64)


def _turn_of_points(tracks: Tracks, keypoints: Keypoints, camera: Camera) -> F64 | None:
    """The rotation vector of the pose from which the earlier points are seen at their pixels in this image (PnP; deterministic)."""
    known = np.isfinite(tracks.points_m).all(axis=1)
    points = tracks.points_m[known].astype(np.float64)
    pixels = keypoints.pixels[tracks.keypoints[known, 1]].astype(np.float64)
    if len(points) < LEAST_POINTS:
        return None
    cv2.setRNGSeed(0)
    found, turn, shift, inliers = cv2.solvePnPRansac(points, pixels, camera.K, None, reprojectionError=REPROJECTION_PX)
    if not found or inliers is None or len(inliers) < LEAST_POINTS:
        return None
    chosen = inliers[:, 0]
    turn, _ = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], camera.K, None, turn, shift)
    return np.asarray(turn, np.float64)[:, 0]


def estimate_depth_delay(turns: list[Turn], seconds: float) -> DepthDelay:
    """Robust least squares of τ in `depth − color = τ · change of the turning rate`, over frames `seconds` apart, in order.

    Only a camera that turns faster and slower tells: the standard deviation says how well."""
    if len(turns) < len(SMOOTHING):
        return DepthDelay(np.nan, np.inf, 0)
    color, depth = np.array([t.color for t in turns]), np.array([t.depth for t in turns])
    rates = np.apply_along_axis(np.convolve, 0, np.pad(color, ((2, 2), (0, 0)), "edge"), SMOOTHING, "valid") / seconds
    change, apart = np.gradient(rates, axis=0), depth - color
    information = np.linalg.inv(np.array([t.covariance for t in turns]) + COLOR_SIGMA**2 * np.eye(3))
    weights, tau, scale = np.ones(len(turns)), 0.0, 1.0
    for _ in range(ROUNDS):
        known = (weights * np.einsum("ni,nij,nj->n", change, information, change)).sum()
        if not known > 0.0:
            return DepthDelay(np.nan, np.inf, 0)
        tau = float((weights * np.einsum("ni,nij,nj->n", change, information, apart)).sum() / known)
        left = apart - tau * change
        size = np.sqrt(np.einsum("ni,nij,nj->n", left, information, left) / 3.0)
        scale = max(float(np.median(size)), 1e-6)
        weights = np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-12))
    return DepthDelay(tau, float(scale / np.sqrt(known)), len(turns))


# The offset of a depth sensor's inverse depths, from walls and floors that should meet at right angles.
#
# A sensor that triangulates errs in disparity first: `1 / z_true = 1 / z + δ` with one δ for all pixels. A plane stays a plane then, but turns:
# with `1 / z = q·r` along the rays r (`q = -n / d`), q becomes `q + δ e_z`. So right angles become oblique, the more the further away, and their
# mean departure says δ. A scale of all depths turns no plane and cannot be seen.

RIGHT_DEG = 8.0  # planes that meet within this of a right angle are meant to
BUILT_DEG = 0.5  # standard deviation of what builders mean by a right angle
HUBER = 1.345  # of a pair's departure over its standard deviation
ROUNDS = 20


@dataclass(frozen=True)
class RightAngle:
    """Two planes seen in one frame: the sine of their departure from a right angle, how much an offset changes it (m), and its variance."""

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
    """Robust least squares over pairs of landmarks, each with all frames it was seen in and an angle of its own that is right within BUILT_DEG.

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
