"""Kernels of `planar_segmentation.py`: labels by planes, growing of regions, and their curvature."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, eigh, solve
from trihedron.pipeline.core.types import F64, I32


@kernel
def on_planes(vertices: F64, triangles: I32, turned: F64, planes: F64, distance: float, cosine: float) -> I32:
    """The plane that is nearest to all corners of a triangle and looks the same way."""
    labels = np.full(len(triangles), -1, np.int32)
    for t in range(len(triangles)):
        best = distance
        for p in range(len(planes)):
            if turned[t, 0] * planes[p, 0] + turned[t, 1] * planes[p, 1] + turned[t, 2] * planes[p, 2] < cosine:
                continue
            off = _farthest(vertices, triangles[t], planes[p])
            if off < best:
                best, labels[t] = off, p
    return labels


@kernel(inline="always")
def _farthest(vertices: F64, corners: I32, plane: F64) -> float:
    off = 0.0
    for k in range(3):
        v = vertices[corners[k]]
        off = max(off, abs(v[0] * plane[0] + v[1] * plane[1] + v[2] * plane[2] + plane[3]))
    return off


@kernel
def least_neighbour_cosine(turned: F64, opposite: I32) -> F64:
    """(t,) least cosine between a triangle's normal and its neighbours'; 0 at a border."""
    out = np.ones(len(turned))
    for t in range(len(turned)):
        for k in range(3):
            other = opposite[3 * t + k] // 3 if opposite[3 * t + k] >= 0 else -1
            same = dot(turned[t], turned[other]) if other >= 0 else 0.0
            out[t] = max(0.0, min(out[t], same))
    return out


@kernel
def grow_kernel(
    seeds: NDArray[np.signedinteger], labels: I32, first: int, middle: F64, turned: F64, area: F64, opposite: I32,
    distance: float, cosine: float, least: float,
) -> tuple[I32, F64]:  # fmt: skip
    """Regions grown from seeds (t,) among the triangles without a label, about planes fitted each time they have doubled. Returns labels, those of
    the new regions from `first` on, and the new planes."""
    labels = labels.copy()
    found, count = np.empty((len(labels), 4)), 0
    tried = np.zeros(len(labels), np.bool_)
    queue = np.empty(len(labels), np.int32)
    seen = np.full(len(labels), -1, np.int32)
    for turn in range(len(seeds)):
        seed = seeds[turn]
        if labels[seed] >= 0 or tried[seed]:
            continue
        n, d = turned[seed].copy(), -dot(turned[seed], middle[seed])
        queue[0], size, at, fitted, total = seed, 1, 0, 16, area[seed]
        seen[seed] = seed
        while at < size:
            t = queue[at]
            at += 1
            for k in range(3):
                other = opposite[3 * t + k] // 3 if opposite[3 * t + k] >= 0 else -1
                if other < 0 or labels[other] >= 0 or seen[other] == seed:
                    continue
                if dot(turned[other], n) < cosine or abs(dot(middle[other], n) + d) > distance:
                    continue
                seen[other] = seed
                queue[size] = other
                size += 1
                total += area[other]
            if size >= 2 * fitted:
                fitted = size
                n, d = plane_through(middle, area, queue[:size], n)
        for i in range(size):
            tried[queue[i]] = True
        if total >= least:
            n, d = plane_through(middle, area, queue[:size], n)
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = n[0], n[1], n[2], d
            for i in range(size):
                if abs(dot(middle[queue[i]], n) + d) <= distance:
                    labels[queue[i]] = first + count
            count += 1
    return labels, found[:count].copy()


@kernel
def plane_through(middle: F64, area: F64, rows: I32, like: F64) -> tuple[F64, float]:
    """Least squares plane through the middles of triangles, weighed by area, facing as `like` does."""
    centre, total, scatter, p, n = np.zeros(3), 0.0, np.zeros((3, 3)), np.empty(3), np.empty(3)
    for t in rows:
        for i in range(3):
            centre[i] += area[t] * middle[t, i]
        total += area[t]
    for i in range(3):
        centre[i] /= total
    for t in rows:
        for i in range(3):
            p[i] = middle[t, i] - centre[i]
        for i in range(3):
            for j in range(3):
                scatter[i, j] += area[t] * p[i] * p[j]
    vectors = eigh(scatter)[1]
    for i in range(3):
        n[i] = vectors[i, 0]
    if dot(n, like) < 0.0:
        for i in range(3):
            n[i] = -n[i]
    return n, -dot(n, centre)


@kernel
def add_rim(labels: I32, vertices: F64, triangles: I32, turned: F64, opposite: I32, planes: F64, reach: float) -> I32:
    """One ring more: a triangle beside labelled ones gets the label of the plane nearest to it, if that is near and it does not face away."""
    out = labels.copy()
    for t in range(len(labels)):
        if labels[t] >= 0:
            continue
        best = reach
        for k in range(3):
            other = opposite[3 * t + k]
            p = labels[other // 3] if other >= 0 else -1
            if p < 0 or dot(turned[t], planes[p, :3]) <= 0.2:
                continue
            off = _farthest(vertices, triangles[t], planes[p])
            if off < best:
                best, out[t] = off, p
    return out


@kernel
def remove_steps(labels: I32, triangles: I32, count: int, planes: F64, area: F64) -> I32:
    """No vertex between two planes that are nearly parallel: triangles about it lose the label of the smaller one, and become the step between
    them."""
    largest = np.full(count, -1, np.int32)
    for t in range(len(labels)):
        for k in range(3):
            v = triangles[t, k]
            if labels[t] >= 0 and (largest[v] < 0 or area[labels[t]] > area[largest[v]]):
                largest[v] = labels[t]
    out = labels.copy()
    for t in range(len(labels)):
        for k in range(3):
            p = largest[triangles[t, k]]
            if labels[t] >= 0 and p != labels[t] and abs(dot(planes[p, :3], planes[labels[t], :3])) > 0.9:
                out[t] = -1
    return out


@kernel
def enclosing_planes(parts: I32, count: int, labels: I32, opposite: I32) -> I32:
    """(count,) the one label about each part without label; -1 when there are several, or none, or the part reaches the mesh's border."""
    around = np.full(count, -2, np.int32)
    for t in range(len(parts)):
        if labels[t] >= 0:
            around[parts[t]] = -1
            continue
        for k in range(3):
            other = opposite[3 * t + k]
            if other < 0:
                around[parts[t]] = -1
            elif labels[other // 3] >= 0:
                if around[parts[t]] == -2:
                    around[parts[t]] = labels[other // 3]
                elif around[parts[t]] != labels[other // 3]:
                    around[parts[t]] = -1
    return np.maximum(around, -1)


@kernel
def curvature_kernel(parts: I32, count: int, labels: I32, middle: F64, area: F64, frames: F64) -> F64:
    """Return the larger principal curvature (1/m) of each part (count,), by a quadric over the plane of its frame (3, 3)."""
    centre, total = np.zeros((count, 3)), np.zeros(count)
    for t in range(len(parts)):
        if labels[t] >= 0:
            c = parts[t]
            total[c] += area[t]
            for k in range(3):
                centre[c, k] += area[t] * middle[t, k]
    normal, right, bend, row = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros(count), np.empty(6)
    for t in range(len(parts)):
        if labels[t] < 0:
            continue
        c, F = parts[t], frames[labels[t]]
        px, py, pz = middle[t, 0] - centre[c, 0] / total[c], middle[t, 1] - centre[c, 1] / total[c], middle[t, 2] - centre[c, 2] / total[c]
        x = F[0, 0] * px + F[1, 0] * py + F[2, 0] * pz
        y = F[0, 1] * px + F[1, 1] * py + F[2, 1] * pz
        z = F[0, 2] * px + F[1, 2] * py + F[2, 2] * pz
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, x, y, 0.5 * x * x, x * y, 0.5 * y * y
        for i in range(6):
            weighed = area[t] * row[i]
            right[c, i] += weighed * z
            for j in range(i + 1):
                normal[c, i, j] += weighed * row[j]
    for c in range(count):
        if total[c] > 0.0:
            for i in range(6):
                for j in range(i):
                    normal[c, j, i] = normal[c, i, j]
            for i in range(3, 6):
                normal[c, i, i] += 1e-9 * total[c]  # a strip does not determine its curvature across
            for i in range(6):
                normal[c, i, i] += 1e-12
            q = solve(normal[c], right[c])
            bend[c] = abs(0.5 * (q[3] + q[5])) + np.sqrt(0.25 * (q[3] - q[5]) ** 2 + q[4] ** 2)
    return bend
