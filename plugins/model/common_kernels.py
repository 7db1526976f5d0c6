"""Kernels of `common.py`: the hash table of blocks, frustum culling, and integration of a depth image."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash_kernels import I64, key_of, number_of, slot_of

I16 = NDArray[np.int16]
FULL = 32767  # a stored distance of one truncation
NEAREST_M = 0.1


class PosedCamera(NamedTuple):
    """Intrinsics of an image and the pose of its camera."""

    intrinsics: F64  # (fx, fy, cx, cy)
    R_camera_world: F64
    position_m: F64


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
