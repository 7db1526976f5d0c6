"""What keyframes say of the focal lengths they were told: seen from two sides, points keep their distances only under the right ones.

A point stands at `((u - cx) / f, (v - cy) / f, 1) · depth`. Under wrong focal lengths the same points are squeezed along other directions in each
view, and no rigid motion takes one view to the other. So the keyframes' own measurements, whatever their poses, say by which factor `f` is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from trihedron.pipeline.types import F64, I32, Map
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


def wrong_focal(map: Map, off: float, worse: float) -> str:
    """Why to doubt, where the newest keyframes fit by a share `worse` worse under the focal lengths told than
    under others, a share `off` away; else ''."""
    found = focal_check(map)
    if found is None or abs(np.log(found.factor)) <= np.log1p(off) or found.worse <= 1.0 + worse:
        return ""
    return f"keyframes fit each other with focal lengths {found.factor:.2f} times as long; is the camera right?"


def focal_check(map: Map) -> FocalCheck | None:
    """What the newest keyframes say; None while they are too few, share too little, or see it all from one place."""
    if "focal" not in map.memo:
        map.memo["focal"] = _checked(map)
    found: FocalCheck | None = map.memo["focal"]
    return found


def _checked(map: Map) -> FocalCheck | None:
    seen = [_measured(map, int(row)) for row in newest_keyframes(map, KEYFRAMES)]
    costs = [cost for a, b in combinations(seen, 2) if (cost := _cost(a, b)) is not None]
    if len(costs) < LEAST_PAIRS:
        return None
    total = np.sum(costs, axis=0)
    best = int(np.argmin(total))
    if not 0 < best < len(FACTORS) - 1:  # no least one: views from one place say nothing, and noise the rest
        return None
    a, b, c = total[best - 1 : best + 2]
    step = 0.5 * (a - c) / max(a - 2.0 * b + c, 1e-9)  # of the parabola through the least and its neighbours
    factor = float(FACTORS[best] * (FACTORS[1] / FACTORS[0]) ** step)
    return FocalCheck(factor, float(total[len(FACTORS) // 2] / total[best]))


def _measured(map: Map, keyframe: int) -> tuple[I32, F64, F64]:
    """Ids (n,) of the points that a keyframe measured with depth, sorted; rays times depth under each factor (f, n, 3), and their σ
    (f, n), m."""
    first, end = map.keyframes.rows("points", np.array([keyframe]))[0]
    fx, fy, cx, cy = map.keyframes.rows("intrinsics", np.array([keyframe]))[0]
    ids, pixel, depth, sigma = map.point_observations.gathered(np.arange(first, end), "point", "pixel", "depth_m", "sigma_m")
    known = np.flatnonzero(np.isfinite(depth))
    known = known[np.unique(ids[known], return_index=True)[1]]
    u, z = pixel[known].astype(np.float64), depth[known].astype(np.float64)
    flat = np.stack([(u[:, 0] - cx) / fx * z, (u[:, 1] - cy) / fy * z], axis=-1)
    places = np.concatenate([flat / FACTORS[:, None, None], np.broadcast_to(z[:, None], (len(FACTORS), len(z), 1))], axis=-1)
    return ids[known], places, np.hypot(sigma[known].astype(np.float64), PIXEL * z / (fx * FACTORS[:, None]))


def _cost(a: tuple[I32, F64, F64], b: tuple[I32, F64, F64]) -> F64 | None:
    """(f,) robust cost of the best rigid motion between two views under each factor; None where they share too few points."""
    _, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    if len(i) < LEAST_POINTS:
        return None
    every = -(-len(i) // MOST_POINTS)
    i, j = i[::every], j[::every]
    p, q, sigma = a[1][:, i], b[1][:, j], np.hypot(a[2][:, i], b[2][:, j])
    weights = 1.0 / sigma**2
    square = np.zeros(p.shape[:2])
    for _ in range(3):
        square = (_residuals(p, q, weights) / (CUT * sigma)) ** 2
        weights = 1.0 / (sigma * (1.0 + square)) ** 2
    return np.asarray((square / (1.0 + square)).mean(axis=1), np.float64)


def _residuals(p: F64, q: F64, weights: F64) -> F64:
    """(f, n) distances left by the rigid motions (Procrustes) of points p onto q, (f, n, 3)."""
    share = (weights / weights.sum(axis=1, keepdims=True))[..., None]
    p, q = p - (share * p).sum(axis=1, keepdims=True), q - (share * q).sum(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(share * p, 1, 2) @ q)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return np.asarray(np.linalg.norm(p @ (U @ Vt) - q, axis=-1), np.float64)
