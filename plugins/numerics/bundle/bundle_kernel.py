"""The numba loops of bundle adjustment: normal equations of all observations, points and lines kept apart from poses and planes."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.bundle.bundle_problem import BundleMeasurements, BundleState
from trihedron.plugins.numerics.bundle.bundle_terms import by_plane, line_depth_term, line_term, relation_rows, share_opposite
from trihedron.plugins.numerics.motion.pose_kernel import BEHIND, CHI2_1, CHI2_2, CHI2_3
from trihedron.plugins.numerics.motion.pose_terms import NEAR_M, PARALLEL, SAME, basis, depth_direction, plane_rows

SQUARES, HUBER, TRUNCATED = 0, 1, 2


class NormalEquations(NamedTuple):
    """`[H W; Wᵀ V] dx = -[g; b]`: H (lower triangle) and g over the free poses (6 each) and the planes (3 each); a 4 × 4 block V for each
    point (padded) and line, and a block of W for each of their observations, points first. Blocks of held keyframes are not used.

    A point that was measured once goes wherever its keyframe goes and says nothing of the pose: its term is not in H and g, nor does the Schur
    complement take it from them."""

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
def _clear(W: F64) -> None:
    """A block (6, 4) of W that nothing is known of."""
    for i in range(6):
        for j in range(4):
            W[i, j] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_points(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool) -> float:
    """All points: `point_rows` and its derivatives in scalars, since they are most of the work.

    With D = dr/dp, A = DᵀWD and P = [p]×, those by the pose are (-D, DP) and that by the point is DRᵀ."""
    cost, H, g, V, W = 0.0, out.H, out.g, out.V, out.W
    E, B = np.empty((6, 3)), np.empty(3)
    for i in range(len(state.points)):
        for o in range(seen.point_starts[i], seen.point_starts[i + 1]):
            k, z = seen.point_keyframes[o], seen.depth_m[o]
            R, deep = state.rotations[k], np.isfinite(z)
            x, y = state.points[i, 0] - state.positions[k, 0], state.points[i, 1] - state.positions[k, 1]
            d = state.points[i, 2] - state.positions[k, 2]
            p0, p1, p2 = R[0, 0] * x + R[1, 0] * y + R[2, 0] * d, R[0, 1] * x + R[1, 1] * y + R[2, 1] * d, R[0, 2] * x + R[1, 2] * y + R[2, 2] * d
            if not p2 > NEAR_M:
                cost += BEHIND
                _clear(out.W[o])
                continue
            iz = 1.0 / p2
            d00, d11, d22 = seen.intrinsics[k, 0] * iz, seen.intrinsics[k, 1] * iz, -iz * iz if deep else 0.0
            d02, d12 = -d00 * p0 * iz, -d11 * p1 * iz
            r0 = d00 * p0 + seen.intrinsics[k, 2] - seen.pixels[o, 0]
            r1 = d11 * p1 + seen.intrinsics[k, 3] - seen.pixels[o, 1]
            r2 = iz - 1.0 / z if deep else 0.0
            w, v = 1.0 / seen.sigma_px[o] ** 2, (z * z / seen.sigma_m[o]) ** 2 if deep else 0.0
            weight, share = _loss(w * (r0 * r0 + r1 * r1) + v * r2 * r2, CHI2_3 if deep else CHI2_2, loss)
            cost += share
            if not filled:
                continue
            w, v = w * weight, v * weight
            a00, a02, a11, a12 = w * d00 * d00, w * d00 * d02, w * d11 * d11, w * d11 * d12
            a22 = w * (d02 * d02 + d12 * d12) + v * d22 * d22
            b0, b1, b2 = w * d00 * r0, w * d11 * r1, w * (d02 * r0 + d12 * r1) + v * d22 * r2
            for j in range(3):  # rows of A Rᵀ and of P A Rᵀ, and R b
                e0 = a00 * R[j, 0] + a02 * R[j, 2]
                e1 = a11 * R[j, 1] + a12 * R[j, 2]
                e2 = a02 * R[j, 0] + a12 * R[j, 1] + a22 * R[j, 2]
                E[0, j], E[1, j], E[2, j] = e0, e1, e2
                E[3, j], E[4, j], E[5, j] = p1 * e2 - p2 * e1, p2 * e0 - p0 * e2, p0 * e1 - p1 * e0
                B[j] = R[j, 0] * b0 + R[j, 1] * b1 + R[j, 2] * b2
            for j in range(3):
                out.b[i, j] += B[j]
                for a in range(j + 1):
                    V[i, j, a] += R[j, 0] * E[0, a] + R[j, 1] * E[1, a] + R[j, 2] * E[2, a]
            if k >= seen.free:
                continue
            for a in range(6):
                W[o, a, 0], W[o, a, 1], W[o, a, 2], W[o, a, 3] = -E[a, 0], -E[a, 1], -E[a, 2], 0.0
            if seen.point_starts[i + 1] - seen.point_starts[i] == 1:
                continue
            m00, m01, m02 = p1 * a02, p1 * a12 - p2 * a11, p1 * a22 - p2 * a12  # P A
            m10, m11, m12 = p2 * a00 - p0 * a02, -p0 * a12, p2 * a02 - p0 * a22
            m20, m21, m22 = -p1 * a00, p0 * a11, p0 * a12 - p1 * a02
            f = 6 * k
            H[f, f] += a00
            H[f + 1, f + 1] += a11
            H[f + 2, f] += a02
            H[f + 2, f + 1] += a12
            H[f + 2, f + 2] += a22
            H[f + 3, f] += m00
            H[f + 3, f + 1] += m01
            H[f + 3, f + 2] += m02
            H[f + 4, f] += m10
            H[f + 4, f + 1] += m11
            H[f + 4, f + 2] += m12
            H[f + 5, f] += m20
            H[f + 5, f + 1] += m21
            H[f + 5, f + 2] += m22
            H[f + 3, f + 3] += p1 * m02 - p2 * m01
            H[f + 4, f + 3] += p1 * m12 - p2 * m11
            H[f + 4, f + 4] += p2 * m10 - p0 * m12
            H[f + 5, f + 3] += p1 * m22 - p2 * m21
            H[f + 5, f + 4] += p2 * m20 - p0 * m22
            H[f + 5, f + 5] += p0 * m21 - p1 * m20
            g[f] -= b0
            g[f + 1] -= b1
            g[f + 2] -= b2
            g[f + 3] -= p1 * b2 - p2 * b1
            g[f + 4] -= p2 * b0 - p0 * b2
            g[f + 5] -= p0 * b1 - p1 * b0
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_lines(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool) -> float:
    """Both ends of each observed segment against the points of the line opposite to them, in the image (rows 0 and 1) and, where the segment has a
    3D line, in depth (rows 2 and 3)."""
    cost, points, observations = 0.0, len(state.points), len(seen.point_keyframes)
    N, m, p, r, w, J = np.empty((3, 2)), np.empty(3), np.empty((2, 3)), np.zeros(4), np.zeros(4), np.zeros((4, 10))
    for i in range(len(state.lines)):
        line = state.lines[i]
        line_basis(line, N)
        for o in range(seen.line_starts[i], seen.line_starts[i + 1]):
            k = seen.line_keyframes[o]
            R, t, camera = state.rotations[k], state.positions[k], seen.intrinsics[k]
            segment_px, observed_m = seen.endpoints_px[o], seen.observed_m[o]
            deep = depth_direction(observed_m, m)
            for a in range(2):
                share = share_opposite(R, t, line, segment_px[a], camera)
                r[a], s = line_term(R, t, line, N, share, segment_px, camera, J[a], p[a])
                w[a] = 1.0 / (seen.line_sigma_px**2 * ((1.0 - s) ** 2 + s * s))
                if deep:
                    r[2 + a], s = line_depth_term(R, N, share, observed_m, m, J[2 + a], p[a])
                    w[2 + a] = 1.0 / _end_variance(s, m, seen.observed_covariance_m2[o])
            x = observations + o
            if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
                cost += BEHIND
                _clear(out.W[x])
                continue
            for a in range(2 if deep else 1):
                weight, share = _loss(w[2 * a] * r[2 * a] ** 2 + w[2 * a + 1] * r[2 * a + 1] ** 2, CHI2_2, loss)
                cost += share
                w[2 * a] *= weight
                w[2 * a + 1] *= weight
            if not filled:
                continue
            if not deep:
                w[2:], r[2:], J[2:] = 0.0, 0.0, 0.0
            _add_rows(r, w, J, 6 * k if k < seen.free else -1, out.H, out.g, out.V[points + i], out.b[points + i], out.W[x])
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_rows(r: F64, w: F64, J: F64, pose: int, H: F64, g: F64, V: F64, b: F64, W: F64) -> None:
    """Add four residuals r of weights w with derivatives J (4, 10) of a line seen by the keyframe whose unknowns begin at `pose`, negative for a held
    one; W (6, 4) is theirs alone. Number by number, so that none is loaded and stored four times."""
    r0, r1, r2, r3 = r[0], r[1], r[2], r[3]
    for i in range(4):
        a0, a1, a2, a3 = w[0] * J[0, 6 + i], w[1] * J[1, 6 + i], w[2] * J[2, 6 + i], w[3] * J[3, 6 + i]
        b[i] = b[i] + a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3
        for j in range(6, 7 + i):
            V[i, j - 6] = V[i, j - 6] + a0 * J[0, j] + a1 * J[1, j] + a2 * J[2, j] + a3 * J[3, j]
    if pose < 0:
        return
    for i in range(6):
        a0, a1, a2, a3 = w[0] * J[0, i], w[1] * J[1, i], w[2] * J[2, i], w[3] * J[3, i]
        g[pose + i] = g[pose + i] + a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3
        for j in range(i + 1):
            H[pose + i, pose + j] = H[pose + i, pose + j] + a0 * J[0, j] + a1 * J[1, j] + a2 * J[2, j] + a3 * J[3, j]
        for j in range(4):
            W[i, j] = a0 * J[0, 6 + j] + a1 * J[1, 6 + j] + a2 * J[2, 6 + j] + a3 * J[3, 6 + j]


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
        basis(seen.observed_planes[o], B)
        plane_rows(np.int32(SAME), state.rotations[k], state.positions[k], state.planes[i], seen.observed_planes[o], B, r, Jc)
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
def linearise_bundle(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool = True) -> float:
    """Fill the normal equations at a state; returns the cost under a loss: SQUARES, HUBER beyond the 95 % gate of each term, or TRUNCATED there (for
    planes and their relations HUBER still: they are few, and 5 % would be too many to lose). Where they need not be `filled` they are spoilt."""
    out.H[:], out.g[:], out.V[:], out.b[:] = 0.0, 0.0, 0.0, 0.0
    cost = _add_points(state, seen, loss, out, filled)
    cost += _add_lines(state, seen, loss, out, filled)
    return cost + _add_planes(state, seen, loss, out)
