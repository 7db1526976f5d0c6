"""Focal lengths that agree with the depth, from points that two keyframes measured.

A point at pixel (u, v) with depth z is at `((u - cx) / fx, (v - cy) / fy, 1) · z`. Wrong focal lengths stretch these points along the image's axes,
so that after a rotation no rigid motion maps one keyframe's points to the other's. Every pair of keyframes therefore determines the factors of fx and
fy as two more parameters of the motion between them, with their covariance. A pair without rotation does not observe them. The matches were selected
under the focal lengths in use, which biases a large correction towards none (14 % are found of 17 %): run again with the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import exp_so3, invert, rotation_angle_deg
from trihedron.pipeline.core.types import F64, I32, Map

MIN_POINTS = 30  # that a pair of keyframes must share
NEIGHBOURS = 7  # later keyframes that a keyframe may be paired with
PRIOR_SIGMA = 0.5  # of the logarithm of a factor
GATE2 = 9.0  # squared Mahalanobis distance at which a point counts a quarter (Geman and McClure)
ITERATIONS = 10
HUBER = 1.345  # of a pair's Mahalanobis distance, per root of its two factors
ROUNDS = 20
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class FocalLengths:
    """Factors (2,) of fx and fy relative to the recording, their standard deviations (2,), and the number of pairs of keyframes."""

    factors: F64
    sigmas: F64
    pairs: int


@dataclass(frozen=True)
class MeasuredPoints:
    """Points with depth that a keyframe measured: ids (n,), sorted, pixels (n, 2), depths (n,) m, and variances (n,) of both; its intrinsics (4,)."""

    ids: I32
    pixels: F64
    depths_m: F64
    variance_px2: F64
    variance_m2: F64
    intrinsics: F64


def estimate_focal_lengths(map: Map) -> FocalLengths:
    """Estimate both factors by robust least squares over pairs of keyframes; NaN and infinite σ without any pair.

    Each living keyframe is paired with that of the next ones which is rotated most and shares enough points with it. The standard deviations are
    enlarged when the pairs disagree by more than theirs."""
    rows = np.flatnonzero(map.keyframes.column("alive"))
    poses, submaps = map.keyframes.column("T_world_camera"), map.keyframes.column("submap")
    views = {int(row): _measured_points(map, int(row)) for row in rows}
    found = []
    for i, row in enumerate(rows):
        motions = {int(k): invert(poses[k]) @ poses[row] for k in rows[i + 1 : i + 1 + NEIGHBOURS] if submaps[k] == submaps[row]}
        shared = {k: np.intersect1d(views[int(row)].ids, views[k].ids, assume_unique=True, return_indices=True)[1:] for k in motions}
        partners = [k for k in motions if len(shared[k][0]) >= MIN_POINTS]
        if partners:
            best = max(partners, key=lambda k: rotation_angle_deg(motions[k][:3, :3]))
            found.append(focal_factors(views[int(row)], views[best], *shared[best], motions[best]))
    return _combine(found)


def focal_factors(before: MeasuredPoints, after: MeasuredPoints, rows_before: Rows, rows_after: Rows, T_after_before: F64) -> tuple[F64, F64]:
    """Logarithms (2,) of the factors of fx and fy by Gauss–Newton from an approximate motion (4, 4), and the data's information (2, 2) about them.

    The parameters are (phi, rho, α, β): `R <- Exp(phi) R`, `t <- t + rho`, and the logarithms. The first view's points, divided by the factors, are
    moved and projected into the second; residuals are pixels and depth."""
    fx, fy, cx, cy = before.intrinsics
    z = before.depths_m[rows_before]
    points = np.stack([(before.pixels[rows_before, 0] - cx) / fx * z, (before.pixels[rows_before, 1] - cy) / fy * z, z], axis=1)
    fx, fy, cx, cy = after.intrinsics
    observed = np.column_stack([after.pixels[rows_after] - [cx, cy], after.depths_m[rows_after]])
    variance_px2 = (fx / before.intrinsics[0]) ** 2 * before.variance_px2[rows_before] + after.variance_px2[rows_after]
    variance_m2 = before.variance_m2[rows_before] + after.variance_m2[rows_after]
    information = 1.0 / np.column_stack([variance_px2, variance_px2, variance_m2])
    R, t, logs, H = T_after_before[:3, :3], T_after_before[:3, 3], np.zeros(2), np.zeros((8, 8))
    prior = np.diag([0.0] * 6 + [PRIOR_SIGMA**-2] * 2)
    for _ in range(ITERATIONS):
        r, J = _residuals(points, observed, np.array([fx, fy]), R, t, logs)
        weights = (GATE2 / (GATE2 + (r**2 * information).sum(axis=1))) ** 2
        W = weights[:, None] * information
        H, g = np.einsum("nij,ni,nik->jk", J, W, J), np.einsum("nij,ni,ni->j", J, W, r)
        step = np.linalg.lstsq(H + prior, -g - prior @ np.append(np.zeros(6), logs), rcond=None)[0]
        R, t, logs = exp_so3(step[:3]) @ R, t + step[3:6], logs + step[6:]
    return logs, H[6:, 6:] - H[6:, :6] @ np.linalg.pinv(H[:6, :6]) @ H[:6, 6:]


def _residuals(points: F64, observed: F64, focal: F64, R: F64, t: F64, logs: F64) -> tuple[F64, F64]:
    """Residuals (n, 3) of the projection and depth of the moved points, and their Jacobian (n, 3, 8)."""
    scaled = points * np.append(np.exp(-logs), 1.0)
    rotated = scaled @ R.T
    q = rotated + t
    u = focal * np.exp(logs) * q[:, :2] / q[:, 2:]
    D = np.zeros((len(q), 3, 3))  # derivative by q
    D[:, 0, 0], D[:, 1, 1] = (focal * np.exp(logs) / q[:, 2:]).T
    D[:, :2, 2] = -u / q[:, 2:]
    D[:, 2, 2] = 1.0
    J = np.zeros((len(q), 3, 8))
    J[:, :, :3] = np.cross(rotated[:, None], D)  # aᵀ (phi × q) = phiᵀ (q × a)
    J[:, :, 3:6] = D
    J[:, :, 6:] = -D @ (R[:, :2] * scaled[:, None, :2])
    J[:, 0, 6] += u[:, 0]
    J[:, 1, 7] += u[:, 1]
    return np.column_stack([u, q[:, 2]]) - observed, J


def _measured_points(map: Map, keyframe: int) -> MeasuredPoints:
    """The points that a keyframe measured with depth."""
    first, end = map.keyframes.row("points", keyframe)
    rows = np.arange(first, end)
    ids, pixels, depths, sigma_px, sigma_m = map.point_observations.gathered(rows, "point", "pixel", "depth_m", "sigma_px", "sigma_m")
    ids, chosen = np.unique(np.where(np.isfinite(depths), ids, -1), return_index=True)
    ids, chosen = ids[ids >= 0], chosen[ids >= 0]
    pixels, depths, variance_px2, variance_m2 = (np.asarray(column[chosen], np.float64) for column in (pixels, depths, sigma_px**2, sigma_m**2))
    return MeasuredPoints(ids, pixels, depths, variance_px2, variance_m2, np.array(map.keyframes.row("intrinsics", keyframe), np.float64))


def _combine(found: list[tuple[F64, F64]]) -> FocalLengths:
    """Robust weighted mean of the pairs' logarithms."""
    if not found:
        return FocalLengths(np.full(2, np.nan), np.full(2, np.inf), 0)
    logs, information = np.array([one for one, _ in found]), np.array([one for _, one in found])
    weights, mean, total = np.ones(len(found)), np.zeros(2), np.zeros((2, 2))
    distance2 = np.zeros(len(found))
    prior = np.eye(2) / PRIOR_SIGMA**2
    for _ in range(ROUNDS):
        total = np.einsum("n,nij->ij", weights, information)
        mean = np.linalg.solve(total + prior, np.einsum("n,nij,nj->i", weights, information, logs))
        distance2 = np.einsum("ni,nij,nj->n", logs - mean, information, logs - mean) / 2.0
        weights = np.minimum(1.0, HUBER / np.sqrt(np.maximum(distance2, 1e-12)))
    spread = max(float((weights * distance2).sum()) / max(len(found) - 1, 1), 1.0)
    return FocalLengths(np.exp(mean), np.sqrt(spread * np.diag(np.linalg.inv(total + prior))), len(found))
