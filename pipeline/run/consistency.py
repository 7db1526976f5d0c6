"""Consistency of poses with their covariances: normalised errors (NEES) against the truth (Bar-Shalom et al., 2001, section 5.4).

The first camera is the world by definition, but the map averages many frames, and its pose relative to the first one is never measured again. So
the truth is aligned to the trajectory by the one rigid motion that the covariances make most likely, and the pose in the map is evaluated.

Ground truth has errors, too. Those that are independent from frame to frame (`TruthNoise`) show between neighbours, where the estimate has hardly
drifted, and are counted in.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import adjoint, exp_se3, log_se3
from trihedron.pipeline.core.linalg import inv, matmul, solve
from trihedron.pipeline.core.types import F64, I32, LOST, Pose

LIMIT_95 = 12.592  # χ² with 6 degrees of freedom
LIMIT_90_3 = 6.251  # χ² with 3 degrees of freedom
ITERATIONS = 5
CONVERGED = 1e-10  # of a step: metres, radians
MEDIAN_3 = 2.366  # median of χ² with 3 degrees of freedom


@dataclass(frozen=True)
class Consistency:
    """For honest covariances `nees_mean` is 6, `nees_median` 5.35 (χ² with 6 degrees of freedom) and `share_within_95` 0.95; NEES is more when they
    are too small. `normalised_rms` (6,) is by direction: each error over its standard deviation, translation x y z then rotation x y z in the camera
    frame; 1 is honest. Of the translation alone, `translation_nees_median` is 2.37 (3 degrees of freedom) and `translation_within_90` 0.90, the
    figures that smfeval prints. `truth_sigma_m` and `truth_sigma_deg` are the truth's own errors that were counted in."""

    poses: int
    nees_mean: float
    nees_median: float
    share_within_95: float
    normalised_rms: tuple[float, ...]
    truth_sigma_m: float = 0.0
    truth_sigma_deg: float = 0.0
    translation_nees_median: float = 0.0
    translation_within_90: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class TruthNoise:
    """Standard deviations, along and about each axis, of errors of the truth that are independent from frame to frame."""

    sigma_m: float = 0.0
    sigma_rad: float = 0.0

    @property
    def covariance(self) -> F64:
        """Covariance (6, 6) of xi."""
        return np.diag(np.repeat([self.sigma_m**2, self.sigma_rad**2], 3))


def judged_poses(poses: Iterable[Pose]) -> list[Pose]:
    """Return the poses whose covariances are judged: tracked, in the first world, as they were estimated at the time, and without the first of them,
    which is exact by definition."""
    return [pose for pose in poses if pose.status != LOST and pose.submap == 0][1:]


def truth_noise(poses: F64, local_covariances: F64, true_poses: F64, indices: I32) -> TruthNoise:
    """Estimate the truth's noise by its motions between neighbouring frames, those whose `indices` (n,) differ least: the median of the squared
    differences from those of the estimate, less what the estimate's own noise (n, 6, 6), relative to the landmarks near it, explains. Errors that
    grow slowly are not noise."""
    apart = np.diff(indices)
    if not len(apart):
        return TruthNoise()
    first = np.flatnonzero(apart == apart.min())
    moved, truly = (matmul(invert(T[first]), T[first + 1]) for T in (poses, true_poses))
    errors = np.array([log_se3(motion) for motion in matmul(invert(moved), truly)])
    variances = np.diagonal(local_covariances, axis1=1, axis2=2)
    sigmas = []
    for part in (slice(0, 3), slice(3, 6)):
        own = float(np.median(variances[first, part].mean(axis=1) + variances[first + 1, part].mean(axis=1)))
        seen = float(np.median((errors[:, part] ** 2).sum(axis=1))) / MEDIAN_3
        sigmas.append(float(np.sqrt(max(0.5 * (seen - own), 0.0))))
    return TruthNoise(*sigmas)


def pose_consistency(poses: F64, covariances: F64, true_poses: F64, noise: TruthNoise | None = None) -> Consistency:
    """Compare (n, 4, 4) poses `T_world_camera` of (n, 6, 6) covariance (of xi as in `types`) with the truth in any world; n at least 2."""
    noise = noise or TruthNoise()
    covariances = covariances + noise.covariance
    errors = gauge_free_errors(poses, covariances, true_poses)
    nees, moved = normalised_squares(errors, covariances), normalised_squares(errors[:, :3], covariances[:, :3, :3])
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return Consistency(
        poses=len(poses),
        nees_mean=float(nees.mean()),
        nees_median=float(np.median(nees)),
        share_within_95=float((nees <= LIMIT_95).mean()),
        normalised_rms=tuple(np.sqrt(((errors / sigma) ** 2).mean(axis=0)).tolist()),
        truth_sigma_m=noise.sigma_m,
        truth_sigma_deg=float(np.degrees(noise.sigma_rad)),
        translation_nees_median=float(np.median(moved)),
        translation_within_90=float((moved <= LIMIT_90_3).mean()),
    )


def normalised_squares(errors: F64, covariances: F64) -> F64:
    """Return (n,) `eᵀ C⁻¹ e` of errors (n, d) with covariances (n, d, d)."""
    return np.asarray(np.einsum("ni,nij,nj->n", errors, inv(covariances), errors))


def gauge_free_errors(poses: F64, covariances: F64, true_poses: F64) -> F64:
    """Return the errors (n, 6), as xi, after the rigid motion between both worlds that the covariances (n, 6, 6) make most likely."""
    information = np.asarray(inv(covariances), np.float64)
    return _errors(poses, true_poses, _gauge(poses, information, true_poses))


def _errors(poses: F64, true_poses: F64, T_truth_world: F64) -> F64:
    """Return (n, 6) xi with `T_true = T_truth_world · T · Exp(xi)`."""
    motions = matmul(invert(matmul(T_truth_world, poses)), true_poses)
    return np.array([log_se3(motion) for motion in motions])


def _gauge(poses: F64, information: F64, true_poses: F64) -> F64:
    """Return the (4, 4) rigid motion of the world into the truth's that minimises the weighted errors (Gauss–Newton)."""
    T = matmul(true_poses[0], invert(poses[0]))
    J = adjoint(invert(poses))
    H = np.einsum("nji,njk,nkl->il", J, information, J)
    for _ in range(ITERATIONS):
        gradient = np.einsum("nji,njk,nk->i", J, information, _errors(poses, true_poses, T))
        step = solve(H, gradient)
        T = matmul(T, exp_se3(step))
        if np.abs(step).max() < CONVERGED:
            break
    return np.asarray(T)
