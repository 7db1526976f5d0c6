"""Kernels of `superpixels.py`: a view cut into superpixels, and the surfel of each."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, eigh
from trihedron.pipeline.core.types import F32, F64, I32, U8

ROUNDS = 3  # of assignment to the nearest centre
COLOR, INVERSE_DEPTH = 0.03, 12.0  # weight of a grey level, and of 1/m, against a share of the superpixel's side
COLUMNS = 13  # of a surfel: position, normal, colour, radius, weight, plane, number of views


@kernel
def assign_kernel(depth: F32, gray: F32, labels: U8, mask: U8, side: int) -> I32:
    """(h, w) number of the superpixel a pixel belongs to, -1 = none: the nearest of the centres about it in place, inverse depth and brightness,
    and of the same region (SLIC, Achanta et al. 2012)."""
    h, w = depth.shape
    rows, columns = (h + side - 1) // side, (w + side - 1) // side
    centres = np.zeros((rows * columns, 5))  # y, x, inverse depth, brightness, region
    out = np.full((h, w), -1, np.int32)
    for i in range(rows):
        for j in range(columns):
            k, found = i * columns + j, False
            centres[k, 4] = -1.0
            for y in range(i * side, min((i + 1) * side, h)):
                for x in range(j * side, min((j + 1) * side, w)):
                    if mask[y, x] and not (found and abs(y - (i + 0.5) * side) + abs(x - (j + 0.5) * side) >= centres[k, 3]):
                        centres[k, 0], centres[k, 1], centres[k, 2], centres[k, 4] = y, x, 1.0 / depth[y, x], labels[y, x]
                        centres[k, 3], found = abs(y - (i + 0.5) * side) + abs(x - (j + 0.5) * side), True
            if found:
                centres[k, 3] = gray[int(centres[k, 0]), int(centres[k, 1])]
    for _ in range(ROUNDS):
        sums = np.zeros((rows * columns, 5))
        for y in range(h):
            for x in range(w):
                out[y, x] = -1
                if not mask[y, x]:
                    continue
                best = np.inf
                for i in range(max(y // side - 1, 0), min(y // side + 2, rows)):
                    for j in range(max(x // side - 1, 0), min(x // side + 2, columns)):
                        k = i * columns + j
                        if centres[k, 4] != labels[y, x]:
                            continue
                        a, b = (y - centres[k, 0]) / side, (x - centres[k, 1]) / side
                        e, g = INVERSE_DEPTH * (1.0 / depth[y, x] - centres[k, 2]), COLOR * (gray[y, x] - centres[k, 3])
                        far = a * a + b * b + e * e + g * g
                        if far < best:
                            best, out[y, x] = far, k
                if out[y, x] >= 0:
                    k = out[y, x]
                    sums[k, 0] += y
                    sums[k, 1] += x
                    sums[k, 2] += 1.0 / depth[y, x]
                    sums[k, 3] += gray[y, x]
                    sums[k, 4] += 1.0
        for k in range(rows * columns):
            if sums[k, 4] > 0.0:
                for m in range(4):
                    centres[k, m] = sums[k, m] / sums[k, 4]
    return out


@kernel
def surfels_kernel(depth: F32, color: U8, labels: U8, assigned: I32, intrinsics: F64, side: int, count: int) -> F64:
    """(n, 13) one for each superpixel of at least a quarter of its square, camera frame: its mean point, and the plane of least squares through
    it."""
    h, w = depth.shape
    total, scatter = np.zeros((count, 7)), np.zeros((count, 3, 3))
    region = np.zeros(count, np.int32)
    for y in range(h):
        for x in range(w):
            k = assigned[y, x]
            if k >= 0:
                z = float(depth[y, x])
                total[k, 0] += 1.0
                total[k, 1] += (x - intrinsics[2]) / intrinsics[0] * z
                total[k, 2] += (y - intrinsics[3]) / intrinsics[1] * z
                total[k, 3] += z
                for i in range(3):
                    total[k, 4 + i] += color[y, x, i]
                region[k] = labels[y, x]
    for y in range(h):
        for x in range(w):
            k = assigned[y, x]
            if k >= 0:
                n, z = total[k, 0], float(depth[y, x])
                px, py, pz = (
                    (x - intrinsics[2]) / intrinsics[0] * z - total[k, 1] / n,
                    (y - intrinsics[3]) / intrinsics[1] * z - total[k, 2] / n,
                    z - total[k, 3] / n,
                )
                scatter[k, 0, 0] += px * px
                scatter[k, 1, 0] += py * px
                scatter[k, 1, 1] += py * py
                scatter[k, 2, 0] += pz * px
                scatter[k, 2, 1] += pz * py
                scatter[k, 2, 2] += pz * pz
    out, found = np.zeros((count, COLUMNS)), 0
    for k in range(count):
        if total[k, 0] < 0.25 * side * side:
            continue
        values, vectors = eigh(scatter[k] / total[k, 0])  # reads the lower triangle
        mean, normal = total[k, 1:4] / total[k, 0], vectors[:, 0].copy()
        if dot(normal, mean) > 0.0:
            normal = -normal
        out[found, :3], out[found, 3:6], out[found, 6:9] = mean, normal, total[k, 4:7] / total[k, 0]
        out[found, 9] = 2.0 * np.sqrt(max(values[1], 0.25 * values[2]))  # of a disc with this scatter across, if not much longer than wide
        out[found, 10] = values[0]
        out[found, 11] = region[k] - 1
        found += 1
    return out[:found].copy()
