"""Residuals and analytic Jacobians of one camera pose against known points, lines and planes (eqs. 2–8), for numba loops.

The pose is `R, t` of `T_world_camera`; derivatives are with respect to `xi = (rho, phi)` in `T_world_camera · Exp(xi)`, so that a camera-frame
point p moves with `dp/drho = -I`, `dp/dphi = [p]×`. `camera` is (fx, fy, cx, cy).

What is called for each term is made part of its caller (`forceinline`): to hand over an array takes numba seven numbers and a count of references,
as long as what is done with it here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, U8, Camera
from trihedron.plugins.shared.pose_optimizer_kernels import INLIER, ROUNDS, Flags, LineTerms, PlaneTerms, PointTerms, solve

PLANE_SLACK = 4.0  # when a direction would be lost with the planes beyond their gate, they are outliers only beyond this × it
Terms = tuple[PointTerms, LineTerms, PlaneTerms]
NO_POINTS = PointTerms(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
NO_LINES = LineTerms(
    np.empty((0, 2, 3)), np.empty((0, 2, 3, 3)), np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2, 3)), np.empty((0, 2, 3, 3))
)  # fmt: skip
NO_PLANES = PlaneTerms(np.empty(0, np.int32), np.empty((0, 4)), np.empty((0, 3, 3)), np.empty((0, 4)), np.empty((0, 3, 3)))


@dataclass(frozen=True)
class PoseSolution:
    """What `solve_pose` found. Covariance and `unobservable` are in xi = (rho, phi), camera frame: (6, 6) and columns of (6, u); with the
    rotation fixed (3, 3) and (3, u) of rho alone. Flags are OUTLIER, INLIER or NO_DEPTH (a line whose image part alone fits)."""

    T_world_camera: F64
    covariance: F64
    unobservable: F64
    points: U8
    lines: U8
    planes: U8
    cost: float


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
    """Minimise the robust sum of all terms plus the prior, from `T_world_camera` (4, 4), in four rounds with a new choice of outliers after each.

    `prior_information` (6, 6), positive definite, is that of xi in `T = T_prior · (R_prior-frame translation, rotation)`. With `fixed_rotation`
    only the three unknowns of the position are solved (eqs. 2–7). Nothing raises: without terms the prior's mean is returned. A plane
    beyond its gate is kept, with a Huber weight, where nothing else sees a direction: a bare room has few walls, and 5 % is too many to lose."""
    terms = points, lines, planes
    found = _solved(T_world_camera, camera, T_prior, prior_information, terms, fixed_rotation, 1.0)
    if found.unobservable.shape[1] and not found.planes.all():
        return _solved(T_world_camera, camera, T_prior, prior_information, terms, fixed_rotation, PLANE_SLACK)
    return found


def _solved(
    T_world_camera: F64,
    camera: Camera,
    T_prior: F64,
    prior_information: F64,
    terms: Terms,
    fixed_rotation: bool,
    slack: float,
) -> PoseSolution:
    """`solve_pose` with the planes' gates multiplied by `slack`."""
    free, flags = 3 if fixed_rotation else 6, _all_inliers(terms)
    prior = np.array(prior_information, np.float64)
    T, covariance, data, _, cost, complete = solve(np.array([T_world_camera, T_prior]), prior, camera.intrinsics, *terms, flags, free, ROUNDS, slack)
    unobservable = np.empty((free, 0)) if complete else _unobservable(data, prior[:free, :free])
    return PoseSolution(T, covariance, unobservable, *flags, cost)


def first_step(
    T_world_camera: F64, camera: Camera, T_prior: F64, prior_information: F64, terms: Terms, flags: Flags | None = None
) -> tuple[F64, F64]:
    """Where `solve_pose` would go at first from `T_world_camera`, by the terms not flagged OUTLIER, with Huber's cost: xi (6,), and its
    covariance (6, 6). Changes the flags."""
    poses, flags = np.array([T_world_camera, T_prior]), _all_inliers(terms) if flags is None else flags
    _, covariance, _, xi, _, _ = solve(poses, np.array(prior_information, np.float64), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return xi, covariance


def _all_inliers(terms: Terms) -> Flags:
    points, lines, planes = terms
    return Flags(*(np.full(count, INLIER, np.uint8) for count in (len(points.positions_m), len(lines.endpoints_m), len(planes.kinds))))


def classify_terms(
    T_world_camera: F64, camera: Camera, points: PointTerms = NO_POINTS, lines: LineTerms = NO_LINES, planes: PlaneTerms = NO_PLANES
) -> Flags:
    """OUTLIER, INLIER or NO_DEPTH of every term at a given pose."""
    terms = points, lines, planes
    flags = _all_inliers(terms)
    solve(np.array([T_world_camera, T_world_camera]), np.eye(6), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return flags


def _unobservable(H_data: F64, H_prior: F64) -> F64:
    """(k, u) unit directions in which the data say less than the prior: generalised eigenvalues of (H_data, H_prior) below 1."""
    half = np.linalg.inv(np.linalg.cholesky(H_prior))
    values, vectors = np.linalg.eigh(half @ H_data @ half.T)
    directions = half.T @ vectors[:, values < 1.0]
    return directions / np.linalg.norm(directions, axis=0)
