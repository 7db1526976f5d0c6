"""Motion between two frames from 3D features seen in both: robust Gauss–Newton, no intrinsics needed.

The motion is `T_current_previous`: `p_current = R p_previous + t`. Its unknowns are (phi, rho) in `R <- Exp(phi) R, t <- t + rho`. Points and the
ends of lines are pairs of places with a 3 × 3 information, which is zero along a line; planes are pairs (n, d) with a 4 × 4 one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F64, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.numerics.algebra.small_linear import solve_positive, turn_left
from trihedron.plugins.numerics.motion.place_pairs import line_pairs, plane_pairs, point_pairs

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


def motion_terms(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, rad_per_px: float, floor_deg: float) -> Terms:
    """What the tracks and the current features say about the motion. `rad_per_px` turns a key point's sigma_px into an angle; `floor_deg` is the
    least error of a plane's normal. Pairs that are not finite, or whose covariance is none, are left out."""
    step = max(-(-(len(tracks.keypoints) + 2 * len(tracks.segments)) // MOST), 1)
    copy = np.array  # copies are alike in memory, so that the kernels are compiled once
    before, sigma, pairs = copy(tracks.points_m), copy(tracks.sigma_m), copy(tracks.keypoints[:, 1])
    now, sigma_px, sigma_m = copy(keypoints.points_m), copy(keypoints.sigma_px), copy(keypoints.sigma_m)
    of_points = point_pairs(pairs, before, sigma, now, sigma_px, sigma_m, rad_per_px, step)
    lines, endpoints, noise = copy(tracks.segments[:, 1]), copy(segments.endpoints_m), copy(segments.covariance_m2)
    of_lines = line_pairs(lines, copy(tracks.endpoints_m), endpoints, noise, rad_per_px, step)
    of_planes = plane_pairs(
        copy(tracks.planes[:, 1]), copy(tracks.coefficients), copy(tracks.plane_covariance), copy(planes.coefficients), copy(planes.covariance),
        np.radians(floor_deg),
    )  # fmt: skip
    places = [np.concatenate(pair) for pair in zip(of_points, of_lines)]
    return Terms(*places, *of_planes)


def solve_motion(terms: Terms, R: F64, sigma_deg: float, sigma_m: float) -> Motion:
    """The motion that most of the terms agree on, near the predicted rotation R (3, 3), known to `sigma_deg`, and no translation, known to `sigma_m`.

    Graduated non-convexity (Yang et al., RA-L 2020): the Geman–McClure scale comes down from the median residual, so that up to half of the terms
    may be wrong. Never raises: without terms the prediction is returned, with the covariance of the prior."""
    prior = np.repeat([1.0 / np.radians(sigma_deg) ** 2, 1.0 / sigma_m**2], 3)
    R, t = np.array(R, np.float64), np.zeros(3)
    residuals = np.concatenate(_residuals(terms, R, t)[:2])
    scale2 = max(2.0 * float(np.median(residuals)), GATE2) if len(residuals) else GATE2
    H, chi2, support = _solve(terms, R, t, prior, scale2)
    scale = max(chi2 / max(3.0 * support - 6.0, 1.0), 1.0)
    return Motion(R, t, np.asarray(np.linalg.inv(H / scale + np.diag(prior)), np.float64), support)


@numba.njit(cache=True, nogil=True)
def _residuals(terms: Terms, R: F64, t: F64) -> tuple[F64, F64, F64]:
    """Squared Mahalanobis distances of places (n,) and planes (p,), and the rotated and moved places (n, 3)."""
    n, p = len(terms.before_m), len(terms.planes_before)
    places, planes, moved = np.empty(n), np.empty(p), np.empty((n, 3))
    e = np.empty(4)
    for i in range(n):
        total = 0.0
        for k in range(3):
            moved[i, k] = R[k, 0] * terms.before_m[i, 0] + R[k, 1] * terms.before_m[i, 1] + R[k, 2] * terms.before_m[i, 2]
            e[k] = moved[i, k] + t[k] - terms.after_m[i, k]
        for j in range(3):
            for k in range(3):
                total += e[j] * terms.information[i, j, k] * e[k]
        places[i] = total
    for i in range(p):
        _plane_residual(terms.planes_before[i], terms.planes_after[i], R, t, e)
        total = 0.0
        for j in range(4):
            for k in range(4):
                total += e[j] * terms.plane_information[i, j, k] * e[k]
        planes[i] = total
    return places, planes, moved


@numba.njit(cache=True, nogil=True)
def _plane_residual(before: F64, after: F64, R: F64, t: F64, e: F64) -> None:
    """The previous plane moved into the current frame less the current one, (4,)."""
    e[3] = before[3] - after[3]
    for k in range(3):
        n = R[k, 0] * before[0] + R[k, 1] * before[1] + R[k, 2] * before[2]
        e[k] = n - after[k]
        e[3] -= n * t[k]


@numba.njit(cache=True, nogil=True)
def _add_place(e: F64, p: F64, L: F64, w: float, M: F64, H: F64, g: F64) -> None:
    """Add w JᵀLJ to the lower triangle of H and w JᵀLe to g for a place at R p_previous = p, whose J is (-[p]×, I); M is scratch (3, 3)."""
    for k in range(3):
        M[0, k] = w * (p[1] * L[2, k] - p[2] * L[1, k])  # [p]× L
        M[1, k] = w * (p[2] * L[0, k] - p[0] * L[2, k])
        M[2, k] = w * (p[0] * L[1, k] - p[1] * L[0, k])
    for i in range(3):
        H[i, 0] += p[1] * M[i, 2] - p[2] * M[i, 1]
        H[i, 1] += p[2] * M[i, 0] - p[0] * M[i, 2]
        H[i, 2] += p[0] * M[i, 1] - p[1] * M[i, 0]
        for k in range(3):
            g[i] += M[i, k] * e[k]
            g[3 + i] += w * L[i, k] * e[k]
            H[3 + k, i] += M[i, k]
            H[3 + i, 3 + k] += w * L[i, k]


@numba.njit(cache=True, nogil=True)
def _add_plane(e: F64, J: F64, L: F64, w: float, H: F64, g: F64) -> None:
    """Add w JᵀLJ to the lower triangle of H and w JᵀLe to g for J (4, 6)."""
    LJ = np.zeros(6)
    for i in range(4):
        for b in range(6):
            LJ[b] = 0.0
        for j in range(4):
            for b in range(6):
                LJ[b] += w * L[i, j] * J[j, b]
        for b in range(6):
            g[b] += LJ[b] * e[i]
            for a in range(b, 6):
                H[a, b] += J[i, a] * LJ[b]


@numba.njit(cache=True, nogil=True)
def _normal_equations(terms: Terms, R: F64, t: F64, scale2: float, H: F64, g: F64) -> tuple[float, float]:
    """Fill H (6, 6) and g (6,) with Geman–McClure weights at the squared scale; returns the weighted χ² and the weighted number of components."""
    H[:], g[:] = 0.0, 0.0
    places, planes, moved = _residuals(terms, R, t)
    e3, M, e4, J4 = np.empty(3), np.empty((3, 3)), np.empty(4), np.zeros((4, 6))
    chi2, components = 0.0, 0.0
    for i in range(len(places)):
        w = (scale2 / (scale2 + places[i])) ** 2
        chi2 += w * places[i]
        components += 3.0 * w
        for k in range(3):
            e3[k] = moved[i, k] + t[k] - terms.after_m[i, k]
        _add_place(e3, moved[i], terms.information[i], w, M, H, g)
    for i in range(len(planes)):
        w = (scale2 / (scale2 + planes[i])) ** 2
        chi2 += w * planes[i]
        components += 3.0 * w
        _plane_residual(terms.planes_before[i], terms.planes_after[i], R, t, e4)
        x, y, z = e4[0] + terms.planes_after[i, 0], e4[1] + terms.planes_after[i, 1], e4[2] + terms.planes_after[i, 2]
        J4[0, 1], J4[0, 2], J4[1, 0], J4[1, 2], J4[2, 0], J4[2, 1] = z, -y, -z, x, y, -x
        J4[3, 0], J4[3, 1], J4[3, 2] = t[1] * z - t[2] * y, t[2] * x - t[0] * z, t[0] * y - t[1] * x  # -(phi × n)·t = -phi·(n × t)
        J4[3, 3], J4[3, 4], J4[3, 5] = -x, -y, -z
        _add_plane(e4, J4, terms.plane_information[i], w, H, g)
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return chi2, components


@numba.njit(cache=True, nogil=True)
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
