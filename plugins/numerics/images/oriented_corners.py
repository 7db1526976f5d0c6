"""Corners of all levels of a pyramid, chosen and directed in one call that holds no lock."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.numerics.algebra.ranking import descending
from trihedron.plugins.numerics.images.corner_measures import centroid_angle, half_disc, harris_score
from trihedron.plugins.numerics.images.fast_corners import find_corners
from trihedron.plugins.numerics.images.image_pyramid import Pyramid, level_of
from trihedron.plugins.numerics.images.spreading import spread_over_cells


@numba.njit(cache=True, nogil=True, error_model="numpy")
def oriented_corners(
    pyramid: Pyramid, threshold: int, threshold_low: int, margin: int, cell_px: int, wanted: int, weights: F64
) -> tuple[I32, I32, F32]:
    """At most `wanted` corners in order of level, row and column, `margin` (at least 16) px from a border: pixels (n, 2) of their levels (n,) and
    directions (n,) in degrees.

    FAST finds them at the high threshold, and at the low one in those cells of the full image that would have less than twice their share; the
    strongest by Harris measure, times their level's weight, are kept, spread over the cells (Rublee et al., ICCV 2011)."""
    pixels, levels, strengths = _candidates(pyramid, threshold_low, margin)
    cells, number = _grid_cells(pixels, levels, pyramid.shapes, cell_px)
    kept = _strong_or_rare(strengths >= threshold, cells, number, wanted)
    pixels, levels, cells = _rows(kept, pixels, levels, cells)
    kept = spread_over_cells(cells, number, descending(_measured(pyramid, pixels, levels, weights)), wanted)
    pixels, levels, cells = _rows(kept, pixels, levels, cells)
    return pixels, levels, _directions(pyramid, pixels, levels)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _candidates(pyramid: Pyramid, threshold: int, margin: int) -> tuple[I32, I32, I32]:
    """FAST corners of every level: pixels (n, 2), levels (n,) and strengths (n,)."""
    most = len(pyramid.pixels) // 4
    pixels, levels, strengths, n = np.empty((most, 2), np.int32), np.empty(most, np.int32), np.empty(most, np.int32), 0
    for level in range(len(pyramid.shapes)):
        first, n = n, find_corners(level_of(pyramid, level), threshold, margin, pixels, strengths, n)
        levels[first:n] = level
    return pixels[:n], levels[:n], strengths[:n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _grid_cells(pixels: I32, levels: I32, shapes: I32, cell_px: int) -> tuple[I32, int]:
    """Cells (n,) of the full image that corners lie in (see `full_pixels`), and how many cells there are."""
    height, width = shapes[0]
    cell, out = np.empty(max(height, width), np.int32), np.empty(len(pixels), np.int32)
    for x in range(len(cell)):
        cell[x] = x // cell_px
    across = cell[width - 1] + 1
    for i in range(len(pixels)):
        h, w = shapes[levels[i]]
        x = np.float32((pixels[i, 0] + 0.5) * (width / w) - 0.5)
        y = np.float32((pixels[i, 1] + 0.5) * (height / h) - 0.5)
        out[i] = cell[int(y)] * across + cell[int(x)]
    return out, across * (cell[height - 1] + 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _strong_or_rare(strong: Bool, cells: I32, number: int, wanted: int) -> Bool:
    """(n,) which corners are strong, or in cells with fewer strong ones than twice a cell's share of those wanted."""
    count, out = np.zeros(number, np.int32), np.empty(len(strong), np.bool_)
    for i in range(len(strong)):
        count[cells[i]] += strong[i]
    for i in range(len(strong)):
        out[i] = strong[i] | (count[cells[i]] < 2.0 * wanted / number)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(kept: Bool, pixels: I32, levels: I32, cells: I32) -> tuple[I32, I32, I32]:
    """The kept ones of corners."""
    n = 0
    for i in range(len(kept)):
        n += kept[i]
    some, at, of, n = np.empty((n, 2), np.int32), np.empty(n, np.int32), np.empty(n, np.int32), 0
    for i in range(len(kept)):
        if kept[i]:
            some[n, 0], some[n, 1], at[n], of[n] = pixels[i, 0], pixels[i, 1], levels[i], cells[i]
            n += 1
    return some, at, of


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _measured(pyramid: Pyramid, pixels: I32, levels: I32, weights: F64) -> F64:
    """(n,) Harris measure times the level's weight."""
    out = np.empty(len(pixels))
    for i in range(len(pixels)):
        place, cols = _place(pyramid, pixels, levels, i)
        out[i] = np.float32(harris_score(pyramid.pixels, place, cols)) * weights[levels[i]]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _directions(pyramid: Pyramid, pixels: I32, levels: I32) -> F32:
    """(n,) directions of corners, degrees."""
    out = np.empty(len(pixels), np.float32)
    across, inside = half_disc()
    for i in range(len(pixels)):
        place, cols = _place(pyramid, pixels, levels, i)
        out[i] = centroid_angle(pyramid.pixels, place, cols, across, inside)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place(pyramid: Pyramid, pixels: I32, levels: I32, i: int) -> tuple[int, int]:
    """Where a corner is in the pyramid's pixels, and how many of these are a row: unsigned, so that no index is taken to count from the end."""
    cols = np.uint64(pyramid.shapes[levels[i], 1])
    return np.uint64(pyramid.starts[levels[i]]) + np.uint64(pixels[i, 1]) * cols + np.uint64(pixels[i, 0]), cols
