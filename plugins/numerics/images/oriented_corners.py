"""Corners of all levels of a pyramid, chosen and directed in one call that holds no lock."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Bool
from trihedron.plugins.numerics.algebra.ranking import descending
from trihedron.plugins.numerics.images.corner_measures import centroid_angles_deg, harris_scores
from trihedron.plugins.numerics.images.fast_corners import fast_corners
from trihedron.plugins.numerics.images.image_pyramid import Pyramid, full_pixels, level_of
from trihedron.plugins.numerics.images.spreading import spread_over_grid


@numba.njit(cache=True, nogil=True, error_model="numpy")
def oriented_corners(
    pyramid: Pyramid, threshold: int, threshold_low: int, margin: int, cell_px: int, wanted: int, weights: F64
) -> tuple[I32, I32, F32]:
    """At most `wanted` corners in order of level, row and column: pixels (n, 2) of their levels (n,) and directions (n,) in degrees.

    FAST finds them at the high threshold, and at the low one in those cells of the full image that would have less than twice their share; the
    strongest by Harris measure, times their level's weight, are kept, spread over the cells (Rublee et al., ICCV 2011)."""
    cells, levels, strengths = _candidates(pyramid, threshold_low, margin)
    height, width = pyramid.shapes[0]
    full = full_pixels(cells, levels, pyramid.shapes).astype(np.float32)
    kept = (strengths >= threshold) | _in_poor_cells(full, strengths >= threshold, width, height, cell_px, wanted)
    cells, levels, full = cells[kept], levels[kept], full[kept]
    order = descending(_measured(pyramid, cells, levels, weights))
    kept = spread_over_grid(full, order, width, height, cell_px, wanted)
    cells, levels = cells[kept], levels[kept]
    angles = np.empty(len(cells), np.float32)
    for level in range(len(pyramid.shapes)):
        first, end = np.searchsorted(levels, level), np.searchsorted(levels, level + 1)
        angles[first:end] = centroid_angles_deg(level_of(pyramid, level), cells[first:end])
    return cells, levels, angles


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _candidates(pyramid: Pyramid, threshold: int, margin: int) -> tuple[I32, I32, I32]:
    """FAST corners of every level: pixels (n, 2), levels (n,) and strengths (n,)."""
    most = len(pyramid.pixels) // 4
    cells, levels, strengths, n = np.empty((most, 2), np.int32), np.empty(most, np.int32), np.empty(most, np.int32), 0
    for level in range(len(pyramid.shapes)):
        found, strong = fast_corners(level_of(pyramid, level), threshold, margin)
        cells[n : n + len(found)], levels[n : n + len(found)], strengths[n : n + len(found)] = found, level, strong
        n += len(found)
    return cells[:n].copy(), levels[:n].copy(), strengths[:n].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_poor_cells(full: F32, strong: Bool, width: int, height: int, cell_px: int, wanted: int) -> Bool:
    """(n,) which corners lie in cells with fewer strong ones than twice a cell's share of those wanted."""
    across, down = (width + cell_px - 1) // cell_px, (height + cell_px - 1) // cell_px
    place, count = np.empty(len(full), np.int32), np.zeros(across * down, np.int32)
    for i in range(len(full)):
        place[i] = int(full[i, 1]) // cell_px * across + int(full[i, 0]) // cell_px
        count[place[i]] += strong[i]
    return count[place] < 2.0 * wanted / (across * down)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _measured(pyramid: Pyramid, cells: I32, levels: I32, weights: F64) -> F64:
    """(n,) Harris measure times the level's weight."""
    out = np.empty(len(cells))
    for level in range(len(pyramid.shapes)):
        first, end = np.searchsorted(levels, level), np.searchsorted(levels, level + 1)
        out[first:end] = harris_scores(level_of(pyramid, level), cells[first:end]) * weights[level]
    return out
