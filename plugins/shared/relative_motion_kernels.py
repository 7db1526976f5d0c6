"""Kernels of `relative_motion.py`: robust Gauss–Newton for the motion between two frames from 3D features matched in both.

The motion is `T_current_previous`: `p_current = R p_previous + t`, with parameters (phi, rho) in `R <- Exp(phi) R, t <- t + rho`. Points and ends of
lines are point pairs with a 3 × 3 information: zero along a line; of those without depth in the current frame zero along the ray of a point, and
within the plane through a line and the camera. Planes are pairs (n, d) with a 4 × 4 information.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import add_triangle, add_triple, inverse_positive, solve_positive, tangent_columns
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.lie_kernels import left_multiply_exp

SHORTEST_M = 1e-3  # line
MOST = 400  # points used, about; more only cost time
GATE2 = 9.0  # squared Mahalanobis distance at which a term counts a quarter, once the scale has come down


class PointPairs(NamedTuple):
    """n points of the previous frame, and the rows of the current points they were matched to."""

    rows: I32  # (n, 2) previous, current
    before: F32  # (n, 3)
    before_sigma: F32  # (n,) of their depth
    points: F32  # (k, 3) current
    pixels: F32  # (k, 2)
    sigma_px: F32  # (k,) across the ray
    sigma_m: F32  # (k,) along it


class LinePairs(NamedTuple):
    """n lines of the previous frame, and the rows of the current lines they were matched to."""

    rows: I32  # (n, 2) previous, current
    before: F32  # (n, 2, 3)
    endpoints: F32  # (k, 2, 3) current
    pixels: F32  # (k, 2, 2)
    covariance: F32  # (k, 2, 3, 3)


class PlanePairs(NamedTuple):
    """n planes of the previous frame, and the rows of the current planes they were matched to."""

    rows: I32  # (n, 2) previous, current
    before: F64  # (n, 4)
    before_covariance: F64  # (n, 3, 3) of (a, b, d)
    planes: F64  # (k, 4) current
    covariance: F64  # (k, 3, 3)


class Terms(NamedTuple):
    """Corresponding points (ends of lines included) and planes, previous and current."""

    before_m: F64  # (n, 3)
    after_m: F64  # (n, 3)
    information: F64  # (n, 3, 3), 1/m²
    planes_before: F64  # (p, 4)
    planes_after: F64  # (p, 4)
    plane_information: F64  # (p, 4, 4)


# The optimiser.


@kernel
def estimate_motion(
    points: PointPairs, lines: LinePairs, walls: PlanePairs, camera: F64, start: F64, noise: tuple[float, float, float, float]
) -> tuple[F64, F64, F64, float]:
    """Estimate the fields of `Motion` from `start` (3, 3) and zero translation; see `solve_motion`.

    The residuals' scale multiplies the covariance where they exceed their noise."""
    rad_per_px, floor, sigma, sigma_m = noise
    terms = _gather_terms(points, lines, walls, camera, rad_per_px, floor)
    R, t, prior, A = np.empty((3, 3)), np.zeros(3), np.empty(6), np.empty((6, 6))
    for i in range(3):
        prior[i], prior[3 + i] = 1.0 / sigma**2, 1.0 / sigma_m**2
        for j in range(3):
            R[i, j] = start[i, j]
    residuals = _squared_distances(terms, R, t)
    scale2 = max(2.0 * np.median(residuals), GATE2) if len(residuals) else GATE2
    H, chi2, support = _gauss_newton(terms, R, t, prior, scale2)
    scale = max(chi2 / max(3.0 * support - 6.0, 1.0), 1.0)
    for i in range(6):
        for j in range(6):
            A[i, j] = H[i, j] / scale + (prior[i] if i == j else 0.0)
    return R, t, inverse_positive(A), support


@kernel
def _gauss_newton(terms: Terms, R: F64, t: F64, prior: F64, scale2: float) -> tuple[F64, float, float]:
    """Iterate Gauss–Newton in place on R and t, with a diagonal prior (6,) on the motion since the start, halving the squared scale down to GATE2.

    Returns H (6, 6), the weighted χ² and the sum of the weights."""
    H, A, g = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    phi, step = np.zeros(3), np.zeros(6)  # phi: since the start
    chi2, components = 0.0, 0.0
    converged = False
    for _ in range(40):
        chi2, components = _normal_equations(terms, R, t, scale2, H, g)
        if converged:
            break
        size = 0.0
        for i in range(6):
            g[i] = -g[i] - prior[i] * (phi[i] if i < 3 else t[i - 3])
            for j in range(6):
                A[i, j] = H[i, j] + (prior[i] if i == j else 0.0)
        solve_positive(A, g, step)
        left_multiply_exp(step, R)
        for i in range(3):
            phi[i] += step[i]
            t[i] += step[3 + i]
            size += step[i] * step[i] + step[3 + i] * step[3 + i]
        converged = scale2 <= GATE2 and size < 1e-12
        scale2 = max(0.5 * scale2, GATE2)
    return H, chi2, components / 3.0


# Corresponding features with the information of their difference.


@kernel
def _gather_terms(points: PointPairs, lines: LinePairs, walls: PlanePairs, camera: F64, rad_per_px: float, floor: float) -> Terms:
    """Gather the terms of all pairs, about MOST points at most."""
    n, m = len(points.rows), len(lines.rows)
    step = max((n + 2 * m + MOST - 1) // MOST, 1)
    before, after, information = np.empty((n + 2 * m, 3)), np.empty((n + 2 * m, 3)), np.empty((n + 2 * m, 3, 3))
    count = fill_point_pairs(points, camera, rad_per_px, step, before, after, information)
    count = fill_line_pairs(lines, camera, rad_per_px, step, count, before, after, information)
    planes_before, planes_after, plane_information = plane_pairs(walls, floor)
    return Terms(before[:count], after[:count], information[:count], planes_before, planes_after, plane_information)


@kernel
def fill_point_pairs(pairs: PointPairs, camera: F64, rad_per_px: float, step: int, p: F64, q: F64, information: F64) -> int:
    """Write positions (m, 3) before and after, and information (m, 3, 3), 1/m², of every `step`-th pair with depth in the previous frame; return m.

    The covariance is that of the pixel across the ray and of both depths along it, inverted by Sherman–Morrison. Without depth in the current frame
    nothing is known along the ray, and the position on it is that at the previous depth."""
    rows, before, before_sigma, points, pixels, sigma_px, sigma_m = pairs
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    m, seen = 0, 0
    for i in range(len(rows)):
        row = rows[i, 1]
        then, z = float(before[i, 2]), float(points[row, 2])
        if not np.isfinite(then):
            continue
        seen += 1
        if (seen - 1) % step:
            continue
        measured = np.isfinite(z)
        if not measured:
            z = then
        across = sigma_px[row] * rad_per_px * np.sqrt(then**2 + z * z)
        for k in range(3):
            p[m, k] = before[i, k]
        if measured:
            q[m, 0], q[m, 1], q[m, 2] = points[row, 0], points[row, 1], z
        else:
            q[m, 0], q[m, 1], q[m, 2] = z * (pixels[row, 0] - cx) / fx, z * (pixels[row, 1] - cy) / fy, z
        x, y = q[m, 0] / z, q[m, 1] / z
        shrink = 1.0 / (x * x + y * y + 1.0)
        if measured:
            along2 = float(before_sigma[i]) ** 2 + float(sigma_m[row]) ** 2
            shrink = along2 / (across * across + along2 * (x * x + y * y + 1.0))  # Sherman–Morrison
        total = 0.0
        for a in range(3):
            for b in range(3):
                ray = (x if a == 0 else y if a == 1 else 1.0) * (x if b == 0 else y if b == 1 else 1.0)
                information[m, a, b] = ((1.0 if a == b else 0.0) - shrink * ray) / (across * across)
                total += information[m, a, b]
        m += np.isfinite(total)
    return m


@kernel
def fill_line_pairs(pairs: LinePairs, camera: F64, rad_per_px: float, step: int, m: int, p: F64, q: F64, information: F64) -> int:
    """Write both ends of every `step`-th previous line, each against the start of the current line, from row m on; return the next row.

    The information is that of the current ends across the line, halved since its start serves twice, and zero along the line. A current line without
    depth is known to lie in the plane through it and the camera, within a pixel."""
    rows, before, endpoints, pixels, covariance = pairs
    seen, direction, B, S = 0, np.empty(3), np.empty((3, 2)), np.empty((2, 2))
    for i in range(len(rows)):
        row = rows[i, 1]
        length2, known = 0.0, 0.0
        for k in range(3):
            direction[k] = float(endpoints[row, 1, k]) - float(endpoints[row, 0, k])
            length2 += direction[k] * direction[k]
            known += before[i, 0, k] + before[i, 1, k]
        if not np.isfinite(known) or length2 <= SHORTEST_M * SHORTEST_M:
            continue
        seen += 1
        if (seen - 1) % step:
            continue
        if not np.isfinite(length2):
            m += _fill_within_plane(before[i], pixels[row], camera, rad_per_px, p[m : m + 2], q[m : m + 2], information[m : m + 2])
            continue
        for k in range(3):
            direction[k] /= np.sqrt(length2)
        tangent_columns(direction, B)
        floor = max(rad_per_px * float(endpoints[row, 0, 2]), 1e-6) ** 2
        for a in range(2):
            for b in range(2):
                S[a, b] = floor if a == b else 0.0
                for j in range(3):
                    for k in range(3):
                        S[a, b] += B[j, a] * (float(covariance[row, 0, j, k]) + float(covariance[row, 1, j, k])) * B[k, b]
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
        if not (det > 0.0 and np.isfinite(det)):
            continue
        for end in range(2):
            for a in range(3):
                p[m + end, a], q[m + end, a] = before[i, end, a], endpoints[row, 0, a]
                for b in range(3):
                    first, second = S[1, 1] * B[b, 0] - S[0, 1] * B[b, 1], S[0, 0] * B[b, 1] - S[1, 0] * B[b, 0]
                    information[m + end, a, b] = 0.5 * (B[a, 0] * first + B[a, 1] * second) / det
        m += 2
    return m


@kernel
def _fill_within_plane(before: F32, pixels: F32, camera: F64, rad_per_px: float, p: F64, q: F64, information: F64) -> int:
    """Write both ends (2, 3) of a previous line, each against the camera, with information across the plane through it and the current `pixels`
    (2, 2) of its ends; return 2, or 0 for ends that are one."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    x0, y0, x1, y1 = (pixels[0, 0] - cx) / fx, (pixels[0, 1] - cy) / fy, (pixels[1, 0] - cx) / fx, (pixels[1, 1] - cy) / fy
    a, b, c = y0 - y1, x1 - x0, x0 * y1 - y0 * x1
    length2 = a * a + b * b + c * c
    if not length2 > 0.0:
        return 0
    for end in range(2):
        weight = 1.0 / (length2 * max(rad_per_px * float(before[end, 2]), 1e-6) ** 2)
        for j in range(3):
            p[end, j], q[end, j] = before[end, j], 0.0
            for k in range(3):
                n, o = (a if j == 0 else b if j == 1 else c), (a if k == 0 else b if k == 1 else c)
                information[end, j, k] = weight * n * o
    return 2


@kernel
def plane_pairs(pairs: PlanePairs, floor: float) -> tuple[F64, F64, F64]:
    """Previous planes (m, 4), current planes (m, 4), and the information (m, 4, 4) of their difference in (n, d), of the pairs with finite
    covariance; `floor` (rad) is the least σ of a normal."""
    rows, before, before_covariance, planes, covariance = pairs
    m, p, q, information = 0, np.empty((len(rows), 4)), np.empty((len(rows), 4)), np.zeros((len(rows), 4, 4))
    B, C = np.empty((3, 2)), np.empty((3, 3))
    for i in range(len(rows)):
        row, total = rows[i, 1], 0.0
        for a in range(3):
            for b in range(3):
                C[a, b] = before_covariance[i, a, b] + covariance[row, a, b]
                total += C[a, b]
            C[a, a] += floor * floor if a < 2 else 0.0
        for k in range(4):
            p[m, k], q[m, k] = before[i, k], planes[row, k]
            total += p[m, k] + q[m, k]
        if not np.isfinite(total):
            continue
        A = inverse_positive(C)
        if A[0, 0] == 0.0:
            continue
        tangent_columns(q[m, :3], B)
        for a in range(3):
            for b in range(3):
                information[m, a, b] = 0.0
                for u in range(2):
                    for v in range(2):
                        information[m, a, b] += B[a, u] * A[u, v] * B[b, v]
            information[m, a, 3] = B[a, 0] * A[0, 2] + B[a, 1] * A[1, 2]
            information[m, 3, a] = information[m, a, 3]
        information[m, 3, 3] = A[2, 2]
        m += 1
    return p[:m], q[:m], information[:m]


# Residuals.


@kernel
def _plane_residual(before: F64, after: F64, R: F64, t: F64, e: F64) -> None:
    """Fill e (4,) with the previous plane moved into the current frame, less the current plane."""
    e[3] = before[3] - after[3]
    for k in range(3):
        n = R[k, 0] * before[0] + R[k, 1] * before[1] + R[k, 2] * before[2]
        e[k] = n - after[k]
        e[3] -= n * t[k]


@kernel
def _plane_distance2(e: F64, L: F64) -> float:
    """Squared Mahalanobis norm `eᵀ L e` of a plane residual (4,)."""
    total = 0.0
    for j in range(4):
        for k in range(4):
            total += e[j] * L[j, k] * e[k]
    return total


@kernel
def _squared_distances(terms: Terms, R: F64, t: F64) -> F64:
    """Squared Mahalanobis distances (n + p,) of points and planes at a motion."""
    n, p = len(terms.before_m), len(terms.planes_before)
    out, e = np.empty(n + p), np.empty(4)
    for i in range(n):
        x, y, z = terms.before_m[i, 0], terms.before_m[i, 1], terms.before_m[i, 2]
        a = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0] - terms.after_m[i, 0]
        b = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1] - terms.after_m[i, 1]
        c = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2] - terms.after_m[i, 2]
        L = terms.information
        out[i] = a * (L[i, 0, 0] * a + 2.0 * (L[i, 0, 1] * b + L[i, 0, 2] * c)) + b * (L[i, 1, 1] * b + 2.0 * L[i, 1, 2] * c) + c * c * L[i, 2, 2]
    for i in range(p):
        _plane_residual(terms.planes_before[i], terms.planes_after[i], R, t, e)
        out[n + i] = _plane_distance2(e, terms.plane_information[i])
    return out


# Robust weights and normal equations.


@kernel
def _normal_equations(terms: Terms, R: F64, t: F64, scale2: float, H: F64, g: F64) -> tuple[float, float]:
    """Fill H (6, 6) and g (6,) with Geman–McClure weights at the squared scale; return the weighted χ² and number of components."""
    H[:], g[:] = 0.0, 0.0
    e4, J4 = np.empty(4), np.zeros((4, 6))
    chi2, components = _add_points(terms, R, t, scale2, H, g)
    for i in range(len(terms.planes_before)):
        _plane_residual(terms.planes_before[i], terms.planes_after[i], R, t, e4)
        distance = _plane_distance2(e4, terms.plane_information[i])
        w = (scale2 / (scale2 + distance)) ** 2
        chi2 += w * distance
        components += 3.0 * w
        x, y, z = e4[0] + terms.planes_after[i, 0], e4[1] + terms.planes_after[i, 1], e4[2] + terms.planes_after[i, 2]
        J4[0, 1], J4[0, 2], J4[1, 0], J4[1, 2], J4[2, 0], J4[2, 1] = z, -y, -z, x, y, -x
        J4[3, 0], J4[3, 1], J4[3, 2] = t[1] * z - t[2] * y, t[2] * x - t[0] * z, t[0] * y - t[1] * x  # -(phi × n)·t = -phi·(n × t)
        J4[3, 3], J4[3, 4], J4[3, 5] = -x, -y, -z
        _add_plane(e4, J4, terms.plane_information[i], w, H, g)
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return chi2, components


@kernel
def _add_points(terms: Terms, R: F64, t: F64, scale2: float, H: F64, g: F64) -> tuple[float, float]:
    """Add `w JᵀLJ` of all points to the lower triangle of H and `w JᵀLe` to g; return the weighted χ² and number of components.

    With p = R p_previous, J = (-[p]×, I). In scalars, since points are most of the work."""
    chi2, components, L = 0.0, 0.0, terms.information
    for i in range(len(terms.before_m)):
        x, y, z = terms.before_m[i, 0], terms.before_m[i, 1], terms.before_m[i, 2]
        p0, p1, p2 = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z, R[1, 0] * x + R[1, 1] * y + R[1, 2] * z, R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        a, b, c = p0 + t[0] - terms.after_m[i, 0], p1 + t[1] - terms.after_m[i, 1], p2 + t[2] - terms.after_m[i, 2]
        l00, l01, l02, l11, l12, l22 = L[i, 0, 0], L[i, 0, 1], L[i, 0, 2], L[i, 1, 1], L[i, 1, 2], L[i, 2, 2]
        e0, e1, e2 = l00 * a + l01 * b + l02 * c, l01 * a + l11 * b + l12 * c, l02 * a + l12 * b + l22 * c
        distance = a * e0 + b * e1 + c * e2
        w = (scale2 / (scale2 + distance)) ** 2
        chi2 += w * distance
        components += 3.0 * w
        l00, l01, l02, l11, l12, l22, e0, e1, e2 = w * l00, w * l01, w * l02, w * l11, w * l12, w * l22, w * e0, w * e1, w * e2
        m00, m01, m02 = p1 * l02 - p2 * l01, p1 * l12 - p2 * l11, p1 * l22 - p2 * l12  # [p]× w L
        m10, m11, m12 = p2 * l00 - p0 * l02, p2 * l01 - p0 * l12, p2 * l02 - p0 * l22
        m20, m21, m22 = p0 * l01 - p1 * l00, p0 * l11 - p1 * l01, p0 * l12 - p1 * l02
        add_triangle(
            H, 0, p1 * m02 - p2 * m01, p1 * m12 - p2 * m11, p2 * m10 - p0 * m12, p1 * m22 - p2 * m21, p2 * m20 - p0 * m22, p0 * m21 - p1 * m20
        )
        add_triple(H[3], 0, m00, m10, m20)
        add_triple(H[4], 0, m01, m11, m21)
        add_triple(H[5], 0, m02, m12, m22)
        add_triangle(H, 3, l00, l01, l11, l02, l12, l22)
        add_triple(g, 0, p1 * e2 - p2 * e1, p2 * e0 - p0 * e2, p0 * e1 - p1 * e0)
        add_triple(g, 3, e0, e1, e2)
    return chi2, components


@kernel
def _add_plane(e: F64, J: F64, L: F64, w: float, H: F64, g: F64) -> None:
    """Add `w JᵀLJ` of one plane to the lower triangle of H and `w JᵀLe` to g, for J (4, 6)."""
    for i in range(4):
        for b in range(6):
            LJ = 0.0
            for j in range(4):
                LJ += w * L[i, j] * J[j, b]
            g[b] += LJ * e[i]
            for a in range(b, 6):
                H[a, b] += J[i, a] * LJ
