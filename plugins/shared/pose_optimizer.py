"""Camera pose from points, lines and planes whose positions in the world are known (eqs. 2–8): robust Levenberg–Marquardt with a Gaussian prior.

Every residual is weighted by the inverse of its covariance: that of the measurement *and* of the landmark. The prior (the Manhattan rotation, a weak
prior on the position) holds the directions that the data do not observe. Derivation and numerics are in `pose_optimizer_kernels.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import cholesky, eigh, inv, matmul
from trihedron.pipeline.core.types import F64, U8, Camera
from trihedron.plugins.shared.pose_optimizer_kernels import INLIER, ROUNDS, Flags, solve
from trihedron.plugins.shared.residuals_kernels import LineTerms, PlaneTerms, PointTerms

PLANE_SLACK = 4.0  # multiplies the planes' gates when a direction would become unobservable without the planes beyond them
LANDMARK_SCORE = 1, 2, 5  # weight of a point, a line and a plane where inliers are counted
Terms = tuple[PointTerms, LineTerms, PlaneTerms]
NO_POINTS = PointTerms(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
NO_LINES = LineTerms(
    np.empty((0, 2, 3)), np.empty((0, 2, 3, 3)), np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2, 3)), np.empty((0, 2, 3, 3))
)  # fmt: skip
NO_PLANES = PlaneTerms(np.empty(0, np.int32), np.empty((0, 4)), np.empty((0, 3, 3)), np.empty((0, 4)), np.empty((0, 3, 3)))


@dataclass(frozen=True)
class PoseSolution:
    """Result of `solve_pose`. Covariance (6, 6) and `unobservable`, unit columns (6, u), are in xi = (rho, phi), camera frame; with a fixed rotation
    (3, 3) and (3, u) of rho alone. Flags are OUTLIER, INLIER or NO_DEPTH (a line of which only the image part fits). `disputed` is the number of
    directions that planes beyond their gates alone observe."""

    T_world_camera: F64
    covariance: F64
    unobservable: F64
    points: U8
    lines: U8
    planes: U8
    cost: float
    disputed: int = 0


def solve_pose(
    T_world_camera: F64,
    camera: Camera,
    T_prior: F64,
    prior_information: F64,
    points: PointTerms = NO_POINTS,
    lines: LineTerms = NO_LINES,
    planes: PlaneTerms = NO_PLANES,
    fixed_rotation: bool = False,
) -> PoseSolution:
    """Minimise the robust sum of all terms plus the prior, from `T_world_camera` (4, 4), in four rounds that each classify the outliers anew.

    `prior_information` (6, 6), positive definite, is that of xi in `T = T_prior · (R_prior-frame translation, rotation)`. With `fixed_rotation`
    only the position is estimated (eqs. 2–7). Never raises: without terms the prior's mean is returned. A plane beyond its gate is retained, with a
    Huber weight, where nothing else observes a direction: a bare room has few walls, and rejecting 5 % of them is too much."""
    terms, free = (points, lines, planes), 3 if fixed_rotation else 6
    poses, prior = np.array([T_world_camera, T_prior]), np.array(prior_information, np.float64)
    unobserved = []  # number of directions that nothing observes, without planes beyond their gates and then with them
    for slack in (1.0, PLANE_SLACK):
        flags = _all_inliers(terms)
        T, covariance, data, _, cost, complete = solve(poses, prior, camera.intrinsics, *terms, flags, free, ROUNDS, slack)
        unobservable = np.empty((free, 0)) if complete else _unobservable(data, prior[:free, :free])
        unobserved.append(unobservable.shape[1])
        if not unobservable.shape[1] or flags.planes.all():
            break
    return PoseSolution(T, covariance, unobservable, *flags, cost, max(unobserved[0] - unobserved[-1], 0))


def first_step(
    T_world_camera: F64, camera: Camera, T_prior: F64, prior_information: F64, terms: Terms, flags: Flags | None = None
) -> tuple[F64, F64]:
    """Take the first Gauss–Newton step of `solve_pose` from `T_world_camera` by the terms not flagged OUTLIER, with Huber's cost: xi (6,) and its
    covariance (6, 6). Changes the flags."""
    poses, flags = np.array([T_world_camera, T_prior]), _all_inliers(terms) if flags is None else flags
    _, covariance, _, xi, _, _ = solve(poses, np.array(prior_information, np.float64), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return xi, covariance


def classify_terms(
    T_world_camera: F64, camera: Camera, points: PointTerms = NO_POINTS, lines: LineTerms = NO_LINES, planes: PlaneTerms = NO_PLANES
) -> Flags:
    """Classify every term at a given pose as OUTLIER, INLIER or NO_DEPTH."""
    terms = points, lines, planes
    flags = _all_inliers(terms)
    solve(np.array([T_world_camera, T_world_camera]), np.eye(6), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return flags


def _all_inliers(terms: Terms) -> Flags:
    points, lines, planes = terms
    return Flags(*(np.full(count, INLIER, np.uint8) for count in (len(points.positions_m), len(lines.endpoints_m), len(planes.kinds))))


def _unobservable(H_data: F64, H_prior: F64) -> F64:
    """Unit directions (k, u) in which the data have less information than the prior: generalised eigenvalues of (H_data, H_prior) below 1."""
    half = inv(cholesky(H_prior))
    values, vectors = eigh(matmul(half, H_data, half.T))
    directions = matmul(half.T, vectors[:, values < 1.0])
    return np.asarray(directions / np.linalg.norm(directions, axis=0))
