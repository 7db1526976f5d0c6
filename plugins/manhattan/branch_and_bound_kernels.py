"""Numba kernels of `branch_and_bound.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.lie_kernels import left_multiply_exp

# Branch and bound over all rotations for the greatest consensus of directions on three orthogonal axes (Hartley and Kahl, IJCV 2009; Bazin et al.,
# ACCV 2012; Joo et al., CVPR 2016, TPAMI 2020).

HALF_WIDTH = np.pi / 4.0  # of a cube of rotation vectors that holds an equivalent of every rotation: the nearest has |n_i| tan(θ/2) <= tan 22.5°
FIRST = 8  # cubes a side to begin with: rotations up to 9.7° from a centre
LEVELS = 14
STEPS = 20  # most steps of a climb
CLIMBS = 8  # most climbs a level


class Maps(NamedTuple):
    """The extended Gaussian image: for each cell an upper bound of what an axis anywhere in it, or near it, adds to the consensus."""

    cells: F64  # (3 · 48²,) an axis in the cell
    near: tuple[F64, F64, F64]  # one a level: an axis within the radius of the level's cubes of the cell


@kernel
def image(groups: Groups, grid: SphereGrid, cones: Neighbours, inlier: float) -> F64:
    """(cells,) upper bound of the consensus of one axis anywhere in a cell: all of a group count by the least angle that one of them can have to the
    cell. `cones` reach from a group's mean over the group and `inlier`."""
    out, face, steep = np.zeros(len(grid.radii)), int(np.sqrt(len(grid.radii) / 3.0) + 0.5), 1.0 / np.sin(inlier) ** 2
    cell_cosine, cell_sine = np.cos(grid.radii), np.sin(grid.radii)
    for g in range(len(groups.means)):
        x, y, z, group_cosine, group_sine = groups.means[g]
        w, own = groups.moments[g, 6], cell_of(x, y, z, face)
        for k in range(cones.first[own], cones.first[own + 1]):
            c = cones.cells[k]
            dot = abs(x * grid.centres[c, 0] + y * grid.centres[c, 1] + z * grid.centres[c, 2])
            cosine = cell_cosine[c] * group_cosine - cell_sine[c] * group_sine  # of both radii together
            if dot >= cosine:
                out[c] += w
            else:
                sine = cell_sine[c] * group_cosine + cell_cosine[c] * group_sine
                off = np.sqrt(max(1.0 - dot * dot, 0.0)) * cosine - dot * sine  # sine of the angle between group and cell
                out[c] += w * max(1.0 - off * off * steep, 0.0)
    return out


@kernel
def _look_up(values: F64, R: F64) -> float:
    """Sum of a map over the cells in which the axes of R lie."""
    face, total = int(np.sqrt(len(values) / 3.0) + 0.5), 0.0
    for k in range(3):
        total += values[cell_of(R[0, k], R[1, k], R[2, k], face)]
    return total


@kernel
def angle_to_equivalent(R: F64, Q: F64) -> float:
    """Angle between R and the nearest of the 24 equivalents of Q, exact when below 45° and else at least that."""
    trace = 0.0
    for i in range(3):
        largest = 0.0
        for j in range(3):
            largest = max(largest, abs(R[0, i] * Q[0, j] + R[1, i] * Q[1, j] + R[2, i] * Q[2, j]))
        trace += largest
    return np.arccos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))


@kernel
def _split(cubes: F64, half: float) -> F64:
    """Centres (8 n, 3) of the eighths of cubes (n, 3), `half` being the half side of the eighths."""
    out = np.empty((8 * len(cubes), 3))
    for i in range(len(out)):
        for k in range(3):
            out[i, k] = cubes[i // 8, k] + (half if (i >> k) & 1 else -half)
    return out


@kernel
def _first_cubes() -> F64:
    cubes, half = np.zeros((1, 3)), HALF_WIDTH
    while len(cubes) < FIRST**3:
        half *= 0.5
        cubes = _split(cubes, half)
    return cubes


@kernel
def cube_radius(half: float) -> float:
    """Largest angle (rad) between the rotation in the centre of a cube of rotation vectors of half side `half` (rad) and any other of the cube: at
    most that of the vectors, whose furthest are the corners (Hartley and Kahl, IJCV 2009)."""
    return np.sqrt(3.0) * half


@kernel
def _centre(cube: F64, start: F64, R: F64) -> None:
    """Write the rotation in the middle of a cube, `R_start Exp(v)`, to R."""
    for k in range(9):
        R[k % 3, k // 3] = start[k // 3, k % 3]
    left_multiply_exp((-cube[0], -cube[1], -cube[2]), R)  # Exp(-v) R_startᵀ
    for i in range(3):
        for j in range(i):
            R[i, j], R[j, i] = R[j, i], R[i, j]


@kernel
def _bounds(groups: Groups, maps: Maps, cubes: F64, level: int, radius: float, start: F64, inlier: float, best: float) -> tuple[F64, F64]:
    """For each cube an upper bound of its consensus, and the consensus of its centre: -1 when the bound is not above `best`, on the map's levels a
    guess."""
    uppers, values, R = np.empty(len(cubes)), np.empty(len(cubes)), np.empty((3, 3))
    for c in range(len(cubes)):
        _centre(cubes[c], start, R)
        upper, value = np.inf, -1.0
        if level < len(maps.near):
            upper = _look_up(maps.near[level], R) + ROUNDING * groups.total
            if upper > best:
                value = _look_up(maps.cells, R)
        if level + 1 >= len(maps.near) and upper > best:
            value, upper = consensus_bound(groups, R, radius, inlier)
        uppers[c], values[c] = upper, value
    return uppers, values


@kernel
def _climb_promising(groups: Groups, cubes: F64, values: F64, start: F64, inlier: float, top: F64, best: float, exact: bool) -> tuple[F64, float]:
    """The best maximum: `top` or that of a slope on which one of the most promising centres is. `values` is used up."""
    R = np.empty((3, 3))
    for _ in range(CLIMBS):
        c = 0
        for k in range(1, len(values)):
            if values[k] > values[c]:
                c = k
        if values[c] <= (best if exact else 0.0):
            break
        values[c] = -1.0
        _centre(cubes[c], start, R)
        if exact or angle_to_equivalent(R, top) > 0.5 * inlier:
            maximum, consensus = climb(groups, R, inlier, STEPS)
            if consensus > best * (1.0 + 1e-9):
                top, best = maximum, consensus
    return top, best


@kernel
def search(
    groups: Groups, maps: Maps, start: F64, inlier: float, certificate: float, slack: float, max_cubes: int
) -> tuple[F64, float, float, int, int]:
    """The fields of `Optimum`."""
    top, best = climb(groups, start, inlier, STEPS)
    cubes, half, level, used = _first_cubes(), HALF_WIDTH / FIRST, 0, 0
    aside, passed, R = False, 0.0, np.empty((3, 3))
    while True:
        used += len(cubes)
        radius = cube_radius(half)
        uppers, values = _bounds(groups, maps, cubes, level, radius, start, inlier, best)
        before = best
        top, best = _climb_promising(groups, cubes, values, start, inlier, top, best, level + 1 >= len(maps.near))
        if best > before and aside and used + FIRST**3 <= max_cubes:  # what was set aside was near another maximum: once more, knowing this one
            cubes, half, level, aside, passed = _first_cubes(), HALF_WIDTH / FIRST, 0, False, 0.0
            continue
        reach = certificate if level + 1 < len(maps.near) else summit_radius(groups, top, best, certificate, inlier)
        left, highest = 0, passed
        for c in range(len(cubes)):
            _centre(cubes[c], start, R)
            if uppers[c] > best and radius < reach and angle_to_equivalent(R, top) + radius <= reach:
                aside = True
            elif uppers[c] > best * (1.0 + slack):
                highest = max(highest, uppers[c])
                cubes[left] = cubes[c]
                left += 1
            else:
                passed = max(passed, uppers[c])
        if left == 0 or used + 8 * left > max_cubes or level + 1 == LEVELS:
            upper = consensus_bound(groups, top, certificate, inlier)[1]
            return top, best, max(best, max(upper, max(passed, highest))), used, left
        half *= 0.5
        level += 1
        cubes = _split(cubes[:left], half)


# The consensus of directions on three orthogonal axes, and upper bounds of it for all rotations near one.
#
# Of directions d_i with weights w_i a rotation R with the columns r_k has the consensus
#
#     C(R) = Σ w_i max_k q_ik,   q_ik = max(0, ((d_i·r_k)² - cos²τ) / sin²τ) = max(0, 1 - sin²θ_ik / sin²τ),
#
# the weight of the inliers, those within τ of an axis, each counting less the further off it is. (Their bare number stays the same while a rotation
# moves by degrees: its optimum has no place.) A direction that is an inlier for every rotation of a ball adds a quadratic form there, known from the
# moments of its group; only groups astride an edge of a cone are looked at one direction at a time.
#
# Bounds rest on three facts. While `Exp(t ω) R`, |ω| = 1, keeps d within β < 45° of r, the second derivative of (d·r)² by t is at most κ(β), see
# `curvature`; its third derivative is at most 4 anywhere; and its first at most |sin 2β|.

ROUNDING = 1e-9  # of all weight, added to bounds
SUMMIT_STEP = 1.08  # factor by which a ball around a maximum is widened


class Near(NamedTuple):
    """Contribution of directions to the consensus within a ball of rotations, times sin²τ."""

    sure: F64  # (3, 7) moments of the inliers that each axis has for all rotations of the ball
    torque: F64  # (3,) first derivative by phi in `Exp(phi) R` of the bound on the others
    constant: float  # and its value at the centre
    value: float  # what the others do add at the centre


@kernel
def curvature(beta: float) -> float:
    """κ(β) = cos β (1 - cos β), the second derivative when ω is midway between d and r; for every other ω it is less."""
    return np.cos(beta) * (1.0 - np.cos(beta))


@kernel
def near_rotation(groups: Groups, R: F64, radius: float, inlier: float) -> Near:
    """Contribution of directions within `radius` of R, `inlier` being τ; inlier + radius < 45°, so that no direction is near two axes.

    A direction that may enter or leave its cone adds at most max(0, p + s), p being its value and |s| <= L the change to first order. That is convex
    in s, so it is below the chord from -L to L, whose gradients are summed as a torque: directions on opposite edges of a cone cancel."""
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


@kernel
def _nearest_axis(x: float, y: float, z: float, R: F64) -> tuple[int, float]:
    axis, dot = 0, x * R[0, 0] + y * R[1, 0] + z * R[2, 0]
    for k in range(1, 3):
        other = x * R[0, k] + y * R[1, k] + z * R[2, k]
        if abs(other) > abs(dot):
            axis, dot = k, other
    return axis, dot


@kernel
def _add_cross(out: F64, factor: float, R: F64, k: int, x: float, y: float, z: float) -> None:
    """out += factor · r_k × (x, y, z)."""
    out[0] += factor * (R[1, k] * z - R[2, k] * y)
    out[1] += factor * (R[2, k] * x - R[0, k] * z)
    out[2] += factor * (R[0, k] * y - R[1, k] * x)


@kernel
def _pulls(sure: F64, R: F64) -> F64:
    """(3, 3) columns M_k r_k: half the derivative of r_kᵀ M_k r_k by r_k."""
    out = np.empty((3, 3))
    for k in range(3):
        x, y, z = R[0, k], R[1, k], R[2, k]
        out[0, k] = sure[k, 0] * x + sure[k, 1] * y + sure[k, 2] * z
        out[1, k] = sure[k, 1] * x + sure[k, 3] * y + sure[k, 4] * z
        out[2, k] = sure[k, 2] * x + sure[k, 4] * y + sure[k, 5] * z
    return out


@kernel
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


@kernel
def consensus_bound(groups: Groups, R: F64, radius: float, inlier: float) -> tuple[float, float]:
    """C(R), and an upper bound of C for all rotations within `radius` of R."""
    near = near_rotation(groups, R, radius, inlier)
    squares, weight, slope = _first_order(near, R, _pulls(near.sure, R), np.empty(3))
    total = squares - np.cos(inlier) ** 2 * weight
    rise = slope * radius + 0.5 * curvature(inlier) * weight * radius * radius
    s2 = np.sin(inlier) ** 2
    return (total + near.value) / s2, (total + near.constant + rise) / s2 + ROUNDING * groups.total


@kernel
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
        left_multiply_exp(phi, R)
    return top, max(best, 0.0) / np.sin(inlier) ** 2


@kernel
def summit_radius(groups: Groups, R: F64, best: float, inner: float, inlier: float) -> float:
    """The largest angle found such that no rotation from `inner` to it off R has more consensus than `best`; `inner` when nothing is certified.

    About a maximum the sure inliers' part is concave. To second order, with the bound on the third, it falls faster than the others can add."""
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


@kernel
def _hessian(sure: F64, R: F64, pulls: F64, out: F64) -> None:
    """Second derivative of Σ r_kᵀ M_k r_k by phi: Σ 2 [r]×ᵀ M [r]× + r (M r)ᵀ + (M r) rᵀ - 2 rᵀ M r I."""
    for a in range(3):
        for b in range(3):
            out[a, b] = 0.0
    for k in range(3):
        M = sure[k]
        along = R[0, k] * pulls[0, k] + R[1, k] * pulls[1, k] + R[2, k] * pulls[2, k]
        for a in range(3):
            x, y, z = _axis_derivative(R, k, a)
            u, v, w = M[0] * x + M[1] * y + M[2] * z, M[1] * x + M[3] * y + M[4] * z, M[2] * x + M[4] * y + M[5] * z
            out[a, a] -= 2.0 * along
            for b in range(3):
                p, q, r = _axis_derivative(R, k, b)
                out[a, b] += 2.0 * (u * p + v * q + w * r) + R[a, k] * pulls[b, k] + pulls[a, k] * R[b, k]


@kernel
def _axis_derivative(R: F64, k: int, a: int) -> tuple[float, float, float]:
    """e_a × r_k: how the axis moves with phi_a."""
    if a == 0:
        return 0.0, -R[2, k], R[1, k]
    if a == 1:
        return R[2, k], 0.0, -R[0, k]
    return -R[1, k], R[0, k], 0.0


# Directions on the sphere, antipodes being one, sorted into groups of neighbours with their moments.

CELLS = 128  # a face of the sphere's grid: a direction is 1.3° from its group's mean at most


class Groups(NamedTuple):
    """n directions in m groups, group g being rows `first[g]` to `first[g + 1]`."""

    vectors: F64  # (n, 3) unit
    weights: F64  # (n,)
    first: I32  # (m + 1,)
    means: F64  # (m, 5) unit mean, cosine and sine of the largest angle to it
    moments: F64  # (m, 7) Σ w d dᵀ (xx, xy, xz, yy, yz, zz) and Σ w
    total: float  # of the weights


@kernel
def group_directions(vectors: F64, weights: F64) -> Groups:
    """Group unit directions (n, 3) with positive weights (n,) by cells of the sphere; d and -d are the same."""
    n = CELLS
    cells = np.empty(len(vectors), np.int64)
    row, groups, total = np.zeros(3 * n * n + 1, np.int64), 0, 0.0
    for i in range(len(vectors)):
        cells[i] = cell_of(vectors[i, 0], vectors[i, 1], vectors[i, 2], n)
        groups += row[cells[i] + 1] == 0
        row[cells[i] + 1] += 1
        total += weights[i]
    first = np.zeros(groups + 1, np.int32)
    g = 0
    for c in range(3 * n * n):
        if row[c + 1] > 0:
            g += 1
            first[g] = row[c] + row[c + 1]
        row[c + 1] += row[c]
    in_order, in_order_weights = np.empty_like(vectors), np.empty_like(weights)
    for i in range(len(vectors)):
        sign = 1.0 if vectors[i, cells[i] // (n * n)] > 0.0 else -1.0
        r = row[cells[i]]
        row[cells[i]] += 1
        in_order_weights[r] = weights[i]
        for k in range(3):
            in_order[r, k] = sign * vectors[i, k]
    means, moments = np.zeros((groups, 5)), np.zeros((groups, 7))
    for g in range(groups):
        _summarise(in_order, in_order_weights, first[g], first[g + 1], means[g], moments[g])
    return Groups(in_order, in_order_weights, first, means, moments, total)


@kernel
def _summarise(vectors: F64, weights: F64, begin: int, end: int, mean: F64, moments: F64) -> None:
    """Fill a row of `Groups.means` and of `Groups.moments`."""
    for i in range(begin, end):
        add_moments(moments, weights[i], vectors[i, 0], vectors[i, 1], vectors[i, 2])
        for k in range(3):
            mean[k] += weights[i] * vectors[i, k]
    norm = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    for k in range(3):
        mean[k] /= norm
    mean[3] = 1.0
    for i in range(begin, end):
        mean[3] = min(mean[3], vectors[i, 0] * mean[0] + vectors[i, 1] * mean[1] + vectors[i, 2] * mean[2])
    mean[4] = np.sqrt(max(1.0 - mean[3] ** 2, 0.0))


@kernel
def add_moments(moments: F64, w: float, x: float, y: float, z: float) -> None:
    """Add a direction to a row of `Groups.moments`."""
    moments[0] += w * x * x
    moments[1] += w * x * y
    moments[2] += w * x * z
    moments[3] += w * y * y
    moments[4] += w * y * z
    moments[5] += w * z * z
    moments[6] += w


# Cells on the sphere, antipodes being one: a cube's three faces, each divided n by n in its own plane (gnomonic projection).
#
# Cell `(face · n + i) · n + j` holds the directions d whose largest component is `d[face]` and whose next two, divided by it, fall into the i-th and
# j-th of n parts of [-1, 1]. Finding the cell of a direction takes two divisions; a cell is 2/n rad wide in the middle of a face, half in a corner.


class SphereGrid(NamedTuple):
    """Centres (3n², 3), unit, and radii (3n²,), rad: how far from its centre a cell reaches."""

    centres: F64
    radii: F64


class Neighbours(NamedTuple):
    """Cells near each cell: those of cell j are `cells[first[j] : first[j + 1]]`."""

    first: I32
    cells: I32


@kernel
def cell_of(x: float, y: float, z: float, n: int) -> int:
    """The cell of a direction, which may have any length but 0."""
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        face, u, v = 0, y / x, z / x
    elif abs(y) >= abs(z):
        face, u, v = 1, z / y, x / y
    else:
        face, u, v = 2, x / z, y / z
    i, j = min(int(0.5 * n * (u + 1.0)), n - 1), min(int(0.5 * n * (v + 1.0)), n - 1)
    return (face * n + i) * n + j


@kernel
def neighbours(grid: SphereGrid, reach: float) -> Neighbours:
    """For each cell those with a point within `reach` (rad) of one of its own."""
    centres, radii = grid
    count, largest = len(centres), 0.0
    for j in range(count):
        largest = max(largest, radii[j])
    floor = np.cos(min(reach + 2.0 * largest, 0.5 * np.pi))
    first = np.zeros(count + 1, np.int32)
    cells = np.empty(0, np.int32)
    for fill in range(2):  # counted, then written
        total = 0
        for j in range(count):
            for k in range(count):
                dot = abs(centres[j, 0] * centres[k, 0] + centres[j, 1] * centres[k, 1] + centres[j, 2] * centres[k, 2])
                if dot > floor and np.arccos(min(dot, 1.0)) <= reach + radii[j] + radii[k] + 1e-9:
                    if fill == 1:
                        cells[total] = k
                    total += 1
            first[j + 1] = total
        if fill == 0:
            cells = np.empty(total, np.int32)
    return Neighbours(first, cells)


@kernel
def largest_near(values: F64, near: Neighbours) -> F64:
    """For each cell the largest of `values` (cells,) on its neighbours."""
    out = np.empty(len(values))
    for j in range(len(values)):
        largest = -np.inf
        for k in range(near.first[j], near.first[j + 1]):
            largest = max(largest, values[near.cells[k]])
        out[j] = largest
    return out


@kernel
def coarser(values: F64, n: int) -> F64:
    """The largest of each 2 by 2 cells: values on the grid of n / 2, n being even."""
    half = n // 2
    out = np.full(3 * half * half, -np.inf)
    for cell in range(3 * n * n):
        face, i, j = cell // (n * n), cell // n % n, cell % n
        above = (face * half + i // 2) * half + j // 2
        out[above] = max(out[above], values[cell])
    return out
