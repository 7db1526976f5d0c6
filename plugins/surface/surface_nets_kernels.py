"""Kernels of `surface_nets.py`: the iso-surface of a volume as triangles, by naive surface nets (Gibson 1998)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.tsdf_volume import CELLS
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash_kernels import I64, number_of

# Each cell of eight voxels with both signs holds one vertex, the mean of where its edges cross zero; each voxel edge with both signs joins the four
# cells about it to two triangles. So neighbouring triangles share their vertices wherever all voxels are known.

I8 = NDArray[np.int8]
TOUCHING_M = 1e-4  # distance given to a voxel whose sign is turned


@kernel
def neighbours(keys: I64, numbers: I32, places: I32) -> I32:
    """(n, 27) the blocks around each, -1 = none; (dx + 1) · 9 + (dy + 1) · 3 + dz + 1."""
    out = np.empty((len(places), 27), np.int32)
    for b in range(len(places)):
        for k in range(27):
            out[b, k] = number_of(keys, numbers, places[b, 0] + k // 9 - 1, places[b, 1] + k // 3 % 3 - 1, places[b, 2] + k % 3 - 1)
    return out


@kernel
def signs_kernel(distance: F32, weight: F32, least: float, signs: I8) -> None:
    """1 before the surface, -1 behind it, 0 where that is not known."""
    for b in range(len(distance)):
        for i in range(CELLS):
            if weight[b, i] >= least:
                signs[b, i] = 1 if distance[b, i] >= 0.0 else -1


@kernel
def untangle(distance: F32, signs: I8, around: I32, near: float) -> int:
    """Wherever four in a square have signs like a chessboard's, put the one less far behind before the surface: noise, where that runs along a layer
    of voxels, and four triangles would meet in an edge. Always that way, so it comes to an end. Returns how many were turned."""
    turned = 0
    block, at = np.empty(4, np.int32), np.empty(4, np.int32)
    for b in range(len(signs)):
        for cell in range(CELLS):
            if signs[b, cell] == 0 or abs(distance[b, cell]) > near:
                continue
            x, y, z = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
            for axis in range(3):
                for k in range(4):
                    u, v = k & 1, k >> 1
                    dx, dy, dz = (0, u, v) if axis == 0 else ((v, 0, u) if axis == 1 else (u, v, 0))
                    block[k], at[k] = _at(around, b, x + dx, y + dy, z + dz)
                if block[1] < 0 or block[2] < 0 or block[3] < 0:
                    continue
                s1, s2, s3 = signs[block[1], at[1]], signs[block[2], at[2]], signs[block[3], at[3]]
                if s3 != signs[b, cell] or s1 != s2 or s1 != -s3:
                    continue
                least = -1
                for k in range(4):
                    behind = signs[block[k], at[k]] < 0
                    if behind and (least < 0 or distance[block[k], at[k]] > distance[block[least], at[least]]):
                        least = k
                signs[block[least], at[least]] = 1
                distance[block[least], at[least]] = TOUCHING_M
                turned += 1
    return turned


@kernel(inline="always")
def _at(around: I32, b: int, x: int, y: int, z: int) -> tuple[int, int]:
    """Block and cell of the voxel (x, y, z) of block b, each in -1 … SIDE; block -1 where there is none."""
    block = around[b, ((x + SIDE) // SIDE) * 9 + ((y + SIDE) // SIDE) * 3 + (z + SIDE) // SIDE]
    return block, ((x + SIDE) % SIDE) * SIDE * SIDE + ((y + SIDE) % SIDE) * SIDE + (z + SIDE) % SIDE


@kernel
def vertices_kernel(places: I32, distance: F32, signs: I8, around: I32, cells: I32, voxel: float) -> F64:
    """(v, 3) vertices; `cells` gets their numbers."""
    out, count = np.empty((1024, 3)), 0
    value, sign = np.empty(8), np.empty(8, np.int8)
    for b in range(len(places)):
        for cell in range(CELLS):
            if signs[b, cell] == 0:
                continue
            x, y, z = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
            total, known = 0, True
            for k in range(8):
                block, at = _at(around, b, x + (k & 1), y + (k >> 1 & 1), z + (k >> 2))
                if block < 0 or signs[block, at] == 0:
                    known = False
                    break
                value[k], sign[k] = distance[block, at], signs[block, at]
                total += sign[k]
            if not known or total == 8 or total == -8:
                continue
            sx, sy, sz, crossings = 0.0, 0.0, 0.0, 0
            for k in range(8):
                for axis in range(3):
                    other = k | (1 << axis)
                    if other != k and sign[k] != sign[other]:
                        share = value[k] / (value[k] - value[other])
                        sx += (k & 1) + (share if axis == 0 else 0.0)
                        sy += (k >> 1 & 1) + (share if axis == 1 else 0.0)
                        sz += (k >> 2) + (share if axis == 2 else 0.0)
                        crossings += 1
            if count == len(out):
                larger = np.empty((2 * count, 3))
                copy_matrix(out, larger)
                out = larger
            out[count, 0] = (places[b, 0] * SIDE + x + sx / crossings) * voxel
            out[count, 1] = (places[b, 1] * SIDE + y + sy / crossings) * voxel
            out[count, 2] = (places[b, 2] * SIDE + z + sz / crossings) * voxel
            cells[b, cell] = count
            count += 1
    return out[:count].copy()


@kernel
def triangles_kernel(signs: I8, around: I32, cells: I32, vertices: F64) -> I32:
    """(t, 3): two for each voxel edge with both signs whose four cells have vertices, cut along the shorter diagonal."""
    out, count = np.empty((4096, 3), np.int32), 0
    q = np.empty(4, np.int32)
    for b in range(len(signs)):
        for cell in range(CELLS):
            here = signs[b, cell]
            if here == 0:
                continue
            p = (cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE)
            for axis in range(3):
                u, v = (axis + 1) % 3, (axis + 2) % 3
                e = (1 if axis == 0 else 0, 1 if axis == 1 else 0, 1 if axis == 2 else 0)
                block, at = _at(around, b, p[0] + e[0], p[1] + e[1], p[2] + e[2])
                if block < 0 or signs[block, at] == 0 or signs[block, at] == here:
                    continue
                whole = True
                for k in range(4):  # round the edge, anticlockwise about its direction
                    du, dv = (1 if k == 0 or k == 3 else 0), (1 if k == 0 or k == 1 else 0)
                    ox = (du if u == 0 else 0) + (dv if v == 0 else 0)
                    oy = (du if u == 1 else 0) + (dv if v == 1 else 0)
                    oz = (du if u == 2 else 0) + (dv if v == 2 else 0)
                    block, at = _at(around, b, p[0] - ox, p[1] - oy, p[2] - oz)
                    q[k] = cells[block, at] if block >= 0 else -1
                    whole = whole and q[k] >= 0
                if not whole:
                    continue
                if count + 2 > len(out):
                    larger = np.empty((2 * len(out), 3), np.int32)
                    copy_matrix(out[:count], larger)
                    out = larger
                if here > 0:  # before the surface at the lower end: outside is towards -axis
                    q[1], q[3] = q[3], q[1]
                first = _squared_distance(vertices, q[0], q[2]) <= _squared_distance(vertices, q[1], q[3])
                for k in range(2):
                    start = 2 * k if first else 2 * k + 1
                    out[count, 0], out[count, 1], out[count, 2] = q[start], q[(start + 1) % 4], q[(start + 2) % 4]
                    count += 1
    return out[:count].copy()


@kernel(inline="always")
def _squared_distance(vertices: F64, i: int, j: int) -> float:
    x, y, z = vertices[i, 0] - vertices[j, 0], vertices[i, 1] - vertices[j, 1], vertices[i, 2] - vertices[j, 2]
    return x * x + y * y + z * z
