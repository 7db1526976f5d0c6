"""Camera pose from points, lines and planes whose place in the world is known (eqs. 2–8): robust Levenberg–Marquardt with a Gaussian prior.

Every term is weighed by covariances: of the measurement *and* of the landmark. The prior (the Manhattan rotation, a weak one on the position)
keeps what the data cannot see at its prediction, so that any set of terms, even one plane, can be solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.types import F64, U8, Camera
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.motion.pose_kernel import (
    CHI2_2,
    CHI2_3,
    INLIER,
    NO_DEPTH,
    OUTLIER,
    Chi2,
    Flags,
    gate,
    linearise,
)
from trihedron.plugins.numerics.motion.pose_noise import Weights, rows_of, weigh
from trihedron.plugins.numerics.motion.pose_step import add_prior, moved, size, step
from trihedron.plugins.numerics.motion.pose_terms import LineTerms, PlaneTerms, PointTerms

ROUNDS, ITERATIONS, ROBUST_ROUNDS = 4, 10, 2  # as ORB-SLAM2 optimises a pose; Huber only in the first rounds
CONVERGED = 1e-3  # squared length of a step in standard deviations below which a round has converged
MAX_DAMPING = 1e10
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
    free = 3 if fixed_rotation else 6
    points, lines, planes = terms
    flags = _all_inliers(terms)
    R, t, H_data, cost = _solve(
        T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy(), T_prior[:3, :3].copy(), T_prior[:3, 3].copy(),
        np.ascontiguousarray(prior_information, np.float64), camera.intrinsics, points, lines, planes, flags, free, slack,
    )  # fmt: skip
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    prior = np.ascontiguousarray(prior_information[:free, :free])
    data = _gate_efficiency(_rows(points, planes, flags), free) * _symmetric(H_data)[:free, :free]
    return PoseSolution(T, _inverse(data + prior), _unobservable(data, prior), *flags, cost)


def first_step(T_world_camera: F64, camera: Camera, T_prior: F64, prior_information: F64, terms: Terms) -> tuple[F64, F64]:
    """Where `solve_pose` would go at first from `T_world_camera`, all terms with Huber's cost: xi (6,), and its covariance (6, 6)."""
    flags, weights, chi2 = _rooms(terms)
    R, t = T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy()
    intrinsics, H, g = camera.intrinsics, np.empty((6, 6)), np.empty(6)
    weigh(R, t, intrinsics, *terms, weights)
    linearise(R, t, intrinsics, *terms, weights, flags, True, H, g, chi2)
    add_prior(R, t, T_prior[:3, :3].copy(), T_prior[:3, 3].copy(), np.ascontiguousarray(prior_information, np.float64), H, g)
    covariance = _inverse(_symmetric(H))
    return -covariance @ g, covariance


def _all_inliers(terms: Terms) -> Flags:
    points, lines, planes = terms
    return Flags(*(np.full(count, INLIER, np.uint8) for count in (len(points.positions_m), len(lines.endpoints_m), len(planes.kinds))))


def _rooms(terms: Terms) -> tuple[Flags, Weights, Chi2]:
    """Room for what is said of each term: all inliers, weights, χ²."""
    flags = _all_inliers(terms)
    n, m, p = (len(kind) for kind in flags)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    return flags, weights, Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(p))


def classify_terms(
    T_world_camera: F64, camera: Camera, points: PointTerms = NO_POINTS, lines: LineTerms = NO_LINES, planes: PlaneTerms = NO_PLANES
) -> Flags:
    """OUTLIER, INLIER or NO_DEPTH of every term at a given pose."""
    flags, weights, chi2 = _rooms((points, lines, planes))
    R, t = T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy()
    intrinsics = camera.intrinsics
    weigh(R, t, intrinsics, points, lines, planes, weights)
    linearise(R, t, intrinsics, points, lines, planes, weights, flags, False, np.empty((6, 6)), np.empty(6), chi2)
    _classify(points, planes, chi2, flags, 1.0)
    return flags


def _rows(points: PointTerms, planes: PlaneTerms, flags: Flags) -> int:
    """Number of residuals of the inliers."""
    with_depth = np.isfinite(points.depth_m)
    rows = np.array([3, 2, 1])[planes.kinds]
    of_points = 2 * flags.points.sum() + flags.points[with_depth].sum()
    of_lines = 4 * (flags.lines == INLIER).sum() + 2 * (flags.lines == NO_DEPTH).sum()
    return int(of_points + of_lines + rows @ flags.planes)


def _gate_efficiency(rows: int, unknowns: int) -> float:
    """Share of the information that is left when terms are chosen by a hard 95 % gate on their own residuals.

    A mean of samples cut at the gate c varies by 1 / F_{k+2}(c), F_k being the distribution of χ², where counting the F_k(c) kept samples promises
    1 / F_k(c); with few redundant rows the residuals are smaller than the noise and the gate bites less. The tests check the normalised error."""
    if rows <= unknowns:
        return 1.0
    half = 0.5 * CHI2_3 / (1.0 - unknowns / rows)
    tail = math.sqrt(half / math.pi) * math.exp(-half)
    kept = math.erf(math.sqrt(half)) - 2.0 * tail  # F_3, the incomplete gamma function of 3/2; that of 5/2 follows by its recurrence
    return (kept - 4.0 / 3.0 * half * tail) / kept


def _symmetric(lower: F64) -> F64:
    """The whole of a matrix of which `linearise` fills the lower half."""
    return np.tril(lower) + np.tril(lower, -1).T


def _inverse(H: F64) -> F64:
    full = inverse(H)
    return 0.5 * (full + full.T)


def _unobservable(H_data: F64, H_prior: F64) -> F64:
    """(k, u) unit directions in which the data say less than the prior: generalised eigenvalues of (H_data, H_prior) below 1."""
    half = np.linalg.inv(np.linalg.cholesky(H_prior))
    values, vectors = np.linalg.eigh(half @ H_data @ half.T)
    directions = half.T @ vectors[:, values < 1.0]
    return directions / np.linalg.norm(directions, axis=0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(
    R: F64,
    t: F64,
    R_prior: F64,
    t_prior: F64,
    prior: F64,
    camera: F64,
    points: PointTerms,
    lines: LineTerms,
    planes: PlaneTerms,
    flags: Flags,
    free: int,
    slack: float,
) -> tuple[F64, F64, F64, float]:
    """The rounds; changes `flags`. Returns R, t, the data's information (6, 6) at the solution and the cost.

    Every evaluation is the one call of `linearise`, and a step too short to matter is taken without another. The last turn takes no step and is only
    the information of the final inliers."""
    n, m, p = len(points.positions_m), len(lines.endpoints_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    chi2 = Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(p))
    H, g, dx = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    data, trial_H, trial_g = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    cost = 0.0
    for turn in range(ROUNDS + 1):
        cost, damping = np.inf, 1e-6
        R_new, t_new = R, t
        weigh(R, t, camera, points, lines, planes, weights)
        for trial in range(ITERATIONS + 1):
            new = linearise(R_new, t_new, camera, points, lines, planes, weights, flags, turn < ROBUST_ROUNDS, trial_H, trial_g, chi2)
            data[:] = trial_H
            new += add_prior(R_new, t_new, R_prior, t_prior, prior, trial_H, trial_g)
            accepted = trial == 0 or new <= cost
            if accepted:
                R, t, cost = R_new, t_new, new
                H[:], g[:] = trial_H, trial_g
                damping = max(0.1 * damping, 1e-9)
            else:
                damping = max(10.0 * damping, 1e-3)
            if turn == ROUNDS or damping > MAX_DAMPING:
                break
            step(H, g, damping, free, dx)
            R_new, t_new = moved(R, t, dx)
            length = size(H, dx)
            if not length > CONVERGED:
                if accepted and length >= 0.0:
                    R, t = R_new, t_new
                break
        if turn < ROUNDS:
            _classify(points, planes, chi2, flags, slack)
    return R, t, data, cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _classify(points: PointTerms, planes: PlaneTerms, chi2: Chi2, flags: Flags, slack: float) -> None:
    """Choose the outliers anew: 95 % gates of χ², those of planes multiplied by `slack`."""
    for i in range(len(chi2.points)):
        limit = CHI2_3 if np.isfinite(points.depth_m[i]) else CHI2_2
        flags.points[i] = INLIER if chi2.points[i] <= limit else OUTLIER
    for i in range(len(chi2.lines)):
        flags.lines[i] = OUTLIER
        if chi2.lines[i] <= CHI2_2:
            flags.lines[i] = INLIER if chi2.line_depths[i] <= CHI2_2 else NO_DEPTH
    for i in range(len(chi2.planes)):
        flags.planes[i] = INLIER if chi2.planes[i] <= slack * gate(rows_of(planes.kinds[i])) else OUTLIER
