"""Kernels of `tsdf_volume.py`: blocks within the truncation, their insertion, and integration of a depth image."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.shared.voxel_hash_kernels import FREE, I64, key_of, slot_of

SIDE = 8  # voxels along a block's edge
RAY_STEP = 2  # px between the rays along which blocks are made; they are far larger
LEAST_COSINE = 0.3  # of the angle between ray and normal, 73°: behind a plane seen at less it is not known so far


@kernel(inline="always")
def _cosine(x: float, y: float, z: float, length: float, slants: F64, label: int) -> float:
    """Cosine of the angle between a ray (x, y, z) of that length and the plane's normal; 1 without a plane."""
    n = slants[label, 2] * x + slants[label, 3] * y + slants[label, 4] * z
    return 1.0 if n >= 0.0 else max(-n / length, LEAST_COSINE)


@kernel
def find_blocks(local: I64, depth: F32, labels: U8, slants: F64, intrinsics: F64, T: F64, block_m: float, truncation: float) -> I32 | None:
    """Find the blocks (n, 3) within the truncation of the readings, along rays or across planes; None when the table `local` is too small."""
    h, w = depth.shape
    found, count, last = np.empty((len(local) // 2, 3), np.int32), 0, -1
    for r in range(0, h, RAY_STEP):
        for c in range(0, w, RAY_STEP):
            z = depth[r, c]
            if z <= 0.0:
                continue
            x, y = (c - intrinsics[2]) / intrinsics[0], (r - intrinsics[3]) / intrinsics[1]
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


@kernel
def insert_blocks(keys: I64, numbers: I32, fresh: I32, places: I32, count: int) -> int:
    """Insert the blocks `fresh` (n, 3) into the table and their places into `places`; returns the number of blocks."""
    for i in range(len(fresh)):
        key = key_of(fresh[i, 0], fresh[i, 1], fresh[i, 2])
        slot = slot_of(keys, key)
        keys[slot], numbers[slot] = key, count
        places[count, 0], places[count, 1], places[count, 2] = fresh[i, 0], fresh[i, 1], fresh[i, 2]
        count += 1
    return count


@kernel
def integrate(
    keys: I64, numbers: I32, distance: F32, weight: F32, touched: I32, depth: F32, labels: U8, slants: F64, weights: F32, intrinsics: F64,
    R_camera_world: F64, position: F64, voxel: float, truncation: float,
) -> None:  # fmt: skip
    """Integrate a depth image into the voxels of the blocks `touched` (n, 3), which are all in the table."""
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
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
