"""Translation from tracked points with a known rotation for `irls` and `kalman`: the de-rotated reprojection error, which is linear in it.

With the previous point rotated into the current camera's axes, q = R_current_previous p, and the unknown translation s in `p_current = q + s`, a
point observed at (x, y) on the image plane gives `(1, 0, -x)·s = x q_z - q_x` and `(0, 1, -y)·s = y q_z - q_y`; one without depth, of which only the
rays b and b' are known, gives `(b × b')·s = 0` (Zhang, Kaess, Singh, IROS 2014; Kim, Coltin, Kim, ICRA 2018). That residual is normalised by |s|:
noise would bias s towards zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import eigh, inv, matmul, norm, solve
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Tracks

ITERATIONS = 15
CAUCHY = 2.385  # 95 % efficiency where the noise is Gaussian
GATE = 3.0  # standard deviations, beyond which a point is an outlier
FLOOR_M = 0.01  # least |s| in the noise of points without depth, which is proportional to it
SIGMAS = 0.849  # standard deviation in each of two directions, where the median length is 1
ALONE = 4  # first iterations, by points with depth alone: at s = 0 the others agree with everything


class PointEquations(NamedTuple):
    """Linear equations `A s = b` of n points, two rows each (the second of a point without depth is zero)."""

    A: F64  # (n, 2, 3); b × b' in the first row of a point without depth
    b: F64  # (n, 2)
    z: F64  # (n,) depth of q, NaN without
    sigma: F64  # (n,) on the image plane at depth 1


@dataclass(frozen=True)
class LinearTranslation:
    """Translation `s` (3,) in the current camera frame with covariance (3, 3), the number of inliers, and unobservable unit vectors (u, 3)."""

    s: F64
    covariance: F64
    inliers: int
    unobservable: F64


def point_equations(
    tracks: Tracks, now: Keypoints, before: Keypoints, camera: Camera, R_current_previous: F64, rotation_covariance: F64, depthless: bool
) -> PointEquations:
    """Equations of the tracked points, those without depth where `depthless`.

    The rotation's error, of covariance `rotation_covariance` (3, 3), is common to all of the latter, so its variance is multiplied by their number:
    together they determine the direction no better than it."""
    i, j = tracks.keypoints.T
    x = camera.back_project(now.pixels[j].astype(np.float64), np.ones(len(j)))
    far = matmul(camera.back_project(before.pixels[i].astype(np.float64), np.ones(len(i))), R_current_previous.T)
    q = matmul(tracks.points_m.astype(np.float64), R_current_previous.T)
    known = np.isfinite(q).all(axis=1)
    A, b = np.zeros((len(j), 2, 3)), np.zeros((len(j), 2))
    A[:, 0, 0] = A[:, 1, 1] = 1.0
    A[:, :, 2] = -x[:, :2]
    b[:] = x[:, :2] * q[:, 2:] - q[:, :2]
    A[~known], b[~known] = 0.0, 0.0
    A[~known, 0] = np.cross(far[~known], x[~known])
    sigma = np.hypot(now.sigma_px[j], before.sigma_px[i]).astype(np.float64) / camera.fx
    sigma[~known] = np.sqrt(sigma[~known] ** 2 + np.count_nonzero(~known) * np.trace(rotation_covariance) / 3.0)
    used = (known & (q[:, 2] > 0.1)) | (~known & depthless)
    return PointEquations(A[used], b[used], np.where(known, q[:, 2], np.nan)[used], sigma[used])


def solve_translation(equations: PointEquations, start: F64, prior_m: float) -> LinearTranslation:
    """Iteratively reweighted least squares with Cauchy's weights at the scale of the median residual, from `start`.

    `prior_m` is the standard deviation of the translation about `start`; a direction whose σ is above half of that is unobservable."""
    s, prior = start.copy(), np.eye(3) / prior_m**2
    H, normalised = np.zeros((3, 3)), np.empty((0, 2))
    with_depth = np.isfinite(equations.z)
    for iteration in range(ITERATIONS if len(equations.z) else 0):
        A, b = _linearise(equations, s)
        reach = np.where(with_depth, np.maximum(equations.z + s[2], 0.1), norm(s) + FLOOR_M)
        noise = reach * equations.sigma
        normalised = (np.einsum("nij,j->ni", A, s) - b) / noise[:, None]
        size = np.linalg.norm(normalised, axis=1)
        scale = max(SIGMAS * float(np.median(size[with_depth])) if with_depth.any() else 1.0, 0.3)
        w = 1.0 / (1.0 + (size / (CAUCHY * scale)) ** 2) / (noise * scale) ** 2
        if iteration < ALONE and with_depth.any():
            w = np.where(with_depth, w, 0.0)
        H = np.einsum("n,nij,nik->jk", w, A, A)
        g = np.einsum("n,nij,ni->j", w, A, b)
        step = solve(H + prior, g + matmul(prior, start)) - s
        s = s + step
        normalised = normalised / scale
        if matmul(step, step) < 1e-14 and iteration >= ALONE:
            break
    values, vectors = eigh(H)
    inliers = int(np.count_nonzero(np.linalg.norm(normalised, axis=1) < GATE))
    return LinearTranslation(s, np.asarray(inv(H + prior), np.float64), inliers, vectors[:, values < (2.0 / prior_m) ** 2].T)


def _linearise(equations: PointEquations, s: F64) -> tuple[F64, F64]:
    """The equations with those of points without depth as `(b × b')·s / |s| = 0`, linearised about s, times |s|."""
    size = max(float(norm(s)), 1e-9)
    along = s / size
    A, b = equations.A.copy(), equations.b.copy()
    far = np.isnan(equations.z)
    off = matmul(equations.A[far, 0], along)
    A[far, 0] -= off[:, None] * along
    b[far, 0] = -size * off
    return A, b
