"""Numba kernels of `common_meshes.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.shared.voxel_hash_kernels import I64

OPEN = -1  # beyond a half-edge: nothing, or more than one triangle


@kernel
def paired(triangles: I32, count: int) -> I32:
    """Half-edges sorted by the lower of their vertices, then compared with those of the same."""
    size = 3 * len(triangles)
    starts, high = np.zeros(count + 1, np.int32), np.empty(size, np.int32)
    for h in range(size):
        a, b = triangles[h // 3, h % 3], triangles[h // 3, (h + 1) % 3]
        starts[min(a, b) + 1] += 1
        high[h] = max(a, b)
    for v in range(count):
        starts[v + 1] += starts[v]
    order, filled = np.empty(size, np.int32), starts[:-1].copy()
    for h in range(size):
        v = min(triangles[h // 3, h % 3], triangles[h // 3, (h + 1) % 3])
        order[filled[v]] = h
        filled[v] += 1
    out = np.full(size, OPEN, np.int32)
    for v in range(count):
        for i in range(starts[v], starts[v + 1]):
            h, other, found = order[i], OPEN, 0
            for j in range(starts[v], starts[v + 1]):
                if j != i and high[order[j]] == high[h]:
                    other, found = order[j], found + 1
            if found == 1 and triangles[other // 3, other % 3] != triangles[h // 3, h % 3]:
                out[h] = other
    return out


@kernel
def connected(opposite: I32, labels: I32) -> tuple[I32, int]:
    """(t,) numbers of the connected sets of triangles of equal label, from 0 in the order of their first triangle, and their count."""
    n = len(labels)
    parts, stack, count = np.full(n, -1, np.int32), np.empty(n, np.int32), 0
    for seed in range(n):
        if parts[seed] >= 0:
            continue
        parts[seed], stack[0], top = count, seed, 1
        while top:
            top -= 1
            t = stack[top]
            for k in range(3):
                other = opposite[3 * t + k]
                if other >= 0 and parts[other // 3] < 0 and labels[other // 3] == labels[seed]:
                    parts[other // 3] = count
                    stack[top] = other // 3
                    top += 1
        count += 1
    return parts, count


@kernel
def _join(root: I32, a: int, b: int) -> None:
    while root[a] != a:
        root[a] = root[root[a]]
        a = root[a]
    while root[b] != b:
        root[b] = root[root[b]]
        b = root[b]
    root[max(a, b)] = min(a, b)


@kernel
def fans_kernel(opposite: I32) -> I32:
    """(3 t,) the least corner of the fan that each corner belongs to: corners at the two ends of an edge are those of the triangle beyond it."""
    root = np.arange(len(opposite), dtype=np.int32)
    for h in range(len(opposite)):
        o = opposite[h]
        if o > h:
            _join(root, h, o - o % 3 + (o % 3 + 1) % 3)
            _join(root, h - h % 3 + (h % 3 + 1) % 3, o)
    for c in range(len(root)):
        while root[root[c]] != root[c]:
            root[c] = root[root[c]]
    return root


@kernel
def triangle_normals(vertices: F64, triangles: I32) -> F64:
    """(t, 3) normals, as long as twice the area."""
    out = np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        x2, y2, z2 = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        out[t, 0], out[t, 1], out[t, 2] = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    return out


@kernel
def gather(normals: F64, triangles: I32, total: F64) -> None:
    for t in range(len(triangles)):
        for k in range(3):
            for axis in range(3):
                total[triangles[t, k], axis] += normals[t, axis]


@kernel
def kept(vertices: F64, begin: I32, end: I32, kinds: I32, fixed: Bool, tolerance: float) -> tuple[Bool, I32]:
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


# Planar parts of a mesh with as few vertices as their borders need: half-edge collapse that leaves the mesh a manifold and turns no triangle
# over.

MOST = 1024  # triangles about a vertex; one with more stays
ROUNDS = 30  # at most, over all vertices; most are gone after five
FLAT_M2 = 1e-9  # a triangle with less area has none


@kernel
def collapse_all(
    vertices: F64, triangles: I32, labels: I32, normals: F64, border: Bool, free: Bool, beside: I32, order: I32, alive: Bool
) -> None:  # fmt: skip
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
                if _allowed(u, v, mine[:count], theirs[:size], vertices, triangles, labels, normals, mark, stamp):
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
def _allowed(u: int, v: int, mine: I32, theirs: I32, vertices: F64, triangles: I32, labels: I32, normals: F64, mark: I64, stamp: int) -> bool:
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
        then = _signed(vertices, v if a == u else a, v if b == u else b, v if c == u else c, x, y, z)
        if then < FLAT_M2 and then < _signed(vertices, a, b, c, x, y, z) - 1e-3 * FLAT_M2:  # one that has no area already may stay so
            return False
    return True


@kernel(inline="always")
def _signed(vertices: F64, a: int, b: int, c: int, x: float, y: float, z: float) -> float:
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
