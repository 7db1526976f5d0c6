"""What keyframes say of the focal lengths they were told: seen from two sides, points keep their distances only under the right ones.

A point stands at `((u - cx) / f, (v - cy) / f, 1) · depth`. Under wrong focal lengths the same points are squeezed along other directions in each
view, and no rigid motion takes one view to the other. So the keyframes' own measurements, whatever their poses, say by which factor `f` is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import rotation_angle_deg
from trihedron.pipeline.core.types import F32, F64, I32, Map
from trihedron.plugins.numerics.algebra.small_linear import polar_rotation
from trihedron.plugins.numerics.maps.local_window import newest_keyframes

KEYFRAMES, LEAST_POINTS, LEAST_PAIRS, MOST_POINTS = 8, 30, 3, 100
PIXEL = 1.0  # standard deviation of a point, px
CUT = 3.0  # standard deviations at which a point counts half (Geman and McClure)
ROW_BITS, VIEW_BITS = 20, 51  # of a number that is sorted by view, id and row
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
    keyframes = newest_keyframes(map, KEYFRAMES)
    if not len(keyframes):
        return None
    seen, middle = _measured(map, keyframes), len(FACTORS) // 2
    total = np.full(len(FACTORS), np.inf)
    total[middle - 1 : middle + 2], pairs = _totals(*seen, FACTORS[middle - 1 : middle + 2].copy())
    if pairs < LEAST_PAIRS:
        return None
    if np.argmin(total) != middle:  # rarely; the farther ones are needed then
        total[[0, -1]] = _totals(*seen, FACTORS[[0, -1]])[0]
    best = int(np.argmin(total))
    if not 0 < best < len(FACTORS) - 1:  # no least one: views from one place say nothing, and noise the rest
        return None
    a, b, c = total[best - 1 : best + 2]
    step = 0.5 * (a - c) / max(a - 2.0 * b + c, 1e-9)  # of the parabola through the least and its neighbours
    factor = float(FACTORS[best] * (FACTORS[1] / FACTORS[0]) ** step)
    return FocalCheck(factor, float(total[middle] / total[best]))


def _measured(map: Map, keyframes: I32) -> tuple[NDArray[np.int64], I32, F64]:
    """What the keyframes (k,) saw, n rows in all: which rows are which points, a number of keyframe, id and row each (`ROW_BITS`), sorted; the ids
    (n,); and (n, 5) x, y, z, and the σ of depth and of a pixel there, m, NaN without depth."""
    ranges, intrinsics = map.keyframes.gathered(keyframes, "points", "intrinsics")
    rows, views = np.concatenate([np.arange(first, end) for first, end in ranges]), np.repeat(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0])
    ids, pixels, depths_m, sigmas_m = map.point_observations.gathered(rows, "point", "pixel", "depth_m", "sigma_m")
    order = np.sort((views << VIEW_BITS) + (ids.astype(np.int64) << ROW_BITS) + np.arange(len(ids)))
    return order, ids, _places(views, pixels, depths_m, sigmas_m, intrinsics)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _places(views: NDArray[np.int64], pixels: F32, depths_m: F32, sigmas_m: F32, intrinsics: F64) -> F64:
    """(n, 5) measurements of `_measured`, of what the `views` (n,) with intrinsics (k, 4) saw at pixels (n, 2)."""
    out = np.empty((len(views), 5))
    for i in range(len(views)):
        view, depth = views[i], float(depths_m[i])
        fx, fy, cx, cy = intrinsics[view, 0], intrinsics[view, 1], intrinsics[view, 2], intrinsics[view, 3]
        out[i, 0], out[i, 1], out[i, 2] = (pixels[i, 0] - cx) / fx * depth, (pixels[i, 1] - cy) / fy * depth, depth
        out[i, 3], out[i, 4] = sigmas_m[i], PIXEL * depth / fx
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _totals(order: NDArray[np.int64], ids: I32, seen: F64, factors: F64) -> tuple[F64, int]:
    """What the best rigid motions between the views leave under focal lengths that are by these factors as long, and how many pairs of views saw
    enough of the same points."""
    rows, starts = _distinct(order, seen)
    views = len(starts) - 1
    totals, pairs = np.zeros(len(factors)), 0
    left, right = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    for a in range(views):
        for b in range(a + 1, views):
            shared, i, j = 0, starts[a], starts[b]
            while i < starts[a + 1] and j < starts[b + 1]:
                one, other = ids[rows[i]], ids[rows[j]]
                if one == other:
                    left[shared], right[shared] = rows[i], rows[j]
                    shared += 1
                i, j = i + (one <= other), j + (other <= one)
            if shared < LEAST_POINTS:
                continue
            every, pairs = -(-shared // MOST_POINTS), pairs + 1
            p, q = np.empty((-(-shared // every), 5)), np.empty((-(-shared // every), 5))
            for k in range(len(p)):
                for c in range(5):
                    p[k, c], q[k, c] = seen[left[k * every], c], seen[right[k * every], c]
            for k in range(len(factors)):
                totals[k] += _cost(p, q, factors[k])
    return totals, pairs


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distinct(order: NDArray[np.int64], seen: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first row with depth of each point of each view, by views and ids, and where the views' rows begin and the last one's end."""
    views = (order[-1] >> VIEW_BITS) + 1 if len(order) else 0
    rows, starts, count, last = np.empty(len(order), np.int64), np.zeros(views + 1, np.int64), 0, -1
    for number in order:
        row, point = number & ((1 << ROW_BITS) - 1), number >> ROW_BITS
        if point != last and np.isfinite(seen[row, 2]):
            rows[count], last = row, point
            count += 1
            starts[(number >> VIEW_BITS) + 1] = count
    for view in range(views):  # of views without any
        starts[view + 1] = max(starts[view + 1], starts[view])
    return rows, starts


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
    S = np.empty((3, 3))
    for _ in range(3):
        total, p0, p1, p2, q0, q1, q2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            total += weight[k]
        for k in range(n):
            weight[k] /= total
            w = weight[k]
            p0, p1, p2 = p0 + w * p[k, 0], p1 + w * p[k, 1], p2 + w * p[k, 2]
            q0, q1, q2 = q0 + w * q[k, 0], q1 + w * q[k, 1], q2 + w * q[k, 2]
        s00, s01, s02, s10, s11, s12, s20, s21, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            w, x, y, z = weight[k], q[k, 0] - q0, q[k, 1] - q1, q[k, 2] - q2
            u, v, w = w * (p[k, 0] - p0), w * (p[k, 1] - p1), w * (p[k, 2] - p2)
            s00, s01, s02 = s00 + u * x, s01 + u * y, s02 + u * z
            s10, s11, s12 = s10 + v * x, s11 + v * y, s12 + v * z
            s20, s21, s22 = s20 + w * x, s21 + w * y, s22 + w * z
        S[0, 0], S[0, 1], S[0, 2], S[1, 0], S[1, 1], S[1, 2], S[2, 0], S[2, 1], S[2, 2] = s00, s01, s02, s10, s11, s12, s20, s21, s22
        R, cost = polar_rotation(S), 0.0
        for k in range(n):
            u, v, w, left = p[k, 0] - p0, p[k, 1] - p1, p[k, 2] - p2, 0.0
            for c in range(3):
                at = -(q[k, c] - (q0 if c == 0 else q1 if c == 1 else q2)) + u * R[0, c] + v * R[1, c] + w * R[2, c]
                left += at * at
            square = left / (CUT * sigma[k]) ** 2
            cost += square / (1.0 + square)
            weight[k] = 1.0 / (sigma[k] * (1.0 + square)) ** 2
    return cost / n
