"""Kernels of `outlines.py`: simplification of chains of border edges, and the loops that border half-edges make."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot
from trihedron.pipeline.core.types import F64, I32, Bool


@kernel
def simplify_borders(vertices: F64, begin: I32, end: I32, kinds: I32, fixed: Bool, tolerance: float) -> tuple[Bool, I32]:
    """Simplify chains of border edges (Douglas and Peucker, 1973); returns the vertices (v,) kept and the neighbours (v, 2) of the others."""
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


@kernel
def _walk(first: int, second: int, beside: I32, junction: Bool, done: Bool, chain: I32) -> int:
    """Follow a chain from `first` by `second` up to the next junction, or back to where it began; returns its length, both ends included."""
    chain[0], chain[1], length = first, second, 2
    while not junction[chain[length - 1]] and chain[length - 1] != first:
        here = chain[length - 1]
        done[here] = True
        chain[length] = beside[here, 1] if beside[here, 0] == chain[length - 2] else beside[here, 0]
        length += 1
    return length


@kernel
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


@kernel
def _simplify_ring(vertices: F64, chain: I32, keep: Bool, tolerance: float) -> None:
    """A closed chain, whose last vertex is the first: in halves between two that are far apart."""
    half, farthest = 0, 0.0
    for k in range(len(chain)):
        d = vertices[chain[k]] - vertices[chain[0]]
        if dot(d, d) > farthest:
            farthest, half = dot(d, d), k
    keep[chain[0]] = keep[chain[half]] = True
    _simplify(vertices, chain[: half + 1], keep, tolerance)
    _simplify(vertices, chain[half:], keep, tolerance)


@kernel
def _off_segment(p: F64, a: F64, b: F64) -> float:
    d = b - a
    squared = dot(d, d)
    share = min(max(dot(p - a, d) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    off = p - a - share * d
    return np.sqrt(dot(off, off))


@kernel
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
