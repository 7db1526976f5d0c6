"""A truncated signed distance field in blocks of 8 × 8 × 8 voxels (Curless and Levoy 1996; blocks: Nießner et al. 2013).

A voxel holds the weighted mean of how far views saw it before (+) or behind (-) the surface: along the ray; where a plane was found, across
the plane at its slant, but through the reading. A reading weighs with the inverse variance of its depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE, across_kernel, insert, integrate
from trihedron.plugins.shared.voxel_hash import empty_table, roomy
from trihedron.plugins.shared.voxel_hash_kernels import I64, absent

CELLS = SIDE**3
LEAST_M = 0.01  # distance of a plane from the camera, below which it is seen from its edge


@dataclass
class Volume:
    """Blocks by number: their place in blocks, mean distance (m) and weight (1/m²) of their voxels, x slowest. Voxel i of a block is at
    (block · SIDE + i) · voxel_m, in the world."""

    voxel_m: float
    truncation_m: float
    keys: I64 = field(default_factory=lambda: empty_table(1 << 12)[0])
    numbers: I32 = field(default_factory=lambda: empty_table(1 << 12)[1])
    count: int = 0
    places: I32 = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    distance: F32 = field(default_factory=lambda: np.zeros((0, CELLS), np.float32))
    weight: F32 = field(default_factory=lambda: np.zeros((0, CELLS), np.float32))

    def integrate(self, view: KeyframeView, T_world_camera: F64) -> None:
        """Take in a view from a pose."""
        c, T = view.camera, T_world_camera
        lens = c.intrinsics
        slants = _slants(view.coefficients, lens)
        touched = blocks_about(view.depth_m, view.labels, slants, lens, T, self.voxel_m * SIDE, self.truncation_m)
        fresh = touched[absent(self.keys, touched)]
        self.keys, self.numbers = roomy(self.keys, self.numbers, len(fresh))
        self._grow(self.count + len(fresh))
        self.count = int(insert(self.keys, self.numbers, fresh, self.places, self.count))
        sigma = c.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01))
        weights = (1.0 / sigma**2).astype(np.float32)
        integrate(
            self.keys, self.numbers, self.distance, self.weight, touched, view.depth_m, view.labels, slants, weights, lens,
            np.ascontiguousarray(T[:3, :3].T), T[:3, 3].copy(), self.voxel_m, self.truncation_m,
        )  # fmt: skip

    def _grow(self, count: int) -> None:
        """Room for so many blocks; by half as many again, so that the copies cost no more than the blocks."""
        if count > len(self.places):
            more = max(count, len(self.places) * 3 // 2, 512) - len(self.places)
            self.places = np.concatenate([self.places, np.zeros((more, 3), np.int32)])
            self.distance = np.concatenate([self.distance, np.zeros((more, CELLS), np.float32)])
            self.weight = np.concatenate([self.weight, np.zeros((more, CELLS), np.float32)])


def _slants(planes: F64, lens: F64) -> F64:
    """(n + 1, 5) for each label of a view: slope of the inverse depth along x and y (1/m a pixel), which is the same all over a plane, and the
    plane's normal. The first, of no plane, is zero."""
    slopes = -planes[:, :2] / lens[:2] / np.maximum(planes[:, 3:], LEAST_M)
    return np.concatenate([np.zeros((1, 5)), np.concatenate([slopes, planes[:, :3]], axis=1)])


def blocks_about(depth: F32, labels: U8, slants: F64, lens: F64, T_world_camera: F64, block_m: float, truncation: float) -> I32:
    """(n, 3) places of the blocks within the truncation of a reading, in the order in which they are met; along its ray, or across its plane at the
    slant of its label."""
    slots = 1 << 13
    while (found := across_kernel(empty_table(slots)[0], depth, labels, slants, lens, T_world_camera, block_m, truncation)) is None:
        slots *= 4
    return found
