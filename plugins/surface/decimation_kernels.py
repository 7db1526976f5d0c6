"""Kernels of `decimation.py`: half-edge collapse that leaves the mesh a manifold and turns no triangle over."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.shared.voxel_hash_kernels import I64

MOST = 1024  # triangles about a vertex; one with more stays
ROUNDS = 30  # at most, over all vertices; most are gone after five
FLAT_M2 = 1e-9  # a triangle with less area has none


@kernel
def collapse_all(
    vertices: F64, triangles: I32, labels: I32, normals: F64, border: Bool, free: Bool, beside: I32, order: I32, alive: Bool
) -> None:  # fmt: skip
    """Collapse half-edges in place, in the given order of vertices, as `decimation.py` allows it; `alive` (t,) are the triangles that remain."""
    n = len(vertices)
    head, tail, after = np.full(n, -1, np.int32), np.full(n, -1, np.int32), np.full(3 * len(triangles), -1, np.int32)
    for c in range(3 * len(triangles)):
        v = triangles[c // 3, c % 3]
        if head[v] < 0:
            head[v] = c
        else:
            after[tail[v]] = c
        tail[v] = c
    mark, stamp = np.zeros(n, np.int64), 0
    gone = np.zeros(n, np.bool_)
    mine, theirs, targets, far = np.empty(MOST, np.int32), np.empty(MOST, np.int32), np.empty(MOST, np.int32), np.empty(MOST)
    for _ in range(ROUNDS):
        changed = 0
        for u in order:
            if gone[u] or head[u] < 0 or (border[u] and not free[u]):
                continue
            count = _incident(u, alive, head, tail, after, mine)
            if count == 0 or labels[mine[0]] < 0:
                continue
            for v in targets[: _targets(u, mine[:count], vertices, triangles, border, beside, targets, far)]:
                stamp += 2
                size = _incident(v, alive, head, tail, after, theirs)
                if _may_collapse(u, v, mine[:count], theirs[:size], vertices, triangles, labels, normals, mark, stamp):
                    _collapse(u, v, mine[:count], triangles, alive, head, tail, after)
                    if border[u]:
                        other = beside[u, 0] if beside[u, 1] == v else beside[u, 1]
                        _relink(beside, v, u, other)
                        _relink(beside, other, u, v)
                    gone[u] = True
                    changed += 1
                    break
        if changed == 0:
            break


@kernel
def _incident(v: int, alive: Bool, head: I32, tail: I32, after: I32, out: I32) -> int:
    """Write the living triangles about v and return their number, 0 when they are too many; its list forgets the dead ones."""
    count, c, last = 0, head[v], -1
    while c >= 0:
        if alive[c // 3]:
            if count < MOST:
                out[count] = c // 3
            count += 1
            last = c
        elif last >= 0:
            after[last] = after[c]
        else:
            head[v] = after[c]
        c = after[c]
    tail[v] = last
    return count if count <= MOST else 0


@kernel
def _targets(u: int, mine: I32, vertices: F64, triangles: I32, border: Bool, beside: I32, found: I32, far: F64) -> int:
    """Write where u may go, the nearest first, and return their number: to its neighbours on the border, or to any."""
    count = 2 if border[u] else len(mine)
    for i in range(count):
        if border[u]:
            v = beside[u, i]
        else:  # each neighbour of an inner vertex follows it in one triangle
            t, k = mine[i], 0
            while triangles[t, k] != u:
                k += 1
            v = triangles[t, (k + 1) % 3]
        x, y, z = vertices[v, 0] - vertices[u, 0], vertices[v, 1] - vertices[u, 1], vertices[v, 2] - vertices[u, 2]
        squared, at = x * x + y * y + z * z, i
        while at > 0 and far[at - 1] > squared:
            found[at], far[at] = found[at - 1], far[at - 1]
            at -= 1
        found[at], far[at] = v, squared
    return count


@kernel
def _may_collapse(u: int, v: int, mine: I32, theirs: I32, vertices: F64, triangles: I32, labels: I32, normals: F64, mark: I64, stamp: int) -> bool:
    """Return True if u may be drawn into v: the two have no common neighbours but those across from their edge (link condition), and no triangle
    turns over."""
    removed = 0
    for t in mine:
        has = triangles[t, 0] == v or triangles[t, 1] == v or triangles[t, 2] == v
        removed += 1 if has else 0
        for k in range(3):
            mark[triangles[t, k]] = stamp
    if removed == 0 or removed > 2 or len(theirs) == 0:
        return False
    common = 0
    for t in theirs:
        for k in range(3):
            w = triangles[t, k]
            if w != u and w != v and mark[w] == stamp:
                mark[w] = stamp + 1
                common += 1
    if common != removed:
        return False
    for t in mine:
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if a == v or b == v or c == v:
            continue
        x, y, z = normals[labels[t], 0], normals[labels[t], 1], normals[labels[t], 2]
        then = _signed_area(vertices, v if a == u else a, v if b == u else b, v if c == u else c, x, y, z)
        if then < FLAT_M2 and then < _signed_area(vertices, a, b, c, x, y, z) - 1e-3 * FLAT_M2:  # one that has no area already may stay so
            return False
    return True


@kernel(inline="always")
def _signed_area(vertices: F64, a: int, b: int, c: int, x: float, y: float, z: float) -> float:
    """Area of a triangle seen against the normal (x, y, z), negative when it is seen from behind."""
    x1, y1, z1 = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    x2, y2, z2 = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return 0.5 * ((y1 * z2 - z1 * y2) * x + (z1 * x2 - x1 * z2) * y + (x1 * y2 - y1 * x2) * z)


@kernel
def _collapse(u: int, v: int, mine: I32, triangles: I32, alive: Bool, head: I32, tail: I32, after: I32) -> None:
    for t in mine:
        if triangles[t, 0] == v or triangles[t, 1] == v or triangles[t, 2] == v:
            alive[t] = False
        else:
            for k in range(3):
                if triangles[t, k] == u:
                    triangles[t, k] = v
    if tail[v] >= 0:
        after[tail[v]] = head[u]
    else:
        head[v] = head[u]
    tail[v] = tail[u]
    head[u] = tail[u] = -1


@kernel(inline="always")
def _relink(beside: I32, v: int, old: int, new: int) -> None:
    if beside[v, 0] == old:
        beside[v, 0] = new
    elif beside[v, 1] == old:
        beside[v, 1] = new
