"""Directions on the unit sphere: normals of surfaces and directions of 3D lines, with weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.types import F32, F64, Segments
from trihedron.plugins.manhattan.directions_kernels import gather_directions_kernel

NO_NORMALS, NO_LINES_M, NO_LINES_PX = (np.zeros(shape, np.float32) for shape in ((0, 0, 3), (0, 2, 3), (0, 2, 2)))


class Directions(NamedTuple):
    """Unit directions (n, 3) with weights (n,): normals first, lines from row `first_line`."""

    vectors: F64
    weights: F64
    first_line: int

    def subsample(self, most: int) -> Directions:
        """Keep about `most` of the normals at most, with larger weights, and all lines."""
        step = max(-(-self.first_line // most), 1)
        normals, lines = self.vectors[: self.first_line : step], self.vectors[self.first_line :]
        weights = np.concatenate([step * self.weights[: self.first_line : step], self.weights[self.first_line :]])
        return Directions(np.concatenate([normals, lines]), weights, len(normals))


def gather_directions(normals: F32 | None, segments: Segments | None, samples: int, line_weight_per_px: float) -> Directions:
    """Gather at most `samples` normals of a grid (h, w, 3), each of weight 1, and the directions of 3D lines, weighted by their image length."""
    grid = NO_NORMALS if normals is None else normals
    ends_m, ends_px = (NO_LINES_M, NO_LINES_PX) if segments is None else (segments.endpoints_m, segments.endpoints_px)
    return Directions(*gather_directions_kernel(grid, ends_m, ends_px, samples, line_weight_per_px))


def _half_sphere(count: int) -> F64:
    k = np.arange(count) + 0.5
    z, turn = 1.0 - k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions.flags.writeable = False
    return directions


HALF_SPHERE = _half_sphere(256)  # (256, 3) directions about 9° apart over half the sphere (Fibonacci)
