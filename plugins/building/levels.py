"""Floors and ceilings: levels of the evidence, and the storeys between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.building.evidence import LEVEL_DEG, SCALE, Evidence, mean_over_views
from trihedron.plugins.shared.voxel_hash_kernels import I64

LEAST_FLOOR_M2 = 1.0
STOREY_M = 2.0  # least height of a storey
EYE_M = (0.3, 2.4)  # of the camera above its floor
SLAB_M = 0.2  # below a floor
LEVEL_NEAR_M = 0.05  # readings of one level


@dataclass(frozen=True)
class Storey:
    """Heights of floor and ceiling and their standard deviations, metres; NaN = not seen."""

    floor_m: float
    ceiling_m: float
    floor_sigma_m: float = float("nan")
    ceiling_sigma_m: float = float("nan")
    reach_m: float = float("inf")  # the height up to which upright surfaces were seen
    next_m: float = float("inf")  # from which they are the next storey's

    @property
    def bottom_m(self) -> float:
        """Return the floor's height, or 0."""
        return self.floor_m if np.isfinite(self.floor_m) else 0.0


def storeys_of(evidence: Evidence) -> list[Storey]:
    """Find the storeys from the lowest: floors at least STOREY_M apart that a camera stood above, each with the widest ceiling over it."""
    heights, areas = _level_peaks(evidence, 1.0)
    eyes = evidence.eyes[:, 2]
    floors: list[float] = []
    for height, area in zip(heights, areas):
        below = ((eyes > height + EYE_M[0]) & (eyes < height + EYE_M[1])).any()
        wide = area >= LEAST_FLOOR_M2 * (3.0 if floors else 1.0)
        if below and wide and (not floors or height > floors[-1] + STOREY_M):
            floors.append(float(height))
    tops, areas = _level_peaks(evidence, -1.0)
    found = []
    for number, floor in enumerate(floors or [float("nan")]):
        low = floor if np.isfinite(floor) else float(eyes.min()) - 1.0
        high = floors[number + 1] if number + 1 < len(floors) else np.inf
        over = (tops > low + 1.9) & (tops < high) & (areas >= LEAST_FLOOR_M2)
        ceiling = float(tops[over][np.argmax(areas[over])]) if over.any() else float("nan")
        low_mean, low_sigma = height_of(evidence, floor, 1.0) if np.isfinite(floor) else (float("nan"), float("nan"))
        high_mean, high_sigma = height_of(evidence, ceiling, -1.0) if np.isfinite(ceiling) else (float("nan"), float("nan"))
        low_sigma, high_sigma = float(np.hypot(low_sigma, SCALE * low_mean)), float(np.hypot(high_sigma, SCALE * high_mean))
        heights = evidence.points[(evidence.points[:, 2] < high) & evidence.upright, 2]
        reach = float(np.percentile(heights, 98.0)) if len(heights) else float("inf")
        found.append(Storey(low_mean, high_mean, low_sigma, high_sigma, reach, high - SLAB_M))
    return found


def in_storey(evidence: Evidence, storeys: list[Storey], number: int) -> Evidence:
    """Return the evidence between a storey's floor and the next."""
    if len(storeys) == 1:
        return evidence
    low = storeys[number].bottom_m - SLAB_M if number else -np.inf
    high = storeys[number + 1].bottom_m - SLAB_M if number + 1 < len(storeys) else np.inf
    return evidence.select((evidence.points[:, 2] >= low) & (evidence.points[:, 2] < high))


def lowest_floor(evidence: Evidence) -> float:
    """Return the height of the lowest wide level below a camera that faces up, or of the lowest point less 1 % without one."""
    heights, areas = _level_peaks(evidence, 1.0)
    eyes = evidence.eyes[:, 2]
    for height, area in zip(heights, areas):
        if area >= LEAST_FLOOR_M2 and ((eyes > height + EYE_M[0]) & (eyes < height + EYE_M[1])).any():
            return height_of(evidence, height, 1.0)[0]
    return float(np.percentile(evidence.points[:, 2], 1.0))


def height_of(evidence: Evidence, height: float, facing: float) -> tuple[float, float]:
    """Return the height of a level near `height` and its standard deviation."""
    near = at_level(evidence, height, facing)
    return mean_over_views(evidence.points[near, 2], evidence.information[near], evidence.rows[near])


def at_level(evidence: Evidence, height: float, facing: float) -> Bool:
    """Return the points (n,) of a level near `height` that faces up (1) or down (-1)."""
    level = evidence.normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))
    return np.asarray(level & (np.abs(evidence.points[:, 2] - height) < LEVEL_NEAR_M), np.bool_)


def _level_peaks(evidence: Evidence, facing: float) -> tuple[F64, F64]:
    """Return heights (n,) and areas (n,) of the levels that face up (1) or down (-1), from the lowest: counted in cells of 10 cm, not in readings."""
    level = evidence.normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))
    if not level.any():
        return np.empty(0), np.empty(0)
    places = np.floor(evidence.points[level] / [0.1, 0.1, 0.02]).astype(np.int64)
    low = int(places[:, 2].min())
    keys = np.unique((places[:, 0] + (1 << 19) << 40) | (places[:, 1] + (1 << 19) << 20) | (places[:, 2] - low))
    area = sliding_sum(np.bincount(keys & ((1 << 20) - 1)), np.ones(3)) * 0.01 / 2.0
    padded = np.concatenate([[-1.0] * 4, area, [-1.0] * 4])
    top = np.array([area[k] == padded[k : k + 9].max() and area[k] > 0.0 for k in range(len(area))], bool)
    heights = (np.nonzero(top)[0] + low + 0.5) * 0.02
    return np.asarray(heights, np.float64), np.asarray(area[top], np.float64)


def sliding_sum(values: F64 | I64, weights: F64) -> F64:
    """Weigh each of (n,) values with its neighbours, an odd number of them; there are zeros beyond the ends."""
    padded = np.pad(values.astype(np.float64), len(weights) // 2)
    return np.asarray(matmul(np.lib.stride_tricks.sliding_window_view(padded, len(weights)), weights))
