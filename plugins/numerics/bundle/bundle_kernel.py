"""The numba loops of bundle adjustment: normal equations of all observations, points and lines kept apart from poses and planes."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F64
from trihedron.plugins.numerics.bundle.bundle_problem import BundleMeasurements, BundleState
from trihedron.plugins.numerics.bundle.bundle_terms import by_plane, line_depth_term, line_term, point_term, relation_rows, share_opposite
from trihedron.plugins.numerics.motion.pose_kernel import BEHIND, CHI2_1, CHI2_2, CHI2_3
from trihedron.plugins.numerics.motion.pose_terms import NEAR_M, PARALLEL, SAME, basis, depth_direction, plane_rows

SQUARES, HUBER, TRUNCATED = 0, 1, 2


class NormalEquations(NamedTuple):
    """`[H W; Wᵀ V] dx = -[g; b]`: H (lower triangle) and g over the free poses (6 each) and the planes (3 each); a 4 × 4 block V for each
    point (padded) and line, and a block of W for each of their observations, points first. Blocks of held keyframes are not used."""

    H: F64  # (c, c)
    g: F64  # (c,)
    V: F64  # (l, 4, 4)
    b: F64  # (l, 4)
    W: F64  # (o, 6, 4)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _loss(chi2: float, limit: float, loss: int) -> tuple[float, float]:
    """Weight and cost of a term whose χ² may lie beyond the limit."""
    if loss == SQUARES or chi2 <= limit:
        return 1.0, chi2
    if loss == HUBER:
        return np.sqrt(limit / chi2), 2.0 * np.sqrt(limit * chi2) - limit
    return 0.0, limit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_row(r: float, w: float, Jc: F64, Jl: F64, size: int, pose: int, H: F64, g: F64, V: F64, b: F64, W: F64) -> None:
    """Add one residual of weight w; `pose` is where its keyframe's unknowns begin, negative for a held one; `size` unknowns of the landmark."""
    for i in range(size):
        b[i] += w * Jl[i] * r
        for j in range(i + 1):
            V[i, j] += w * Jl[i] * Jl[j]
    if pose < 0:
        return
    for i in range(6):
        wj = w * Jc[i]
        g[pose + i] += wj * r
        for j in range(i + 1):
            H[pose + i, pose + j] += wj * Jc[j]
        for j in range(size):
            W[i, j] += wj * Jl[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_points(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations) -> float:
    cost = 0.0
    r, w, p, D = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    Jc, Jl = np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(state.points)):
        for o in range(seen.point_starts[i], seen.point_starts[i + 1]):
            k = seen.point_keyframes[o]
            z = seen.depth_m[o]
            deep = np.isfinite(z)
            if not point_term(state.rotations[k], state.positions[k], state.points[i], seen.pixels[o], z, seen.intrinsics[k], r, Jc, Jl, D, p):
                cost += BEHIND
                continue
            w[0] = 1.0 / seen.sigma_px[o] ** 2
            w[1] = w[0]
            w[2] = (z * z / seen.sigma_m[o]) ** 2 if deep else 0.0
            chi2 = w[0] * r[0] * r[0] + w[1] * r[1] * r[1] + w[2] * r[2] * r[2]
            weight, share = _loss(chi2, CHI2_3 if deep else CHI2_2, loss)
            cost += share
            pose = 6 * k if k < seen.free else -1
            for a in range(3 if deep else 2):
                _add_row(r[a], weight * w[a], Jc[a], Jl[a], 3, pose, out.H, out.g, out.V[i], out.b[i], out.W[o])
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_lines(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations) -> float:
    """Both ends of each observed segment against the points of the line opposite to them, in the image and, where the segment has a 3D line, in
    depth."""
    cost, points, observations = 0.0, len(state.points), len(seen.point_keyframes)
    N, D, m, p = np.empty((3, 2)), np.empty((1, 3)), np.empty(3), np.empty((2, 3))
    r, w, q, v, Jc, Jl = np.empty(2), np.empty(2), np.empty(2), np.empty(2), np.empty((4, 6)), np.empty((4, 4))
    for i in range(len(state.lines)):
        line = state.lines[i]
        line_basis(line, N)
        for o in range(seen.line_starts[i], seen.line_starts[i + 1]):
            k = seen.line_keyframes[o]
            R, t, camera = state.rotations[k], state.positions[k], seen.intrinsics[k]
            deep = depth_direction(seen.observed_m[o], m)
            for a in range(2):
                share = share_opposite(R, t, line, seen.endpoints_px[o, a], camera)
                r[a], s = line_term(R, t, line, N, share, seen.endpoints_px[o], camera, Jc[a], Jl[a], D, p[a])
                w[a] = 1.0 / (seen.line_sigma_px**2 * ((1.0 - s) ** 2 + s * s))
                if deep:
                    q[a], s = line_depth_term(R, N, share, seen.observed_m[o], m, Jc[2 + a], Jl[2 + a], D, p[a])
                    v[a] = 1.0 / _end_variance(s, m, seen.observed_covariance_m2[o])
            if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
                cost += BEHIND
                continue
            weight, share = _loss(w[0] * r[0] ** 2 + w[1] * r[1] ** 2, CHI2_2, loss)
            cost += share
            pose, at, x = 6 * k if k < seen.free else -1, points + i, observations + o
            for a in range(2):
                _add_row(r[a], weight * w[a], Jc[a], Jl[a], 4, pose, out.H, out.g, out.V[at], out.b[at], out.W[x])
            if deep:
                weight, share = _loss(v[0] * q[0] ** 2 + v[1] * q[1] ** 2, CHI2_2, loss)
                cost += share
                for a in range(2):
                    _add_row(q[a], weight * v[a], Jc[2 + a], Jl[2 + a], 4, pose, out.H, out.g, out.V[at], out.b[at], out.W[x])
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_basis(line: F64, N: F64) -> None:
    """N (3, 2): two directions across a line (2, 3)."""
    n = np.empty(3)
    size = 0.0
    for j in range(3):
        n[j] = line[1, j] - line[0, j]
        size += n[j] * n[j]
    n /= max(np.sqrt(size), 1e-12)
    basis(n, N)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _end_variance(s: float, m: F64, covariance: F64) -> float:
    """Variance along m at the place s of an observed 3D segment whose ends have the covariances (2, 3, 3)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += m[i] * m[j] * ((1.0 - s) ** 2 * covariance[0, i, j] + s * s * covariance[1, i, j])
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_dense(r: F64, rows: int, L: F64, A: F64, a: int, size: int, B: F64, b: int, weight: float, H: F64, g: F64) -> None:
    """Add `weight · rᵀ L r` with derivatives A (rows, size) by the unknowns from a on and B (rows, 3) by those from b on, a < b or negative."""
    for i in range(rows):
        for j in range(rows):
            w = weight * L[i, j]
            for x in range(3):
                g[b + x] += w * B[i, x] * r[j]
                for y in range(x + 1):
                    H[b + x, b + y] += w * B[i, x] * B[j, y]
            if a >= 0:
                for x in range(size):
                    g[a + x] += w * A[i, x] * r[j]
                    for y in range(x + 1):
                        H[a + x, a + y] += w * A[i, x] * A[j, y]
                    for y in range(3):
                        H[b + y, a + x] += w * A[i, x] * B[j, y]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_planes(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations) -> float:
    cost, first = 0.0, 6 * seen.free
    r, B, Jc, Jp = np.empty(3), np.empty((3, 2)), np.empty((3, 6)), np.empty((3, 3))
    for o in range(len(seen.plane_keyframes)):
        k, i = seen.plane_keyframes[o], seen.plane_rows[o]
        basis(seen.observed_planes[o, :3], B)
        plane_rows(SAME, state.rotations[k], state.positions[k], state.planes[i], seen.observed_planes[o], B, r, Jc)
        by_plane(state.rotations[k], state.positions[k], state.planes[i], B, Jp)
        L, chi2 = seen.plane_information[o], 0.0
        for a in range(3):
            for b in range(3):
                chi2 += r[a] * L[a, b] * r[b]
        weight, share = _loss(chi2, CHI2_3, min(loss, HUBER))
        cost += share
        _add_dense(r, 3, L, Jc, 6 * k if k < seen.free else -1, 6, Jp, first + 3 * i, weight, out.H, out.g)
    L, Ja, Jb = np.eye(3), np.empty((2, 3)), np.empty((2, 3))
    for o in range(len(seen.relations)):
        kind, a, b = seen.relations[o]
        basis(state.planes[b], B)
        rows = relation_rows(kind, state.planes[a], state.planes[b], B, r, Ja, Jb)
        chi2 = (r[0] * r[0] + (r[1] * r[1] if rows == 2 else 0.0)) / seen.relation_variance[o]
        weight, share = _loss(chi2, CHI2_2 if kind == PARALLEL else CHI2_1, min(loss, HUBER))
        cost += share
        _add_dense(r, rows, L, Ja, first + 3 * a, 3, Jb, first + 3 * b, weight / seen.relation_variance[o], out.H, out.g)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linearise_bundle(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations) -> float:
    """Fill the normal equations at a state; returns the cost under a loss: SQUARES, HUBER beyond the 95 % gate of each term, or TRUNCATED there (for
    planes and their relations HUBER still: they are few, and 5 % would be too many to lose)."""
    out.H[:], out.g[:], out.V[:], out.b[:], out.W[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    cost = _add_points(state, seen, loss, out)
    cost += _add_lines(state, seen, loss, out)
    return cost + _add_planes(state, seen, loss, out)
