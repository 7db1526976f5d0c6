"""A truncated signed distance field in blocks of 8 × 8 × 8 voxels (Curless and Levoy 1996; blocks: Nießner et al. 2013).

A voxel holds the weighted mean of how far views saw it before (+) or behind (-) the surface: along the ray; where a plane was found, across
the plane at its slant, but through the reading. A reading weighs with the inverse variance of its depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.numerics.surfaces.block_hash import FREE, I64, absent, empty_table, key_of, roomy, slot_of
from trihedron.plugins.numerics.surfaces.views import View

SIDE = 8  # voxels along a block's edge
CELLS = SIDE**3
RAY_STEP = 2  # px between the rays along which blocks are made; they are far larger
LEAST_COSINE = 0.3  # of the angle between ray and normal, 73°: behind a plane seen at less it is not known so far
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

    def integrate(self, view: View, T_world_camera: F64) -> None:
        """Take in a view from a pose."""
        c, T = view.camera, T_world_camera
        lens = c.intrinsics
        slants = _slants(view.coefficients, lens)
        touched = blocks_about(view.depth_m, view.labels, slants, lens, T, self.voxel_m * SIDE, self.truncation_m)
        fresh = touched[absent(self.keys, touched)]
        self.keys, self.numbers = roomy(self.keys, self.numbers, len(fresh))
        self._grow(self.count + len(fresh))
        self.count = int(_insert(self.keys, self.numbers, fresh, self.places, self.count))
        sigma = c.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01))
        weights = (1.0 / sigma**2).astype(np.float32)
        _integrate(
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


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cosine(x: float, y: float, z: float, length: float, slants: F64, label: int) -> float:
    """Of the angle between a ray (x, y, z) of that length and the plane's normal; 1 without a plane."""
    n = slants[label, 2] * x + slants[label, 3] * y + slants[label, 4] * z
    return 1.0 if n >= 0.0 else max(-n / length, LEAST_COSINE)


def blocks_about(depth: F32, labels: U8, slants: F64, lens: F64, T_world_camera: F64, block_m: float, truncation: float) -> I32:
    """(n, 3) places of the blocks within the truncation of a reading, in the order in which they are met; along its ray, or across its plane at the
    slant of its label."""
    slots = 1 << 13
    while (found := _across(empty_table(slots)[0], depth, labels, slants, lens, T_world_camera, block_m, truncation)) is None:
        slots *= 4
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _across(local: I64, depth: F32, labels: U8, slants: F64, lens: F64, T: F64, block_m: float, truncation: float) -> I32 | None:
    """Blocks (n, 3) within the truncation of the readings, along their rays or across their planes; None when the table `local` is too small."""
    h, w = depth.shape
    found, count, last = np.empty((len(local) // 2, 3), np.int32), 0, -1
    for r in range(0, h, RAY_STEP):
        for c in range(0, w, RAY_STEP):
            z = depth[r, c]
            if z <= 0.0:
                continue
            x, y = (c - lens[2]) / lens[0], (r - lens[3]) / lens[1]
            k = labels[r, c]
            if k > 0:
                dx, dy, dz = -truncation * slants[k, 2], -truncation * slants[k, 3], -truncation * slants[k, 4]
            else:
                dz = truncation / np.sqrt(x * x + y * y + 1.0)
                dx, dy = x * dz, y * dz
            for side in range(-1, 2):
                px, py, pz = x * z + side * dx, y * z + side * dy, z + side * dz
                i = int(np.floor((T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / block_m))
                j = int(np.floor((T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / block_m))
                m = int(np.floor((T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]) / block_m))
                key = key_of(i, j, m)
                if key == last:
                    continue
                last = key
                slot = slot_of(local, key)
                if local[slot] == FREE:
                    if count == len(found):
                        return None
                    local[slot] = key
                    found[count, 0], found[count, 1], found[count, 2] = i, j, m
                    count += 1
    return found[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _insert(keys: I64, numbers: I32, fresh: I32, places: I32, count: int) -> int:
    for i in range(len(fresh)):
        key = key_of(fresh[i, 0], fresh[i, 1], fresh[i, 2])
        slot = slot_of(keys, key)
        keys[slot], numbers[slot] = key, count
        places[count] = fresh[i]
        count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(
    keys: I64, numbers: I32, distance: F32, weight: F32, touched: I32, depth: F32, labels: U8, slants: F64, weights: F32, lens: F64,
    R_camera_world: F64, position: F64, voxel: float, truncation: float,
) -> None:  # fmt: skip
    """Update the voxels of the blocks `touched` (n, 3), which are all in the table."""
    h, w = depth.shape
    fx, fy, cx, cy = lens
    farthest = truncation / LEAST_COSINE  # along a ray; nothing farther is within the truncation across a plane
    sx, sy, sz = voxel * R_camera_world[0, 2], voxel * R_camera_world[1, 2], voxel * R_camera_world[2, 2]  # one voxel along z
    for b in range(len(touched)):
        block = numbers[slot_of(keys, key_of(touched[b, 0], touched[b, 1], touched[b, 2]))]
        for column in range(SIDE * SIDE):
            gx = (touched[b, 0] * SIDE + column // SIDE) * voxel - position[0]
            gy = (touched[b, 1] * SIDE + column % SIDE) * voxel - position[1]
            gz = touched[b, 2] * SIDE * voxel - position[2]
            x = R_camera_world[0, 0] * gx + R_camera_world[0, 1] * gy + R_camera_world[0, 2] * gz
            y = R_camera_world[1, 0] * gx + R_camera_world[1, 1] * gy + R_camera_world[1, 2] * gz
            z = R_camera_world[2, 0] * gx + R_camera_world[2, 1] * gy + R_camera_world[2, 2] * gz
            for i in range(SIDE):
                px, py, pz = x + i * sx, y + i * sy, z + i * sz
                if pz < 0.1:
                    continue
                inverse = 1.0 / pz
                across, down = fx * px * inverse + cx, fy * py * inverse + cy
                u, v = int(across + 0.5), int(down + 0.5)
                if u < 0 or v < 0 or u >= w or v >= h or depth[v, u] <= 0.0:
                    continue
                d = float(depth[v, u])
                if d - pz < -farthest:
                    continue
                length = np.sqrt(px * px + py * py + pz * pz)
                s = (d - pz) * length * inverse
                if labels[v, u] > 0 and abs(s) < farthest:
                    k = labels[v, u]
                    d /= max(1.0 + d * (slants[k, 0] * (across - u) + slants[k, 1] * (down - v)), 0.5)
                    s = (d - pz) * length * inverse * _cosine(px, py, pz, length, slants, k)
                if s < -truncation:
                    continue
                s = min(s, truncation)
                gain = weights[min(int(100.0 * d), len(weights) - 1)]
                if s < -0.5 * truncation:  # what lies deep behind is read there only by readings that err that way
                    gain *= 2.0 * (truncation + s) / truncation
                cell = column * SIDE + i
                total = weight[block, cell] + gain
                distance[block, cell] += np.float32((s - distance[block, cell]) * gain / total)
                weight[block, cell] = total
