"""Free space: a plan of cells, each with the heights that rays passed (Elfes, Computer 1989, without probabilities)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.building.evidence import LEVEL_DEG, Evidence
from trihedron.plugins.building.free_space_kernels import LEVELS, U32, carve_kernel
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.shared.voxel_hash_kernels import I64

CELL_M = 0.05  # of the plan of free space, and of stretches along a wall
LEVEL_M = 0.1  # of heights
MARGIN = np.array([0.05, 0.006])  # m, 1/m: how far before its reading a ray ends, two standard deviations of a Kinect more than 5 cm
BESIDE_M = 1.0  # on stairs


@dataclass(frozen=True)
class FreeSpace:
    """The levels that rays passed, a bit each, in cells (h, w) of CELL_M from `origin` (2,), where the floor was seen (h, w), and where furniture
    stands that rays do not pass (h, w)."""

    origin: F64
    levels: U32
    floor: Bool
    furniture: Bool

    def at(self, points: F64) -> U32:
        """Return the levels (n,) at points (n, 2); none outside."""
        row, column, inside = self._cells(points)
        out = np.zeros(len(points), np.uint32)
        out[inside] = self.levels[row[inside], column[inside]]
        return out

    def passed(self, points: F64, bottom_m: float) -> Bool:
        """Say of points (n, 3) if rays passed there; `bottom_m` is the height of the storey's floor."""
        level = np.floor((points[:, 2] - bottom_m) / LEVEL_M)
        bit = np.uint32(1) << np.clip(level, 0, LEVELS - 1).astype(np.uint32)
        return np.asarray((level >= 0) & (level < LEVELS) & ((self.at(points[:, :2]) & bit) != 0), np.bool_)

    def within(self, points: F64) -> Bool:
        """Say of points (n, 2) if rays passed there or furniture stands there."""
        row, column, inside = self._cells(points)
        out: Bool = np.asarray(self.at(points) != 0, np.bool_)
        out[inside] |= self.furniture[row[inside], column[inside]]
        return out

    def furnish(self, points: F64) -> None:
        """Say of points (n, 2) that furniture stands there."""
        row, column, inside = self._cells(points)
        self.furniture[row[inside], column[inside]] = True

    def _cells(self, points: F64) -> tuple[I64, I64, Bool]:
        """Return row and column of the cells at points (n, 2), and if they are on the grid."""
        column, row = np.floor((points - self.origin) / CELL_M).astype(int).T
        h, w = self.levels.shape
        return row, column, (row >= 0) & (row < h) & (column >= 0) & (column < w)


def free_space(evidence: Evidence, storey: Storey, margin_m: float = 0.5) -> FreeSpace:
    """Carve the rays of all views from within a storey, or BESIDE_M below or above it."""
    low = evidence.points[:, :2].min(axis=0) - margin_m
    w, h = np.ceil((evidence.points[:, :2].max(axis=0) + margin_m - low) / CELL_M).astype(int)
    once, twice = np.zeros((h, w), np.uint32), np.zeros((h, w), np.uint32)
    above = storey.ceiling_m if np.isfinite(storey.ceiling_m) else float("inf")
    for view, T in zip(evidence.views, evidence.poses):
        if not storey.bottom_m - BESIDE_M < T[2, 3] < above + BESIDE_M:
            continue
        carve_kernel(view.depth_m, view.camera.intrinsics, T, low, CELL_M, storey.bottom_m, LEVEL_M, 2, MARGIN, once, twice)
    floor = np.zeros((h, w), np.bool_)
    level = (evidence.normals[:, 2] > np.cos(np.radians(LEVEL_DEG))) & (np.abs(evidence.points[:, 2] - storey.bottom_m) < 0.1)
    column, row = np.floor((evidence.points[level, :2] - low) / CELL_M).astype(int).T
    floor[row, column] = True
    return FreeSpace(low, twice, floor, np.zeros((h, w), np.bool_))
