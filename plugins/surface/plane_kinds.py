"""The kinds of planes of a surface, such as floor, ceiling and wall, by their direction, height and area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, PLANE_KINDS, U8

LEVEL_DEG = 20.0  # a plane that leans by less is level, or upright
SAME_LEVEL_M, WIDE_M2, HIGH_M = 0.15, 0.5, 1.0  # floor and ceiling: this near to the lowest or highest wide one; a wall is wide and this high


def kinds_of_planes(planes: F64, areas: F32, corners: F64, rows: NDArray[np.signedinteger], up: F64) -> U8:
    """(p,) rows of PLANE_KINDS; the most general one for all when nobody knows which way is up."""
    kinds = np.full(len(planes), PLANE_KINDS.index("plane"), np.uint8)
    if not np.isfinite(up).all():
        return kinds
    leaning, heights = matmul(planes[:, :3], up), _heights(corners, rows, len(planes))
    level, upright = np.cos(np.radians(LEVEL_DEG)), np.sin(np.radians(LEVEL_DEG))
    kinds[np.abs(leaning) > level] = PLANE_KINDS.index("horizontal")
    kinds[np.abs(leaning) < upright] = PLANE_KINDS.index("vertical")
    wide, middle = areas >= WIDE_M2, heights.mean(axis=1)
    kinds[(np.abs(leaning) < upright) & wide & (heights[:, 1] - heights[:, 0] >= HIGH_M)] = PLANE_KINDS.index("wall")
    for name, facing, end in (("floor", leaning > level, 1.0), ("ceiling", leaning < -level, -1.0)):
        if (facing & wide).any():
            last = (end * middle[facing & wide]).min()
            kinds[facing & (end * middle <= last + SAME_LEVEL_M)] = PLANE_KINDS.index(name)
    return kinds


def _heights(corners: F64, rows: I32, count: int) -> F64:
    """(p, 2) lowest and highest place of each plane, by the heights (t, 3) of its triangles' corners."""
    out = np.tile([np.inf, -np.inf], (count, 1))
    planar = rows >= 0
    np.minimum.at(out[:, 0], rows[planar], corners[planar].min(axis=1))
    np.maximum.at(out[:, 1], rows[planar], corners[planar].max(axis=1))
    return out
