"""A truncated signed distance field in blocks of 8 × 8 × 8 voxels (Curless and Levoy 1996; blocks: Nießner et al. 2013).

A voxel holds the weighted mean of how far views saw it before (+) or behind (-) the surface: along the ray; where a plane was found, across
the plane at its slant, but through the reading. A reading weighs with the inverse variance of its depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8, Camera
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE, find_blocks, insert_blocks, integrate
from trihedron.plugins.shared.voxel_hash_kernels import I64, absent, empty_table, reserve

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

    def integrate(self, camera: Camera, depth_m: F32, labels: U8, coefficients: F64, T_world_camera: F64) -> None:
        """Fuse a depth image with the labels and coefficients of its planes, from a pose."""
        intrinsics, T = camera.intrinsics, T_world_camera
        slants = _slants(coefficients, intrinsics)
        touched = blocks_about(depth_m, labels, slants, intrinsics, T, self.voxel_m * SIDE, self.truncation_m)
        fresh = touched[absent(self.keys, touched)]
        self.keys, self.numbers = reserve(self.keys, self.numbers, len(fresh))
        self._grow(self.count + len(fresh))
        self.count = int(insert_blocks(self.keys, self.numbers, fresh, self.places, self.count))
        sigma = camera.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01))
        weights = (1.0 / sigma**2).astype(np.float32)
        integrate(
            self.keys, self.numbers, self.distance, self.weight, touched, depth_m, labels, slants, weights, intrinsics,
            np.ascontiguousarray(T[:3, :3].T), T[:3, 3].copy(), self.voxel_m, self.truncation_m,
        )  # fmt: skip

    def _grow(self, count: int) -> None:
        """Reserve room for so many blocks, growing by half as many again, so that the copies cost no more than the blocks."""
        if count > len(self.places):
            more = max(count, len(self.places) * 3 // 2, 512) - len(self.places)
            self.places = np.concatenate([self.places, np.zeros((more, 3), np.int32)])
            self.distance = np.concatenate([self.distance, np.zeros((more, CELLS), np.float32)])
            self.weight = np.concatenate([self.weight, np.zeros((more, CELLS), np.float32)])


def _slants(planes: F64, intrinsics: F64) -> F64:
    """(n + 1, 5) for each label of a view: gradient of the inverse depth along x and y (1/m a pixel), constant on a plane, and the plane's normal.
    The first, of no plane, is zero."""
    gradient = -planes[:, :2] / intrinsics[:2] / np.maximum(planes[:, 3:], LEAST_M)
    return np.concatenate([np.zeros((1, 5)), np.concatenate([gradient, planes[:, :3]], axis=1)])


def blocks_about(depth: F32, labels: U8, slants: F64, intrinsics: F64, T_world_camera: F64, block_m: float, truncation: float) -> I32:
    """Find the blocks (n, 3) within the truncation of a reading, in the order in which they are met; along its ray, or across its plane."""
    slots = 1 << 13
    while (found := find_blocks(empty_table(slots)[0], depth, labels, slants, intrinsics, T_world_camera, block_m, truncation)) is None:
        slots *= 4
    return found
