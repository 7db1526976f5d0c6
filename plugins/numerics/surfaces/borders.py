"""The borders between the parts of a mesh: which of their vertices are kept when they are simplified, and the loops they make.

A border is a chain of edges between two junctions, and is simplified once, for the parts on both of its sides: neighbours keep the same vertices, so
no vertex of one lies within an edge of the other."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.numerics.surfaces.half_edges import crowded

REST = -1  # the part of triangles that lie in no plane


def border_half_edges(parts: I32, opposite: I32) -> I32:
    """The half-edges (n,) of planar triangles (t,) beyond which there is another part, or nothing."""
    own = np.repeat(parts, 3)
    beyond = np.where(opposite >= 0, parts[np.maximum(opposite, 0) // 3], REST - 1)
    return np.flatnonzero((own != REST) & (own != beyond)).astype(np.int32)


def fixed_vertices(count: int, triangles: I32, parts: I32, opposite: I32) -> Bool:
    """(v,) vertices that stay whatever happens: those of triangles in no plane, and those of edges with more than two triangles."""
    fixed = np.zeros(count, np.bool_)
    fixed[triangles[parts == REST]] = True
    shared = crowded(triangles, opposite)
    fixed[triangles.ravel()[shared]] = fixed[triangles[:, [1, 2, 0]].ravel()[shared]] = True
    return fixed


def kept_vertices(vertices: F64, triangles: I32, parts: I32, opposite: I32, border: I32, fixed: Bool, tolerance_m: float) -> tuple[Bool, I32]:
    """(v,) border vertices that are kept: fixed ones, junctions, and those that the chains between need to stay within the tolerance
    (Douglas and Peucker 1973); and (v, 2) the neighbours of the others along their chains."""
    chosen = border[(opposite[border] < 0) | (parts[np.maximum(opposite[border], 0) // 3] == REST) | (border < opposite[border])]
    begin, end = triangles.ravel()[chosen], triangles[:, [1, 2, 0]].ravel()[chosen]
    far = np.where(opposite[chosen] >= 0, parts[np.maximum(opposite[chosen], 0) // 3], REST - 1)
    sides = np.sort(np.stack([parts[chosen // 3], far], axis=1), axis=1).astype(np.int64)
    kinds = sides[:, 0] * (parts.max() + 4) + sides[:, 1]
    return _kept(vertices, begin.astype(np.int32), end.astype(np.int32), kinds, fixed, tolerance_m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _kept(vertices: F64, begin: I32, end: I32, kinds: I32, fixed: Bool, tolerance: float) -> tuple[Bool, I32]:
    n = len(vertices)
    degree, kind, beside = np.zeros(n, np.int32), np.zeros(n, np.int64), np.full((n, 2), -1, np.int32)
    junction = fixed.copy()
    for e in range(len(begin)):
        for v, other in ((begin[e], end[e]), (end[e], begin[e])):
            if degree[v] < 2:
                beside[v, degree[v]] = other
            if degree[v] > 0 and kind[v] != kinds[e]:
                junction[v] = True
            kind[v] = kinds[e]
            degree[v] += 1
    keep, done, chain = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.empty(n + 1, np.int32)
    for v in range(n):
        junction[v] = degree[v] > 0 and (junction[v] or degree[v] != 2)
        keep[v] = junction[v]
    for e in range(len(begin)):  # chains from junction to junction
        for first, second in ((begin[e], end[e]), (end[e], begin[e])):
            if junction[first] and not junction[second] and not done[second]:
                _simplify(vertices, chain[: _walk(first, second, beside, junction, done, chain)], keep, tolerance)
    for v in range(n):  # rings without a junction
        if degree[v] > 0 and not junction[v] and not done[v]:
            done[v] = True
            length = _walk(v, beside[v, 0], beside, junction, done, chain)
            _simplify_ring(vertices, chain[:length], keep, tolerance)
    return keep, beside


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walk(first: int, second: int, beside: I32, junction: Bool, done: Bool, chain: I32) -> int:
    """Follow a chain from `first` by `second` up to the next junction, or back to where it began; returns its length, both ends included."""
    chain[0], chain[1], length = first, second, 2
    while not junction[chain[length - 1]] and chain[length - 1] != first:
        here = chain[length - 1]
        done[here] = True
        chain[length] = beside[here, 1] if beside[here, 0] == chain[length - 2] else beside[here, 0]
        length += 1
    return length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _simplify(vertices: F64, chain: I32, keep: Bool, tolerance: float) -> None:
    """Mark what the chain between its two ends needs."""
    stack, top = np.empty((len(chain), 2), np.int32), 1
    stack[0, 0], stack[0, 1] = 0, len(chain) - 1
    while top:
        top -= 1
        a, b = stack[top, 0], stack[top, 1]
        worst, at = tolerance, -1
        for k in range(a + 1, b):
            off = _off_segment(vertices[chain[k]], vertices[chain[a]], vertices[chain[b]])
            if off > worst:
                worst, at = off, k
        if at >= 0:
            keep[chain[at]] = True
            stack[top, 0], stack[top, 1] = a, at
            stack[top + 1, 0], stack[top + 1, 1] = at, b
            top += 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _simplify_ring(vertices: F64, chain: I32, keep: Bool, tolerance: float) -> None:
    """A closed chain, whose last vertex is the first: in halves between two that are far apart."""
    half, farthest = 0, 0.0
    for k in range(len(chain)):
        d = vertices[chain[k]] - vertices[chain[0]]
        if np.dot(d, d) > farthest:
            farthest, half = np.dot(d, d), k
    keep[chain[0]] = keep[chain[half]] = True
    _simplify(vertices, chain[: half + 1], keep, tolerance)
    _simplify(vertices, chain[half:], keep, tolerance)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _off_segment(p: F64, a: F64, b: F64) -> float:
    d = b - a
    squared = np.dot(d, d)
    share = min(max(np.dot(p - a, d) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    off = p - a - share * d
    return np.sqrt(np.dot(off, off))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def loops(border: I32, parts: I32, opposite: I32) -> tuple[I32, I32]:
    """The border half-edges (n,) in the order in which they go round their parts, and where each loop begins (l + 1,)."""
    position = np.full(3 * len(parts), -1, np.int32)
    for i in range(len(border)):
        position[border[i]] = i
    done, order, starts, count, found = np.zeros(len(border), np.bool_), np.empty(len(border), np.int32), np.empty(len(border) + 1, np.int32), 0, 0
    for i in range(len(border)):
        if done[i]:
            continue
        starts[found] = count
        found += 1
        h = border[i]
        while not done[position[h]]:
            done[position[h]] = True
            order[count] = h
            count += 1
            part = parts[h // 3]
            h = h - h % 3 + (h % 3 + 1) % 3
            while opposite[h] >= 0 and parts[opposite[h] // 3] == part:  # round the vertex, through the part
                h = opposite[h]
                h = h - h % 3 + (h % 3 + 1) % 3
    starts[found] = count
    return order, starts[: found + 1].copy()
