"""The iso-surface of a volume as triangles, by naive surface nets (Gibson 1998)."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.tsdf_volume import CELLS, Volume
from trihedron.plugins.surface.surface_nets_kernels import neighbours, signs_kernel, triangles_kernel, untangle, vertices_kernel

PASSES = 20  # at most, over all voxels, to untangle signs
NEAR = 2.0  # voxels from the surface, within which signs can tangle


def extract_iso_surface(volume: Volume, least_weight: float) -> tuple[F64, I32]:
    """Extract the iso-surface at distance 0 by surface nets: vertices (v, 3) in metres and triangles (t, 3), anticlockwise seen from outside, through
    voxels of at least that weight (1/m²)."""
    n = volume.count
    places, distance, weight = volume.places[:n], volume.distance[:n], volume.weight[:n]
    around = neighbours(volume.keys, volume.numbers, places)
    signs = np.zeros((n, CELLS), np.int8)
    signs_kernel(distance, weight, least_weight, signs)
    distance = distance.copy()
    for _ in range(PASSES):
        if not untangle(distance, signs, around, NEAR * volume.voxel_m):
            break
    cells = np.full((n, CELLS), -1, np.int32)
    vertices = vertices_kernel(places, distance, signs, around, cells, volume.voxel_m)
    return vertices, triangles_kernel(signs, around, cells, vertices)
