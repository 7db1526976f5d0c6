"""Branch and bound over all rotations for the greatest consensus of directions on three orthogonal axes (Hartley and Kahl, IJCV 2009; Bazin et al.,
ACCV 2012; Joo et al., CVPR 2016, TPAMI 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.algebra.small_linear import turn_left
from trihedron.plugins.numerics.axes.consensus import ROUNDING, climb, consensus_bound, summit_radius
from trihedron.plugins.numerics.axes.direction_groups import Groups, group_directions
from trihedron.plugins.numerics.axes.sphere_grid import Neighbours, SphereGrid, cell_of, coarser, largest_near, neighbours, sphere_grid

HALF_WIDTH = np.pi / 4.0  # of a cube of rotation vectors that holds an equivalent of every rotation: the nearest has |n_i| tan(θ/2) <= tan 22.5°
FIRST = 8  # cubes a side to begin with: rotations up to 9.7° from a centre
FACE = (12, 24, 48)  # cells a face of the maps for the first levels, whose cubes are 9.7°, 4.9° and 2.4° in radius
LEVELS = 14
STEPS = 20  # most steps of a climb
CLIMBS = 8  # most climbs a level


class Optimum(NamedTuple):
    """What a search found and proved."""

    R: F64  # (3, 3)
    consensus: float
    upper: float  # no rotation has more
    cubes: int  # looked at
    open: int  # left undecided at the work limit: 0 when nothing further than the certificate from R is better


class Maps(NamedTuple):
    """The extended Gaussian image: for each cell an upper bound of what an axis anywhere in it, or near it, adds to the consensus."""

    cells: F64  # (3 · 48²,) an axis in the cell
    near: tuple[F64, F64, F64]  # one a level: an axis within the radius of the level's cubes of the cell


@dataclass(frozen=True)
class RotationSearch:
    """Best rotation for weighted directions, from anywhere, with a proof. Angles in rad.

    The rotations are covered by cubes of rotation vectors `v` in `R_start Exp(v)`, of half side σ; every rotation of a cube is within √3 σ of its
    centre (Hartley and Kahl). Level by level a cube is dropped when even its upper bound is not above the best consensus found, else split in eight.
    The first bounds are three look-ups in maps on the sphere, the later ones sums over all directions (`consensus_bound`)."""

    inlier: float  # τ of the consensus
    certificate: float  # rotations this near to the best one need not be told from it
    slack: float  # share of the best consensus by which another must be better to count
    max_cubes: int  # work limit

    def __call__(self, vectors: F64, weights: F64, start: F64) -> Optimum:
        """The optimum for directions (n, 3) of any length but 0 and weights (n,); rows that are not finite or weigh nothing are left out. `start`
        (3, 3) is the first guess and the middle of the search; the result is proven whatever it is."""
        unit, weights = _usable(vectors, weights)
        if len(unit) == 0:
            return Optimum(start, 0.0, 0.0, 0, 0)
        cells = _image(unit, weights, self._grid, self._cones, self.inlier)
        middle = coarser(cells, FACE[2])
        near = [largest_near(values, reach) for values, reach in zip((coarser(middle, FACE[1]), middle, cells), self._reaches)]
        maps = Maps(cells, (near[0], near[1], near[2]))
        found = _search(group_directions(unit, weights), maps, start, self.inlier, self.certificate, self.slack, self.max_cubes)
        return Optimum(*found)

    def consensus(self, vectors: F64, weights: F64, R: F64) -> float:
        """C(R) of the same directions."""
        unit, weights = _usable(vectors, weights)
        square = np.max((unit @ R) ** 2, axis=1, initial=0.0)
        return float(weights @ np.maximum(square - np.cos(self.inlier) ** 2, 0.0)) / np.sin(self.inlier) ** 2

    @cached_property
    def _grid(self) -> SphereGrid:
        return sphere_grid(FACE[2])

    @cached_property
    def _cones(self) -> Neighbours:
        """Cells within τ of each."""
        return neighbours(self._grid, self.inlier)

    @cached_property
    def _reaches(self) -> list[Neighbours]:
        """For each level the cells within the radius of its cubes of each."""
        return [neighbours(sphere_grid(face), np.sqrt(3.0) * HALF_WIDTH / FIRST / 2**level) for level, face in enumerate(FACE)]


def _usable(vectors: F64, weights: F64) -> tuple[F64, F64]:
    """The finite directions, made unit, with positive weights."""
    length = np.linalg.norm(vectors, axis=1)
    good = np.isfinite(length) & (length > 1e-6) & np.isfinite(weights) & (weights > 0.0)
    return vectors[good] / length[good, None], weights[good]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _image(vectors: F64, weights: F64, grid: SphereGrid, cones: Neighbours, inlier: float) -> F64:
    """(cells,) upper bound of the consensus of one axis anywhere in a cell: directions count by their angle to the cell, not to its centre."""
    out, face, steep = np.zeros(len(grid.radii)), int(np.sqrt(len(grid.radii) / 3.0) + 0.5), 1.0 / np.sin(inlier) ** 2
    cosine, sine = np.cos(grid.radii), np.sin(grid.radii)
    for i in range(len(vectors)):
        x, y, z, w = vectors[i, 0], vectors[i, 1], vectors[i, 2], weights[i]
        own = cell_of(x, y, z, face)
        for k in range(cones.first[own], cones.first[own + 1]):
            c = cones.cells[k]
            dot = abs(x * grid.centres[c, 0] + y * grid.centres[c, 1] + z * grid.centres[c, 2])
            if dot >= cosine[c]:
                out[c] += w
            else:
                off = np.sqrt(max(1.0 - dot * dot, 0.0)) * cosine[c] - dot * sine[c]  # sine of the angle to the cell
                out[c] += w * max(1.0 - off * off * steep, 0.0)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(values: F64, R: F64) -> float:
    """Sum of a map over the cells in which the axes of R lie."""
    face, total = int(np.sqrt(len(values) / 3.0) + 0.5), 0.0
    for k in range(3):
        total += values[cell_of(R[0, k], R[1, k], R[2, k], face)]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def angle_to_equivalent(R: F64, Q: F64) -> float:
    """Angle between R and the nearest of the 24 equivalents of Q, exact when below 45° and else at least that."""
    trace = 0.0
    for i in range(3):
        largest = 0.0
        for j in range(3):
            largest = max(largest, abs(R[0, i] * Q[0, j] + R[1, i] * Q[1, j] + R[2, i] * Q[2, j]))
        trace += largest
    return np.arccos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _split(cubes: F64, half: float) -> F64:
    """Centres (8 n, 3) of the eighths of cubes (n, 3), `half` being the half side of the eighths."""
    out = np.empty((8 * len(cubes), 3))
    for i in range(len(out)):
        for k in range(3):
            out[i, k] = cubes[i // 8, k] + (half if (i >> k) & 1 else -half)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_cubes() -> F64:
    cubes, half = np.zeros((1, 3)), HALF_WIDTH
    while len(cubes) < FIRST**3:
        half *= 0.5
        cubes = _split(cubes, half)
    return cubes


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _centre(cube: F64, start: F64, R: F64) -> None:
    """Write the rotation in the middle of a cube, `R_start Exp(v)`, to R."""
    for k in range(9):
        R[k % 3, k // 3] = start[k // 3, k % 3]
    turn_left((-cube[0], -cube[1], -cube[2]), R)  # Exp(-v) R_startᵀ
    for i in range(3):
        for j in range(i):
            R[i, j], R[j, i] = R[j, i], R[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _climb_promising(groups: Groups, cubes: F64, values: F64, start: F64, inlier: float, top: F64, best: float, exact: bool) -> tuple[F64, float]:
    """The best summit: `top` or that of a slope on which one of the most promising centres is. `values` is used up."""
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
            summit, consensus = climb(groups, R, inlier, STEPS)
            if consensus > best * (1.0 + 1e-9):
                top, best = summit, consensus
    return top, best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    groups: Groups, maps: Maps, start: F64, inlier: float, certificate: float, slack: float, max_cubes: int
) -> tuple[F64, float, float, int, int]:
    """The fields of `Optimum`."""
    top, best = climb(groups, start, inlier, STEPS)
    cubes, half, level, used = _first_cubes(), HALF_WIDTH / FIRST, 0, 0
    aside, passed, R = False, 0.0, np.empty((3, 3))
    while True:
        used += len(cubes)
        radius = np.sqrt(3.0) * half
        uppers, values = _bounds(groups, maps, cubes, level, radius, start, inlier, best)
        before = best
        top, best = _climb_promising(groups, cubes, values, start, inlier, top, best, level + 1 >= len(maps.near))
        if best > before and aside and used + FIRST**3 <= max_cubes:  # what was set aside was near another summit: once more, knowing this one
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
