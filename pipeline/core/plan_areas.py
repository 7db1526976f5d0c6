"""Areas of the rooms of a building with what is not certain of them: where their walls are, and what may be otherwise than the plan has it."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import F64, Building

TAIL = 0.025  # of a 95 % interval, on each side
OPEN_M, OPEN_PROBABILITY = 0.5, 0.3  # how far a room goes on beyond an edge that nothing bounds, if it does
OPEN_SIGMA_M = round(OPEN_M * sqrt(OPEN_PROBABILITY), 2)  # of the offset of such an edge
MOST = 8  # doubts that are combined; what the others would change is added to the variance
STEPS = 60  # of the bisection


def area_sigma(building: Building, *rooms: int) -> float:
    """Return the standard deviation of the area of rooms, which are independent of each other, m²."""
    doubts = _doubts(building, rooms)
    return float(np.sqrt(building.area_variance[list(rooms)].sum() + _variances(doubts).sum()))


def area_interval(building: Building, *rooms: int) -> tuple[float, float]:
    """Return the 95 % interval of the area of rooms, m²: of the mixture of normal distributions in which each doubt is true or not. The rooms are
    independent of each other."""
    doubts, area = _doubts(building, rooms), float(building.areas_m2[list(rooms)].sum())
    doubts = doubts[np.argsort(-_variances(doubts), kind="stable")]
    sigma = sqrt(max(float(building.area_variance[list(rooms)].sum() + _variances(doubts[MOST:]).sum()), 1e-12))
    weights, shifts = np.ones(1), np.zeros(1)
    for change, probability in doubts[:MOST]:
        weights = np.concatenate([weights * (1.0 - probability), weights * probability])
        shifts = np.concatenate([shifts, shifts + change])
    low, high = (_quantile(weights, shifts, sigma, share) for share in (TAIL, 1.0 - TAIL))
    return max(area + low, 0.0), area + high


def edge_sigma(building: Building, corner: int) -> float:
    """Return the standard deviation of the offset, in its room, of the edge that begins at a corner, m."""
    sigma = float(building.edge_sigma_m[corner])
    return sigma if np.isfinite(sigma) else OPEN_SIGMA_M


def edges_of(building: Building, room: int) -> Iterator[tuple[F64, F64, int]]:
    """Yield the edges of a room: their ends (2,), and the wall of each, -1 where nothing bounds what was seen."""
    for of, a, b in building.loops:
        if of == room:
            corners = building.corners_m[a:b]
            yield from zip(corners, np.roll(corners, -1, axis=0), building.corner_walls[a:b].tolist())


def seen_share(building: Building, room: int) -> float:
    """Return the share of a room's outline that readings show, 0 to 1; openings count as seen."""
    total = unseen = 0.0
    for p, q, wall in edges_of(building, room):
        length = float(norm(q - p))
        total += length
        unseen += length if wall < 0 else min(_unseen_m(building, wall, p, q), length)
    return 1.0 - unseen / total if total else 0.0


def _doubts(building: Building, rooms: tuple[int, ...]) -> F64:
    """Return change and probability (n, 2) of the doubts about rooms."""
    return np.asarray(building.doubts[np.isin(building.doubts[:, 0], rooms), 1:], np.float64)


def _variances(doubts: F64) -> F64:
    """Return what each of (n, 2) doubts adds to the variance of an area, m⁴."""
    return np.asarray(doubts[:, 0] ** 2 * doubts[:, 1] * (1.0 - doubts[:, 1]), np.float64)


def _quantile(weights: F64, shifts: F64, sigma: float, share: float) -> float:
    """Return the quantile of a mixture of normal distributions of one standard deviation, by bisection."""
    from scipy.special import ndtr

    low, high = float(shifts.min()) - 6.0 * sigma, float(shifts.max()) + 6.0 * sigma
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        below = float((weights * ndtr((middle - shifts) / sigma)).sum())
        low, high = (middle, high) if below < share else (low, middle)
    return 0.5 * (low + high)


def _unseen_m(building: Building, wall: int, p: F64, q: F64) -> float:
    """Return the length of the stretch p to q of a wall without a reading, m."""
    start, end = building.walls_m[wall]
    along = (end - start) / max(float(norm(end - start)), 1e-9)
    a, b = sorted((float(matmul(p - start, along)), float(matmul(q - start, along))))
    return float(sum(max(min(b, stop) - max(a, begin), 0.0) for of, begin, stop in building.unseen if int(of) == wall))
