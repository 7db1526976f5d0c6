"""Kernels of `world_uncertainty.py`: the scatter of residuals by the keyframes that their landmarks are from, and the common error of these."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, inverse_positive, matmul, split_pose, sum_matrices
from trihedron.pipeline.core.types import F64
from trihedron.plugins.shared.lie_kernels import adjoint_between
from trihedron.plugins.shared.pose_optimizer_kernels import Flags, Groups, add_scores
from trihedron.plugins.shared.residuals_kernels import LineTerms, PlaneTerms, PointTerms

LEAST_FREEDOM = 1.0  # degrees of freedom with which the scale of the residuals can be estimated


@kernel
def scatter_and_drift(
    T: F64, camera: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, flags: Flags, created: Groups, poses: F64, covariances: F64
) -> tuple[float, F64, bool]:
    """Return `residual_scale` and `covariance_of_keyframes` at a pose T (4, 4), by the terms that are not outliers, each of the keyframe that created
    its landmark, with poses (k, 4, 4) and covariances (k, 6, 6); and whether there are any such terms."""
    information, scores, some = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6)), False
    R, t = split_pose(T)
    add_scores(R, t, camera, points, lines, planes, flags, created, information, scores)
    for k in range(len(poses)):
        for a in range(6):
            for b in range(a + 1):
                some = some or information[k, a, b] != 0.0
                information[k, b, a] = information[k, a, b]
    return residual_scale(information, scores), covariance_of_keyframes(T, poses, covariances, information), some


@kernel
def residual_scale(information: F64, scores: F64) -> float:
    """Variance of the scores (k, 6) of groups, whose terms may err alike, relative to that stated by their information (k, 6, 6); NaN where they are
    too few to tell.

    With independent errors of the stated covariance the score of group k, less its share of the pose's adjustment, has covariance
    `H_k - H_k H⁻¹ H_k`. The cluster-robust ("sandwich") estimate of the pose's covariance (Liang and Zeger, Biometrika 1986) exceeds `H⁻¹` by this
    factor, averaged over directions."""
    inverse, total = inverse_positive(sum_matrices(information)), np.zeros(6)
    freedom, squared, rest = 6.0, 0.0, np.empty(6)
    for k in range(len(scores)):
        for a in range(6):
            total[a] += scores[k, a]
    for k in range(len(information)):
        share = matmul(information[k], inverse)
        for a in range(6):
            rest[a] = scores[k, a]
            for b in range(6):
                freedom -= share[a, b] * share[b, a]
                rest[a] -= share[a, b] * total[b]
        for a in range(6):
            for b in range(6):
                squared += rest[a] * inverse[a, b] * rest[b]
    return squared / freedom if freedom >= LEAST_FREEDOM and inverse[0, 0] > 0.0 else np.nan


@kernel
def covariance_of_keyframes(T: F64, poses: F64, covariances: F64, information: F64) -> F64:
    """Covariance (6, 6) of the average error of keyframes in the order of time, their poses (k, 4, 4) and covariances (k, 6, 6), each weighted by the
    information (k, 6, 6) of its landmarks, as that of xi of the camera at T (4, 4).

    The errors of keyframes are a random walk, in which the covariance of two is the variance of the earlier."""
    total = sum_matrices(information)
    for a in range(6):
        total[a, a] += 1.0
    inverse, weights, sum_of_weights = inverse_positive(total), np.zeros(len(poses)), 0.0
    for k in range(len(poses)):
        for a in range(6):
            for b in range(6):
                weights[k] += information[k, a, b] * inverse[a, b]
        sum_of_weights += weights[k]
    common, to_camera, later = np.zeros((6, 6)), np.empty((6, 6)), 0.0
    for k in range(len(poses) - 1, -1, -1):
        weights[k] /= sum_of_weights
        if weights[k] > 0.0:
            adjoint_between(T, poses[k], to_camera)
            half, share = matmul(to_camera, covariances[k]), weights[k] * (weights[k] + 2.0 * later)
            for a in range(6):
                for b in range(6):
                    common[a, b] += share * dot(half[a], to_camera[b])
            later += weights[k]
    return common
