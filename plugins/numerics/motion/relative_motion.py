"""Motion between two frames from 3D features seen in both: robust Gauss–Newton, no intrinsics needed.

The motion is `T_current_previous`: `p_current = R p_previous + t`. Its unknowns are (phi, rho) in `R <- Exp(phi) R, t <- t + rho`. Points and the
ends of lines are pairs of places with a 3 × 3 information, which is zero along a line; planes are pairs (n, d) with a 4 × 4 one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.numerics.algebra.ranking import median
from trihedron.plugins.numerics.algebra.small_linear import inverse_positive, solve_positive, turn_left
from trihedron.plugins.numerics.motion.place_pairs import LinePairs, PlanePairs, PointPairs, line_pairs, pairs_of, plane_pairs, point_pairs

MOST = 400  # pairs of places used, about; more only cost time
GATE2 = 9.0  # squared standard deviations at which a term counts a quarter, once the scale has come down


class Terms(NamedTuple):
    """Pairs of places and of planes, previous and current."""

    before_m: F64  # (n, 3)
    after_m: F64  # (n, 3)
    information: F64  # (n, 3, 3), 1/m²
    planes_before: F64  # (p, 4)
    planes_after: F64  # (p, 4)
    plane_information: F64  # (p, 4, 4)


@dataclass(frozen=True)
class Motion:
    """`T_current_previous` as R (3, 3) and t (3,); covariance (6, 6) of (phi, rho), the prior's width where nothing was measured;
    `support` is the summed weight of the terms: about the number of good ones."""

    R: F64
    t: F64
    covariance: F64
    support: float


def solve_motion(
    tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, rad_per_px: float, floor_deg: float, sigma_deg: float, sigma_m: float
) -> Motion:
    """The motion that most of the tracks agree on, near their rotation, known to `sigma_deg`, and no translation, known to `sigma_m`.

    `rad_per_px` turns a key point's sigma_px into an angle; `floor_deg` is the least error of a plane's normal. Pairs that are not finite, or whose
    covariance is none, are left out. Graduated non-convexity (Yang et al., RA-L 2020): the Geman–McClure scale comes down from the median residual,
    so that up to half of the terms may be wrong. Never raises: without terms the prediction is returned, with the covariance of the prior."""
    noise = float(rad_per_px), float(np.radians(floor_deg)), float(np.radians(sigma_deg)), float(sigma_m)
    return Motion(*_motion(*pairs_of(tracks, keypoints, segments, planes), tracks.R_current_previous, noise))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _motion(
    points: PointPairs, lines: LinePairs, walls: PlanePairs, start: F64, noise: tuple[float, float, float, float]
) -> tuple[F64, F64, F64, float]:
    """The fields of `Motion`."""
    rad_per_px, floor, sigma, sigma_m = noise
    terms = _terms(points, lines, walls, rad_per_px, floor)
    R, t, prior, A = np.empty((3, 3)), np.zeros(3), np.empty(6), np.empty((6, 6))
    for i in range(3):
        prior[i], prior[3 + i] = 1.0 / sigma**2, 1.0 / sigma_m**2
        for j in range(3):
            R[i, j] = start[i, j]
    residuals = _residuals(terms, R, t)
    scale2 = max(2.0 * median(residuals), GATE2) if len(residuals) else GATE2
    H, chi2, support = _solve(terms, R, t, prior, scale2)
    scale = max(chi2 / max(3.0 * support - 6.0, 1.0), 1.0)
    for i in range(6):
        for j in range(6):
            A[i, j] = H[i, j] / scale + (prior[i] if i == j else 0.0)
    return R, t, inverse_positive(A), support


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _terms(points: PointPairs, lines: LinePairs, walls: PlanePairs, rad_per_px: float, floor: float) -> Terms:
    """What the pairs say about the motion, of places about MOST at most."""
    n, m = len(points.rows), len(lines.rows)
    step = max((n + 2 * m + MOST - 1) // MOST, 1)
    before, after, information = np.empty((n + 2 * m, 3)), np.empty((n + 2 * m, 3)), np.empty((n + 2 * m, 3, 3))
    count = point_pairs(points, rad_per_px, step, before, after, information)
    count = line_pairs(lines, rad_per_px, step, count, before, after, information)
    planes_before, planes_after, plane_information = plane_pairs(walls, floor)
    return Terms(before[:count], after[:count], information[:count], planes_before, planes_after, plane_information)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _residuals(terms: Terms, R: F64, t: F64) -> F64:
    """(n + p,) squared Mahalanobis distances of places and planes."""
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
        out[n + i] = _plane_distance(e, terms.plane_information[i])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_distance(e: F64, L: F64) -> float:
    """eᵀ L e of four numbers."""
    total = 0.0
    for j in range(4):
        for k in range(4):
            total += e[j] * L[j, k] * e[k]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_residual(before: F64, after: F64, R: F64, t: F64, e: F64) -> None:
    """The previous plane moved into the current frame less the current one, (4,)."""
    e[3] = before[3] - after[3]
    for k in range(3):
        n = R[k, 0] * before[0] + R[k, 1] * before[1] + R[k, 2] * before[2]
        e[k] = n - after[k]
        e[3] -= n * t[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_places(terms: Terms, R: F64, t: F64, scale2: float, H: F64, g: F64) -> tuple[float, float]:
    """Add w JᵀLJ of all places to the lower triangle of H and w JᵀLe to g, with p = R p_previous and J = (-[p]×, I); in scalars, for places are most
    of the work. Returns the weighted χ² and number of components."""
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
        H[0, 0] += p1 * m02 - p2 * m01
        H[1, 0] += p1 * m12 - p2 * m11
        H[1, 1] += p2 * m10 - p0 * m12
        H[2, 0] += p1 * m22 - p2 * m21
        H[2, 1] += p2 * m20 - p0 * m22
        H[2, 2] += p0 * m21 - p1 * m20
        H[3, 0] += m00
        H[3, 1] += m10
        H[3, 2] += m20
        H[4, 0] += m01
        H[4, 1] += m11
        H[4, 2] += m21
        H[5, 0] += m02
        H[5, 1] += m12
        H[5, 2] += m22
        H[3, 3] += l00
        H[4, 3] += l01
        H[4, 4] += l11
        H[5, 3] += l02
        H[5, 4] += l12
        H[5, 5] += l22
        g[0] += p1 * e2 - p2 * e1
        g[1] += p2 * e0 - p0 * e2
        g[2] += p0 * e1 - p1 * e0
        g[3] += e0
        g[4] += e1
        g[5] += e2
    return chi2, components


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_plane(e: F64, J: F64, L: F64, w: float, H: F64, g: F64) -> None:
    """Add w JᵀLJ to the lower triangle of H and w JᵀLe to g for J (4, 6)."""
    for i in range(4):
        for b in range(6):
            LJ = 0.0
            for j in range(4):
                LJ += w * L[i, j] * J[j, b]
            g[b] += LJ * e[i]
            for a in range(b, 6):
                H[a, b] += J[i, a] * LJ


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(terms: Terms, R: F64, t: F64, scale2: float, H: F64, g: F64) -> tuple[float, float]:
    """Fill H (6, 6) and g (6,) with Geman–McClure weights at the squared scale; returns the weighted χ² and the weighted number of components."""
    for i in range(6):
        g[i] = 0.0
        for j in range(6):
            H[i, j] = 0.0
    e4, J4 = np.empty(4), np.zeros((4, 6))
    chi2, components = _add_places(terms, R, t, scale2, H, g)
    for i in range(len(terms.planes_before)):
        _plane_residual(terms.planes_before[i], terms.planes_after[i], R, t, e4)
        distance = _plane_distance(e4, terms.plane_information[i])
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(terms: Terms, R: F64, t: F64, prior: F64, scale2: float) -> tuple[F64, float, float]:
    """Moves R and t, with a prior (6,) information on the way moved; returns H (6, 6), the weighted χ² and the summed weights."""
    H, A, g = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    phi, step = np.zeros(3), np.zeros(6)  # phi: since the start
    chi2, components = 0.0, 0.0
    settled = False
    for _ in range(40):
        chi2, components = _normal_equations(terms, R, t, scale2, H, g)
        if settled:
            break
        size = 0.0
        for i in range(6):
            g[i] = -g[i] - prior[i] * (phi[i] if i < 3 else t[i - 3])
            for j in range(6):
                A[i, j] = H[i, j] + (prior[i] if i == j else 0.0)
        solve_positive(A, g, step)
        turn_left(step, R)
        for i in range(3):
            phi[i] += step[i]
            t[i] += step[3 + i]
            size += step[i] * step[i] + step[3 + i] * step[3 + i]
        settled = scale2 <= GATE2 and size < 1e-12
        scale2 = max(0.5 * scale2, GATE2)
    return H, chi2, components / 3.0
