"""Consistency of poses with their covariances: normalised errors (NEES) against the truth (Bar-Shalom et al., 2001, section 5.4).

The first camera is the world by definition, but the map averages many frames, and its pose relative to the first one is never measured again. So
the truth is aligned to the trajectory by the one rigid motion that the covariances make most likely, and the pose in the map is evaluated.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import adjoint, exp_se3, invert, log_se3
from trihedron.pipeline.core.types import F64

LIMIT_95 = 12.592  # χ² with 6 degrees of freedom
ITERATIONS = 5


@dataclass(frozen=True)
class Consistency:
    """`nees_mean` is 6 for honest covariances, more when they are too small; `share_within_95` is 0.95. `normalised_rms` (6,) is by
    direction: each error over its standard deviation, translation x y z then rotation x y z in the camera frame; 1 is honest."""

    poses: int
    nees_mean: float
    nees_median: float
    share_within_95: float
    normalised_rms: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


def pose_consistency(poses: F64, covariances: F64, true_poses: F64) -> Consistency:
    """Compare (n, 4, 4) poses `T_world_camera` of (n, 6, 6) covariance (of xi as in `types`) with the truth in any world; n at least 2."""
    information = np.asarray(np.linalg.inv(covariances), np.float64)
    errors = _errors(poses, true_poses, _gauge(poses, information, true_poses))
    nees = np.einsum("ni,nij,nj->n", errors, information, errors)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return Consistency(
        poses=len(poses),
        nees_mean=float(nees.mean()),
        nees_median=float(np.median(nees)),
        share_within_95=float((nees <= LIMIT_95).mean()),
        normalised_rms=tuple(np.sqrt(((errors / sigma) ** 2).mean(axis=0)).tolist()),
    )


def _errors(poses: F64, true_poses: F64, T_truth_world: F64) -> F64:
    """Return (n, 6) xi with `T_true = T_truth_world · T · Exp(xi)`."""
    motions = invert(T_truth_world @ poses) @ true_poses
    return np.array([log_se3(motion) for motion in motions])


def _gauge(poses: F64, information: F64, true_poses: F64) -> F64:
    """Return the (4, 4) rigid motion of the world into the truth's that minimises the weighted errors (Gauss–Newton)."""
    T = true_poses[0] @ invert(poses[0])
    J = adjoint(invert(poses))
    H = np.einsum("nji,njk,nkl->il", J, information, J)
    for _ in range(ITERATIONS):
        gradient = np.einsum("nji,njk,nk->i", J, information, _errors(poses, true_poses, T))
        T = T @ exp_se3(np.linalg.solve(H, gradient))
    return np.asarray(T)
