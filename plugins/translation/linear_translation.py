"""Translation from tracked points with a known rotation for `irls` and `kalman`: the de-rotated reprojection error, which is linear in it.

With the previous point rotated into the current camera's axes, q = R_current_previous p, and the unknown translation s in `p_current = q + s`, a
point observed at (x, y) on the image plane gives `(1, 0, -x)·s = x q_z - q_x` and `(0, 1, -y)·s = y q_z - q_y`; one without depth, of which only the
rays b and b' are known, gives `(b × b')·s = 0` (Zhang, Kaess, Singh, IROS 2014; Kim, Coltin, Kim, ICRA 2018). That residual is normalised by |s|:
noise would bias s towards zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import eigh, inv, matmul
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Tracks
from trihedron.plugins.translation.linear_translation_kernels import iterate_translation


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
    s, H, inliers = iterate_translation(*equations, start, prior_m)
    values, vectors = eigh(H)
    unobservable = vectors[:, values < (2.0 / prior_m) ** 2].T
    return LinearTranslation(s, np.asarray(inv(H + np.eye(3) / prior_m**2), np.float64), inliers, unobservable)
