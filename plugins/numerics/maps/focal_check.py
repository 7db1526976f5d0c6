"""What keyframes say of the focal lengths they were told: seen from two sides, points keep their distances only under the right ones.

A point stands at `((u - cx) / f, (v - cy) / f, 1) · depth`. Under wrong focal lengths the same points are squeezed along other directions in each
view, and no rigid motion takes one view to the other. So the keyframes' own measurements, whatever their poses, say by which factor `f` is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numba
import numpy as np

from trihedron.pipeline.geometry import rotation_angle_deg
from trihedron.pipeline.types import F32, F64, I32, Map
from trihedron.plugins.numerics.algebra.small_linear import polar_rotation
from trihedron.plugins.numerics.maps.keyframe_features import measured_points
from trihedron.plugins.numerics.maps.local_window import newest_keyframes

KEYFRAMES, LEAST_POINTS, LEAST_PAIRS, MOST_POINTS = 8, 30, 3, 100
PIXEL = 1.0  # standard deviation of a point, px
CUT = 3.0  # standard deviations at which a point counts half (Geman and McClure)
FACTORS = np.exp(np.linspace(np.log(0.7), -np.log(0.7), 5))


@dataclass(frozen=True)
class FocalCheck:
    """The factor under which the keyframes fit best, and how many times worse they fit under those they were told."""

    factor: float
    worse: float


    def doubt(self, off: float, worse: float) -> str:
        """Why to doubt, where the keyframes fit by a share `worse` worse under the focal lengths told than under others, a share `off` away;
        else ''."""
        if abs(np.log(self.factor)) <= np.log1p(off) or self.worse <= 1.0 + worse:
            return ""
        return f"keyframes fit each other with focal lengths {self.factor:.2f} times as long; is the camera right?"

    def covariance(self, T_first_camera: F64, depths_m: F32) -> F64:
        """(6, 6) about what the factor does to a pose T_first_camera (4, 4) from the first keyframe that sees points at these depths (NaN: none): a
        turn is wrong by that share of it, and so is a shift, which at a distance a turn is mistaken for."""
        seen = depths_m[np.isfinite(depths_m)]
        wrong, angle = np.log(self.factor), np.radians(rotation_angle_deg(T_first_camera[:3, :3]))
        shift_m = float(np.linalg.norm(T_first_camera[:3, 3])) + (float(np.median(seen)) if len(seen) else 0.0) * angle
        return np.diag(np.repeat([(wrong * shift_m) ** 2, (wrong * angle) ** 2], 3))


def focal_check(map: Map) -> FocalCheck | None:
    """What the newest keyframes say; None while they are too few, share too little, or see it all from one place."""
    if "focal" not in map.memo:
        map.memo["focal"] = _checked(map)
    found: FocalCheck | None = map.memo["focal"]
    return found


def _checked(map: Map) -> FocalCheck | None:
    seen = [_measured(map, int(row)) for row in newest_keyframes(map, KEYFRAMES)]
    pairs = [pair for a, b in combinations(seen, 2) if (pair := _shared(a, b)) is not None]
    if len(pairs) < LEAST_PAIRS:
        _cost(np.empty((0, 5)), np.empty((0, 5)), 1.0)  # compiled on the first keyframe, before the clock starts
        return None
    total = np.full(len(FACTORS), np.inf)
    middle = len(FACTORS) // 2
    total[middle - 1 : middle + 2] = [_total(pairs, factor) for factor in FACTORS[middle - 1 : middle + 2]]
    if np.argmin(total) != middle:  # rarely; the farther ones are needed then
        total[[0, -1]] = [_total(pairs, factor) for factor in FACTORS[[0, -1]]]
    best = int(np.argmin(total))
    if not 0 < best < len(FACTORS) - 1:  # no least one: views from one place say nothing, and noise the rest
        return None
    a, b, c = total[best - 1 : best + 2]
    step = 0.5 * (a - c) / max(a - 2.0 * b + c, 1e-9)  # of the parabola through the least and its neighbours
    factor = float(FACTORS[best] * (FACTORS[1] / FACTORS[0]) ** step)
    return FocalCheck(factor, float(total[middle] / total[best]))


def _measured(map: Map, keyframe: int) -> tuple[I32, F64]:
    """Ids (n,) of the points that a keyframe measured with depth, sorted; and (n, 5) x, y, z, and the σ of depth and of a pixel there, m."""
    ids, places, sigma_m, _ = measured_points(map, keyframe)
    fx = map.keyframes.rows("intrinsics", np.array([keyframe]))[0, 0]
    return ids, np.column_stack([places, sigma_m, PIXEL * places[:, 2] / fx])


def _shared(a: tuple[I32, F64], b: tuple[I32, F64]) -> tuple[F64, F64] | None:
    """What two keyframes measured of the same points; None where these are too few."""
    _, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    every = -(-len(i) // MOST_POINTS)
    return (a[1][i[::every]], b[1][j[::every]]) if len(i) >= LEAST_POINTS else None


def _total(pairs: list[tuple[F64, F64]], factor: float) -> float:
    """What the best rigid motions between views leave under focal lengths that are `factor` times as long."""
    return sum(_cost(a, b, factor) for a, b in pairs)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cost(a: F64, b: F64, factor: float) -> float:
    """Robust cost, 0 to 1, of the best rigid motion (Procrustes, reweighted) between n points measured twice, (n, 5) as of `_measured`."""
    n = len(a)
    p, q, sigma, weight, cost = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n), 0.0
    for k in range(n):
        p[k, 0], p[k, 1], p[k, 2] = a[k, 0] / factor, a[k, 1] / factor, a[k, 2]
        q[k, 0], q[k, 1], q[k, 2] = b[k, 0] / factor, b[k, 1] / factor, b[k, 2]
        sigma[k] = math.sqrt(a[k, 3] ** 2 + b[k, 3] ** 2 + (a[k, 4] ** 2 + b[k, 4] ** 2) / factor**2)
        weight[k] = 1.0 / sigma[k] ** 2
    for _ in range(3):
        total, middles, products = 0.0, np.zeros((2, 3)), np.zeros((3, 3))
        for k in range(n):
            total += weight[k]
        for k in range(n):
            weight[k] /= total
            for c in range(3):
                middles[0, c] += weight[k] * p[k, c]
                middles[1, c] += weight[k] * q[k, c]
        for k in range(n):
            for r in range(3):
                for c in range(3):
                    products[r, c] += weight[k] * (p[k, r] - middles[0, r]) * (q[k, c] - middles[1, c])
        R, cost = polar_rotation(products), 0.0
        for k in range(n):
            left = 0.0
            for c in range(3):
                at = -(q[k, c] - middles[1, c])
                for r in range(3):
                    at += (p[k, r] - middles[0, r]) * R[r, c]
                left += at * at
            square = left / (CUT * sigma[k]) ** 2
            cost += square / (1.0 + square)
            weight[k] = 1.0 / (sigma[k] * (1.0 + square)) ** 2
    return cost / n
