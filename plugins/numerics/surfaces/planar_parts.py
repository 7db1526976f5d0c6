"""Which triangles of a dense mesh lie in planes: those of the map first, then planes that only the mesh shows."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Map
from trihedron.plugins.numerics.surfaces.bends import bends
from trihedron.plugins.numerics.surfaces.half_edges import connected, triangle_areas


@dataclass(frozen=True)
class Flatness:
    """What counts as flat."""

    distance_m: float  # of a vertex from its plane
    angle_deg: float  # between the mesh's normal there and the plane's
    rim_m: float  # of a vertex from its plane in the rounded rim about it
    rim: int  # triangles wide
    area_m2: float  # of the smallest planar part
    bend_per_m: float  # curvature above which a part is not flat

    def __post_init__(self) -> None:
        if not 0.0 < self.distance_m <= self.rim_m or not 0.0 < self.angle_deg < 90.0:
            raise ValueError("distance_m, rim_m, angle_deg: 0 < distance_m <= rim_m, and an angle within 0 … 90")
        if self.rim < 0 or self.area_m2 <= 0.0 or self.bend_per_m <= 0.0:
            raise ValueError("rim, area_m2, bend_per_m: at least 0, and positive")


def map_planes(map: Map | None) -> tuple[I32, F64]:
    """Ids (n,) and coefficients (n, 4) of the living planes."""
    if map is None:
        return np.empty(0, np.int32), np.empty((0, 4))
    ids = np.flatnonzero(map.planes.column("alive")).astype(np.int32)
    return ids, map.planes.rows("coefficients", ids)


def numbered(ids: I32, count: int, map: Map | None) -> I32:
    """Ids for `count` planes: the map's, then numbers that it has not given for those that are not in it."""
    first = len(map.planes) if map is not None else 0
    return np.concatenate([ids, np.arange(first, first + count - len(ids))]).astype(np.int32)


def planar_labels(vertices: F64, normals: F64, triangles: I32, opposite: I32, planes: F64, flat: Flatness) -> tuple[I32, F64]:
    """(t,) row of the plane each triangle lies in, -1 for none, and the planes (p, 4): the given (n, 4), then those found in the mesh, fitted to
    it."""
    cosine = float(np.cos(np.radians(flat.angle_deg)))
    turned = normals[triangles].mean(axis=1)
    turned /= np.maximum(np.linalg.norm(turned, axis=1), 1e-12)[:, None]
    area, middle = triangle_areas(vertices, triangles), vertices[triangles].mean(axis=1)
    labels = _on_planes(vertices, triangles, turned, planes, flat.distance_m, cosine)
    labels = _large(labels, middle, opposite, area, planes, flat)
    seeds = np.argsort(-np.abs(_steadiness(turned, opposite)), kind="stable")
    grown, found = _grown(seeds, labels, len(planes), middle, turned, area, opposite, flat.distance_m, cosine, flat.area_m2)
    planes = np.concatenate([planes, found])
    labels = _large(grown, middle, opposite, area, planes, flat)
    labels = _joined(labels, middle, area, opposite, planes, flat.distance_m)
    planes = _fitted(labels, middle, area, planes)
    for _ in range(flat.rim):
        labels = _with_rim(labels, vertices, triangles, turned, opposite, planes, flat.rim_m)
    labels = _without_steps(labels, triangles, len(vertices), planes, np.bincount(labels + 1, area, len(planes) + 1)[1:])
    return _large(_filled(labels, vertices, triangles, opposite, planes, flat), middle, opposite, area, planes, flat), planes


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _on_planes(vertices: F64, triangles: I32, turned: F64, planes: F64, distance: float, cosine: float) -> I32:
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


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _farthest(vertices: F64, corners: I32, plane: F64) -> float:
    off = 0.0
    for k in range(3):
        v = vertices[corners[k]]
        off = max(off, abs(v[0] * plane[0] + v[1] * plane[1] + v[2] * plane[2] + plane[3]))
    return off


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _steadiness(turned: F64, opposite: I32) -> F64:
    """(t,) least cosine between a triangle's normal and its neighbours'; 0 at a border."""
    out = np.ones(len(turned))
    for t in range(len(turned)):
        for k in range(3):
            other = opposite[3 * t + k] // 3 if opposite[3 * t + k] >= 0 else -1
            same = np.dot(turned[t], turned[other]) if other >= 0 else 0.0
            out[t] = max(0.0, min(out[t], same))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _grown(
    seeds: I32, labels: I32, first: int, middle: F64, turned: F64, area: F64, opposite: I32, distance: float, cosine: float, least: float
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
        n, d = turned[seed].copy(), -np.dot(turned[seed], middle[seed])
        queue[0], size, at, fitted, total = seed, 1, 0, 16, area[seed]
        seen[seed] = seed
        while at < size:
            t = queue[at]
            at += 1
            for k in range(3):
                other = opposite[3 * t + k] // 3 if opposite[3 * t + k] >= 0 else -1
                if other < 0 or labels[other] >= 0 or seen[other] == seed:
                    continue
                if np.dot(turned[other], n) < cosine or abs(np.dot(middle[other], n) + d) > distance:
                    continue
                seen[other] = seed
                queue[size] = other
                size += 1
                total += area[other]
            if size >= 2 * fitted:
                fitted = size
                n, d = _plane_through(middle, area, queue[:size], n)
        for i in range(size):
            tried[queue[i]] = True
        if total >= least:
            n, d = _plane_through(middle, area, queue[:size], n)
            found[count, :3], found[count, 3] = n, d
            for i in range(size):
                if abs(np.dot(middle[queue[i]], n) + d) <= distance:
                    labels[queue[i]] = first + count
            count += 1
    return labels, found[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_through(middle: F64, area: F64, rows: I32, like: F64) -> tuple[F64, float]:
    """Least squares plane through the middles of triangles, weighed by area, facing as `like` does."""
    centre, total = np.zeros(3), 0.0
    for t in rows:
        centre += area[t] * middle[t]
        total += area[t]
    centre /= total
    scatter = np.zeros((3, 3))
    for t in rows:
        p = middle[t] - centre
        for i in range(3):
            for j in range(3):
                scatter[i, j] += area[t] * p[i] * p[j]
    n = np.ascontiguousarray(np.linalg.eigh(scatter)[1][:, 0])
    if np.dot(n, like) < 0.0:
        n = -n
    return n, -np.dot(n, centre)


def _joined(labels: I32, middle: F64, area: F64, opposite: I32, planes: F64, distance: float) -> I32:
    """Planes that touch, and of which the larger one fits the smaller one's triangles within the distance (RMS), are one, such as a floor that was
    mapped twice. The larger keeps its identity."""
    h = np.flatnonzero(opposite >= 0)
    here, there = labels[h // 3], labels[opposite[h] // 3]
    seams = (here >= 0) & (there >= 0) & (here != there)
    pairs = np.unique(np.stack([here[seams], there[seams]], axis=1), axis=0)
    total = np.bincount(labels + 1, area, len(planes) + 1)[1:]
    out, stands_for = labels.copy(), np.arange(len(planes))
    for small in np.argsort(total, kind="stable"):
        beside = np.unique(stands_for[pairs[stands_for[pairs[:, 0]] == small, 1]])
        rows = np.flatnonzero(out == small)
        beside = beside[(total[beside] >= total[small]) & (beside != small)]
        for large in beside[np.argsort(-total[beside], kind="stable")]:
            off = middle[rows] @ planes[large, :3] + planes[large, 3]
            if planes[large, :3] @ planes[small, :3] > 0.9 and np.average(off**2, weights=area[rows]) <= distance**2:
                out[rows], stands_for[stands_for == small] = large, large
                total[large] += total[small]
                break
    return out


def _fitted(labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """The planes, each moved to its triangles by least squares."""
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(len(planes) + 1))
    out = planes.copy()
    for p in range(len(planes)):
        rows = order[bounds[p] : bounds[p + 1]].astype(np.int32)
        if len(rows) >= 3:
            out[p, :3], out[p, 3] = _plane_through(middle, area, rows, planes[p, :3].copy())
    return out


def _large(labels: I32, middle: F64, opposite: I32, area: F64, planes: F64, flat: Flatness) -> I32:
    """The labels without the connected parts that are too small, or bent."""
    parts, count = connected(opposite, labels)
    total = np.bincount(parts, area, count)
    bend = bends(parts, count, labels, middle, area, planes)
    return np.where((total[parts] >= flat.area_m2) & (bend[parts] <= flat.bend_per_m), labels, -1).astype(np.int32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _with_rim(labels: I32, vertices: F64, triangles: I32, turned: F64, opposite: I32, planes: F64, reach: float) -> I32:
    """One ring more: a triangle beside labelled ones gets the label of the plane nearest to it, if that is near and it does not face away."""
    out = labels.copy()
    for t in range(len(labels)):
        if labels[t] >= 0:
            continue
        best = reach
        for k in range(3):
            other = opposite[3 * t + k]
            p = labels[other // 3] if other >= 0 else -1
            if p < 0 or np.dot(turned[t], planes[p, :3]) <= 0.2:
                continue
            off = _farthest(vertices, triangles[t], planes[p])
            if off < best:
                best, out[t] = off, p
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _without_steps(labels: I32, triangles: I32, count: int, planes: F64, area: F64) -> I32:
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
            if labels[t] >= 0 and p != labels[t] and abs(np.dot(planes[p, :3], planes[labels[t], :3])) > 0.9:
                out[t] = -1
    return out


def _filled(labels: I32, vertices: F64, triangles: I32, opposite: I32, planes: F64, flat: Flatness) -> I32:
    """Small holes in a planar part, all about it and near its plane, belong to it."""
    parts, count = connected(opposite, labels)
    around = _enclosing(parts, count, labels, opposite)
    near = np.ones(count, np.bool_)
    area = np.bincount(parts, triangle_areas(vertices, triangles), count)
    hole = (around >= 0) & (area < flat.area_m2)
    rows = np.flatnonzero((labels < 0) & hole[parts])
    plane = planes[around[parts[rows]]]
    off = np.abs(np.einsum("tkj,tj->tk", vertices[triangles[rows]], plane[:, :3]) + plane[:, 3:]).max(axis=1)
    near[parts[rows[off > flat.rim_m]]] = False
    rows = rows[near[parts[rows]]]
    out = labels.copy()
    out[rows] = around[parts[rows]]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _enclosing(parts: I32, count: int, labels: I32, opposite: I32) -> I32:
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
