"""The consensus of directions on three orthogonal axes, and upper bounds of it for all rotations near one.

Of directions d_i with weights w_i a rotation R with the columns r_k has the consensus

    C(R) = Σ w_i max_k q_ik,   q_ik = max(0, ((d_i·r_k)² - cos²τ) / sin²τ) = max(0, 1 - sin²θ_ik / sin²τ),

the weight of the inliers, those within τ of an axis, each counting less the further off it is. (Their bare number stays the same while a rotation
moves by degrees: its optimum has no place.) A direction that is an inlier for every rotation of a ball adds a quadratic form there, known from the
moments of its group; only groups astride an edge of a cone are looked at one direction at a time.

Bounds rest on three facts. While `Exp(t ω) R`, |ω| = 1, keeps d within β < 45° of r, the second derivative of (d·r)² by t is at most κ(β), see
`curvature`; its third derivative is at most 4 anywhere; and its first at most |sin 2β|.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.algebra.small_linear import solve_positive, turn_left
from trihedron.plugins.numerics.axes.direction_groups import Groups, add_moments

ROUNDING = 1e-9  # of all weight, added to bounds
SUMMIT_STEP = 1.08  # factor by which a ball around a summit is widened


class Near(NamedTuple):
    """What directions add to the consensus within a ball of rotations, times sin²τ."""

    sure: F64  # (3, 7) moments of the inliers that each axis has for all rotations of the ball
    torque: F64  # (3,) first derivative by phi in `Exp(phi) R` of the bound on the others
    constant: float  # and its value at the centre
    value: float  # what the others do add at the centre


@numba.njit(cache=True, nogil=True, error_model="numpy")
def curvature(beta: float) -> float:
    """κ(β) = cos β (1 - cos β), the second derivative when ω is midway between d and r; for every other ω it is less."""
    return np.cos(beta) * (1.0 - np.cos(beta))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def near_rotation(groups: Groups, R: F64, radius: float, inlier: float) -> Near:
    """What directions add within `radius` of R, `inlier` being τ; inlier + radius < 45°, so that no direction is near two axes.

    A direction that may enter or leave its cone adds at most max(0, p + s), p being its value and |s| <= L the change to first order. That is convex
    in s, so it is below the chord from -L to L, whose slopes are summed as a torque: directions on opposite edges of a cone cancel."""
    sure, torque, constant, value = np.zeros((3, 7)), np.zeros(3), 0.0, 0.0
    inner, outer, apart = max(inlier - radius, 0.0), inlier + radius, inlier > radius
    inner_c, inner_s, outer_c, outer_s = np.cos(inner), np.sin(inner), np.cos(outer), np.sin(outer)
    c2, bend = np.cos(inlier) ** 2, 0.5 * curvature(outer) * radius * radius
    for g in range(len(groups.means)):
        axis, dot = _nearest_axis(groups.means[g, 0], groups.means[g, 1], groups.means[g, 2], R)
        cosine, sine = groups.means[g, 3], groups.means[g, 4]
        if abs(dot) < outer_c * cosine - outer_s * sine:  # all are further off than `outer`
            continue
        if apart and sine <= inner_s and abs(dot) >= inner_c * cosine + inner_s * sine:  # all are nearer than `inner`
            for j in range(7):
                sure[axis, j] += groups.moments[g, j]
            continue
        for i in range(groups.first[g], groups.first[g + 1]):
            w, x, y, z = groups.weights[i], groups.vectors[i, 0], groups.vectors[i, 1], groups.vectors[i, 2]
            axis, dot = _nearest_axis(x, y, z, R)
            square = dot * dot
            if apart and abs(dot) >= inner_c:
                add_moments(sure[axis], w, x, y, z)
            elif abs(dot) > outer_c:
                value += w * max(square - c2, 0.0)
                change = 2.0 * radius * np.sqrt(max(square * (1.0 - square), 0.0))
                high, low = max(square - c2 + bend + change, 0.0), max(square - c2 + bend - change, 0.0)
                constant += 0.5 * w * (high + low)
                if change > 0.0:
                    _add_cross(torque, w * dot * (high - low) / change, R, axis, x, y, z)
    return Near(sure, torque, constant, value)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearest_axis(x: float, y: float, z: float, R: F64) -> tuple[int, float]:
    axis, dot = 0, x * R[0, 0] + y * R[1, 0] + z * R[2, 0]
    for k in range(1, 3):
        other = x * R[0, k] + y * R[1, k] + z * R[2, k]
        if abs(other) > abs(dot):
            axis, dot = k, other
    return axis, dot


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_cross(out: F64, factor: float, R: F64, k: int, x: float, y: float, z: float) -> None:
    """out += factor · r_k × (x, y, z)."""
    out[0] += factor * (R[1, k] * z - R[2, k] * y)
    out[1] += factor * (R[2, k] * x - R[0, k] * z)
    out[2] += factor * (R[0, k] * y - R[1, k] * x)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pulls(sure: F64, R: F64) -> F64:
    """(3, 3) columns M_k r_k: half the derivative of r_kᵀ M_k r_k by r_k."""
    out = np.empty((3, 3))
    for k in range(3):
        x, y, z = R[0, k], R[1, k], R[2, k]
        out[0, k] = sure[k, 0] * x + sure[k, 1] * y + sure[k, 2] * z
        out[1, k] = sure[k, 1] * x + sure[k, 3] * y + sure[k, 4] * z
        out[2, k] = sure[k, 2] * x + sure[k, 4] * y + sure[k, 5] * z
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_order(near: Near, R: F64, pulls: F64, gradient: F64) -> tuple[float, float, float]:
    """At R: Σ r_kᵀ M_k r_k and the weight of the sure inliers. Writes the derivative by phi of that, and of the bound on the others, to `gradient`
    (3,), and returns its length last."""
    total, weight = 0.0, 0.0
    for k in range(3):
        gradient[k] = near.torque[k]
    for k in range(3):
        weight += near.sure[k, 6]
        total += R[0, k] * pulls[0, k] + R[1, k] * pulls[1, k] + R[2, k] * pulls[2, k]
        _add_cross(gradient, 2.0, R, k, pulls[0, k], pulls[1, k], pulls[2, k])
    return total, weight, np.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def consensus_bound(groups: Groups, R: F64, radius: float, inlier: float) -> tuple[float, float]:
    """C(R), and an upper bound of C for all rotations within `radius` of R."""
    near = near_rotation(groups, R, radius, inlier)
    squares, weight, slope = _first_order(near, R, _pulls(near.sure, R), np.empty(3))
    total = squares - np.cos(inlier) ** 2 * weight
    rise = slope * radius + 0.5 * curvature(inlier) * weight * radius * radius
    s2 = np.sin(inlier) ** 2
    return (total + near.value) / s2, (total + near.constant + rise) / s2 + ROUNDING * groups.total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def climb(groups: Groups, R: F64, inlier: float, steps: int) -> tuple[F64, float]:
    """The rotation at the top of the slope on which R is, and its consensus, which no step lowers.

    C is convex in the matrix R, hence above its tangent at R: each step goes to the top of the tangent, which is a weighted orthogonal Procrustes
    problem, by Newton's method in phi."""
    R, top, best = R.copy(), R.copy(), -1.0
    N, gradient, phi = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(steps):
        near = near_rotation(groups, R, 0.0, inlier)
        pulls = _pulls(near.sure, R)
        squares, weight, _ = _first_order(near, R, pulls, gradient)
        total = squares - np.cos(inlier) ** 2 * weight
        if total <= best * (1.0 + 1e-12):
            break
        best, top = total, R.copy()
        for a in range(3):
            for b in range(3):
                N[a, b] = (2.0 * squares + 1e-9 * weight + 1e-12) * (a == b)
                for k in range(3):
                    N[a, b] -= R[a, k] * pulls[b, k] + pulls[a, k] * R[b, k]
        if not solve_positive(N, gradient, phi):
            break
        turn_left(phi, R)
    return top, max(best, 0.0) / np.sin(inlier) ** 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def summit_radius(groups: Groups, R: F64, best: float, inner: float, inlier: float) -> float:
    """The largest angle found such that no rotation from `inner` to it off R has more consensus than `best`; `inner` when nothing is proven.

    About a summit the sure inliers' part is concave. To second order, with the bound on the third, it falls faster than the others can add."""
    reach, s2, excess = inner, np.sin(inlier) ** 2, np.empty((3, 3))
    gradient, solution = np.empty(3), np.empty(3)
    while SUMMIT_STEP * reach < inlier:
        wider = SUMMIT_STEP * reach
        near = near_rotation(groups, R, wider, inlier)
        pulls = _pulls(near.sure, R)
        squares, weight, slope = _first_order(near, R, pulls, gradient)
        highest = squares - np.cos(inlier) ** 2 * weight + near.constant + slope * wider + 2.0 / 3.0 * weight * wider**3
        spare = min((best - ROUNDING * groups.total) * s2 - highest, 0.0)
        _hessian(near.sure, R, pulls, excess)
        for a in range(3):  # is the second derivative below 2 spare / reach² whatever the direction?
            for b in range(3):
                excess[a, b] = 2.0 * spare / reach**2 * (a == b) - excess[a, b]
        if not solve_positive(excess, gradient, solution):
            break
        reach = wider
    return reach


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hessian(sure: F64, R: F64, pulls: F64, out: F64) -> None:
    """Second derivative of Σ r_kᵀ M_k r_k by phi: Σ 2 [r]×ᵀ M [r]× + r (M r)ᵀ + (M r) rᵀ - 2 rᵀ M r I."""
    for a in range(3):
        for b in range(3):
            out[a, b] = 0.0
    for k in range(3):
        M = sure[k]
        along = R[0, k] * pulls[0, k] + R[1, k] * pulls[1, k] + R[2, k] * pulls[2, k]
        for a in range(3):
            x, y, z = _moved(R, k, a)
            u, v, w = M[0] * x + M[1] * y + M[2] * z, M[1] * x + M[3] * y + M[4] * z, M[2] * x + M[4] * y + M[5] * z
            out[a, a] -= 2.0 * along
            for b in range(3):
                p, q, r = _moved(R, k, b)
                out[a, b] += 2.0 * (u * p + v * q + w * r) + R[a, k] * pulls[b, k] + pulls[a, k] * R[b, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved(R: F64, k: int, a: int) -> tuple[float, float, float]:
    """e_a × r_k: how the axis moves with phi_a."""
    if a == 0:
        return 0.0, -R[2, k], R[1, k]
    if a == 1:
        return R[2, k], 0.0, -R[0, k]
    return -R[1, k], R[0, k], 0.0
