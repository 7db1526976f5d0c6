"""Kernels of `tsdf.py`: the hash table of blocks, frustum culling, integration of a depth image, and raycasting."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, I32, U8, Bool
from trihedron.plugins.model.downsampled_frame import NEAREST_M, PosedCamera
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash_kernels import I64, key_of, number_of, slot_of

I16 = NDArray[np.int16]
FULL = 32767  # a stored distance of one truncation


class Blocks(NamedTuple):
    """A subset of the blocks with a hash table of their indices."""

    keys: I64  # hash table of their places
    numbers: I32
    places: I32  # (n, 3)
    distance: I16  # (n, CELLS)
    weight: U8  # (n, CELLS)


@kernel
def insert(keys: I64, numbers: I32, places: I32) -> None:
    """Insert the rows of `places` (n, 3) into a hash table that has room for them."""
    for i in range(len(places)):
        key = key_of(places[i, 0], places[i, 1], places[i, 2])
        slot = slot_of(keys, key)
        keys[slot], numbers[slot] = key, i


@kernel
def in_view(places: I32, camera: PosedCamera, shape: tuple[int, int], block_m: float) -> Bool:
    """Mask (n,) of the blocks whose bounding sphere may project into the image."""
    fx, fy, cx, cy = camera.intrinsics
    R, t = camera.R_camera_world, camera.position_m
    out, reach = np.zeros(len(places), np.bool_), 0.87 * block_m
    for i in range(len(places)):
        a, b, c = (places[i, 0] + 0.5) * block_m - t[0], (places[i, 1] + 0.5) * block_m - t[1], (places[i, 2] + 0.5) * block_m - t[2]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        if z < -reach:
            continue
        d = max(z, NEAREST_M)
        u, v = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c) / d + cx, fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c) / d + cy
        wide = 1.5 * fx * reach / max(d - reach, NEAREST_M)
        out[i] = u > -wide and v > -wide and u < shape[1] + wide and v < shape[0] + wide
    return out


@kernel
def integrate(blocks: Blocks, touched: I32, depth: F32, camera: PosedCamera, voxel: float, truncation: float, most: int) -> Bool:
    """Update the voxels of the blocks `touched` (n, 3), a subset of the blocks; returns the mask (m,) of the blocks that changed."""
    h, w = depth.shape
    fx, fy, cx, cy = camera.intrinsics
    R, t = camera.R_camera_world, camera.position_m
    changed = np.zeros(len(blocks.places), np.bool_)
    distance, weight = blocks.distance, blocks.weight
    sx, sy, sz = voxel * R[0, 2], voxel * R[1, 2], voxel * R[2, 2]  # one voxel along z
    for n in range(len(touched)):
        b = number_of(blocks.keys, blocks.numbers, touched[n, 0], touched[n, 1], touched[n, 2])
        if b < 0:
            continue
        for column in range(SIDE * SIDE):
            gx = (touched[n, 0] * SIDE + column // SIDE) * voxel - t[0]
            gy = (touched[n, 1] * SIDE + column % SIDE) * voxel - t[1]
            gz = touched[n, 2] * SIDE * voxel - t[2]
            x = R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz
            y = R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz
            z = R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz
            for i in range(SIDE):
                px, py, pz = x + i * sx, y + i * sy, z + i * sz
                if pz < NEAREST_M:
                    continue
                u, v = int(fx * px / pz + cx + 0.5), int(fy * py / pz + cy + 0.5)
                if u < 0 or v < 0 or u >= w or v >= h or depth[v, u] <= 0.0:
                    continue
                s = (depth[v, u] - pz) * np.sqrt(px * px + py * py + pz * pz) / pz
                if s < -truncation:
                    continue
                cell = column * SIDE + i
                old, count = distance[b, cell], weight[b, cell]
                mean = (old * count + FULL * min(s / truncation, 1.0)) / (count + 1.0)
                distance[b, cell] = np.int16(np.floor(mean + 0.5))
                weight[b, cell] = min(count + 1, most)
                changed[b] = True
    return changed


BEFORE = 1.5  # truncations before a reading, where the search begins
TILE = 8  # pixels that share the range of depths in which there are blocks


@kernel
def ranges_kernel(blocks: Blocks, camera: PosedCamera, shape: tuple[int, int], block_m: float) -> F32:
    """Nearest and farthest depth (rows, columns, 2) of a block in each tile; (inf, 0) without one."""
    fx, fy, cx, cy = camera.intrinsics
    R, t = camera.R_camera_world, camera.position_m
    rows, columns = -(-shape[0] // TILE), -(-shape[1] // TILE)
    out = np.zeros((rows, columns, 2), np.float32)
    out[:, :, 0] = np.inf
    for n in range(len(blocks.places)):
        near, far, left, right, top, bottom = np.inf, 0.0, np.inf, -np.inf, np.inf, -np.inf
        for corner in range(8):
            a = (blocks.places[n, 0] + (corner & 1)) * block_m - t[0]
            b = (blocks.places[n, 1] + (corner >> 1 & 1)) * block_m - t[1]
            c = (blocks.places[n, 2] + (corner >> 2)) * block_m - t[2]
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
            d = max(z, NEAREST_M)
            u, v = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c) / d + cx, fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c) / d + cy
            near, far = min(near, d), max(far, z)
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if far <= NEAREST_M:
            continue
        first, last = max(int(np.floor(left / TILE)), 0), min(int(np.floor(right / TILE)), columns - 1)
        for i in range(max(int(np.floor(top / TILE)), 0), min(int(np.floor(bottom / TILE)), rows - 1) + 1):
            for j in range(first, last + 1):
                out[i, j, 0], out[i, j, 1] = min(out[i, j, 0], near), max(out[i, j, 1], far)
    return out


@kernel
def _interpolate(keys: I64, numbers: I32, distance: I16, weight: U8, x: float, y: float, z: float) -> float:
    """Trilinear interpolation of the distance at a position (voxels), as a share of the truncation; NaN where one of the eight voxels is not
    observed."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - k
    total, block, u, v, w = 0.0, -2, 0, 0, 0
    for corner in range(8):
        p, q, s = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
        if block == -2 or p >> 3 != u or q >> 3 != v or s >> 3 != w:
            u, v, w = p >> 3, q >> 3, s >> 3  # SIDE is 8
            block = number_of(keys, numbers, u, v, w)
        cell = ((p & 7) * SIDE + (q & 7)) * SIDE + (s & 7)
        if block < 0 or weight[block, cell] == 0:
            return np.nan
        share = (a if corner & 1 else 1.0 - a) * (b if corner >> 1 & 1 else 1.0 - b) * (c if corner >> 2 else 1.0 - c)
        total += share * distance[block, cell] / FULL
    return total


@kernel
def cast_kernel(
    keys: I64, numbers: I32, distance: I16, weight: U8, camera: PosedCamera, ranges: F32, depth: F32, voxel: float, truncation: float
) -> F32:  # fmt: skip
    """March along each ray by the stored distance of the nearest voxel to a change of sign, then interpolate the zero crossing (Newcombe et al.,
    ISMAR 2011)."""
    fx, fy, cx, cy = camera.intrinsics
    R, t = camera.R_camera_world, camera.position_m / voxel
    out = np.zeros(depth.shape, np.float32)
    for r in range(depth.shape[0]):
        for c in range(depth.shape[1]):
            z, far = ranges[r // TILE, c // TILE, 0], ranges[r // TILE, c // TILE, 1]
            x, y = (c - cx) / fx, (r - cy) / fy
            length = np.sqrt(x * x + y * y + 1.0)
            z = max(z, depth[r, c] - BEFORE * truncation)
            dx = (R[0, 0] * x + R[1, 0] * y + R[2, 0]) / voxel
            dy = (R[0, 1] * x + R[1, 1] * y + R[2, 1]) / voxel
            dz = (R[0, 2] * x + R[1, 2] * y + R[2, 2]) / voxel
            before, last, nearest, block, u, v, w = False, 0.0, 0.0, -2, 0, 0, 0
            while z <= far:
                p, q, s = int(np.floor(dx * z + t[0] + 0.5)), int(np.floor(dy * z + t[1] + 0.5)), int(np.floor(dz * z + t[2] + 0.5))
                if block == -2 or p >> 3 != u or q >> 3 != v or s >> 3 != w:
                    u, v, w = p >> 3, q >> 3, s >> 3
                    block = number_of(keys, numbers, u, v, w)
                if block < 0:
                    before = False
                    z += 2.0 * voxel / length
                    continue
                cell = ((p & 7) * SIDE + (q & 7)) * SIDE + (s & 7)
                known, value = weight[block, cell] > 0, distance[block, cell] / FULL
                if known and value <= 0.0:
                    if before:
                        first = _interpolate(keys, numbers, distance, weight, dx * last + t[0], dy * last + t[1], dz * last + t[2])
                        second = _interpolate(keys, numbers, distance, weight, dx * z + t[0], dy * z + t[1], dz * z + t[2])
                        if np.isnan(first) or np.isnan(second):  # at the boundary of the observed voxels: by the nearest ones
                            first, second = nearest, value
                        if first > second:
                            out[r, c] = last + (z - last) * min(max(first / (first - second), -1.0), 2.0)
                    break
                if known:
                    before, last, nearest = True, z, value
                z += max(0.8 * value * truncation, voxel) / length if known else voxel / length
    return out
