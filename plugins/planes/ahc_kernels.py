"""Numba kernels of `ahc.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.planes.blocks_kernels import DEPTHS, SUMS, block_mse, block_plane

# Agglomerative hierarchical clustering of blocks into planes (Feng, Taguchi and Kamat, ICRA 2014).


@kernel
def cluster_blocks(sums: F64, block_limit: float, limit: float, excess: float, least: float) -> tuple[I32, F64]:
    """Labels (rows, cols) of the blocks, 0 = none, and q (k, 3) of their clusters.

    `sums` as from `block_sums`. A block is a node when its own mse is below `block_limit`, and neighbours are linked. Whichever cluster has the
    least mse is joined to the neighbour with which the joint mse is least, as long as that is below `limit` and raises the mse of neither part by
    `excess` or more (which keeps a large plane from swallowing a small step); else it is finished, and a plane when it has `least` depths."""
    rows, cols = sums.shape[:2]
    n = rows * cols
    flat = sums.reshape(n, SUMS).copy()
    parent, version, closed = np.arange(n).astype(np.int32), np.zeros(n, np.int32), np.zeros(n, np.bool_)
    heap = np.empty((2 * n + 1, 3))  # mse, cluster, its version
    size = 0
    own = np.empty(n)
    for i in range(n):
        own[i] = block_plane(flat[i])[3]
        closed[i] = not own[i] < block_limit
        if not closed[i]:
            size = _push(heap, size, own[i], i, 0)
    first, last, following, other = _links(closed, rows, cols)
    seen = np.full(n, -1, np.int32)
    joint, finished = np.empty(SUMS), np.zeros(n, np.bool_)
    turn = 0
    while size > 0:
        i, stamp = int(heap[0, 1]), int(heap[0, 2])
        size = _pop(heap, size)
        if parent[i] != i or version[i] != stamp:
            continue
        turn += 1
        best, partner = limit, -1
        edge, before = first[i], -1
        while edge >= 0:
            j = _root(parent, other[edge])
            if j == i or closed[j] or seen[j] == turn:
                following_edge = following[edge]
                before = _unlink(first, last, following, i, before, edge)
                edge = following_edge
                continue
            seen[j] = turn
            before, edge = edge, following[edge]
            for k in range(SUMS):
                joint[k] = flat[i, k] + flat[j, k]
            a, b, c, mse = block_plane(joint)
            if mse < best and block_mse(flat[i], a, b, c) - own[i] < excess and block_mse(flat[j], a, b, c) - own[j] < excess:
                best, partner = mse, j
        if partner < 0:
            closed[i] = True
            finished[i] = flat[i, DEPTHS] >= least
            continue
        parent[partner] = i
        for k in range(SUMS):
            flat[i, k] += flat[partner, k]
        _append(first, last, following, i, partner)
        own[i] = best
        version[i] += 1
        size = _push(heap, size, best, i, version[i])
    return _label_blocks(parent, finished, flat, rows, cols)


@kernel
def _label_blocks(parent: I32, finished: np.ndarray, flat: F64, rows: int, cols: int) -> tuple[I32, F64]:
    """Labels of the blocks and q of the clusters that are finished, in the order of their first blocks."""
    n = rows * cols
    number, labels = np.zeros(n, np.int32), np.zeros(n, np.int32)
    planes = np.zeros((int(finished.sum()), 3))
    found = 0
    for i in range(n):
        root = _root(parent, i)
        if not finished[root]:
            continue
        if number[root] == 0:
            planes[found, 0], planes[found, 1], planes[found, 2], _ = block_plane(flat[root])
            found += 1
            number[root] = found
        labels[i] = number[root]
    return labels.reshape(rows, cols), planes


@kernel
def _root(parent: I32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def _links(closed: np.ndarray, rows: int, cols: int) -> tuple[I32, I32, I32, I32]:
    """Linked lists of each node's neighbours in its row and column: first and last edge of a node, the edge after an edge, and where it leads."""
    n = rows * cols
    first, last = np.full(n, -1, np.int32), np.full(n, -1, np.int32)
    following, other = np.full(4 * n, -1, np.int32), np.empty(4 * n, np.int32)
    edges = 0
    for i in range(n):
        if closed[i]:
            continue
        for step, inside in ((-cols, i >= cols), (-1, i % cols > 0), (1, i % cols < cols - 1), (cols, i < n - cols)):
            if inside and not closed[i + step]:
                other[edges] = i + step
                if first[i] < 0:
                    first[i] = edges
                else:
                    following[last[i]] = edges
                last[i] = edges
                edges += 1
    return first, last, following, other


@kernel
def _unlink(first: I32, last: I32, following: I32, i: int, before: int, edge: int) -> int:
    """Take an edge out of the list of node i; returns the edge before it."""
    if before < 0:
        first[i] = following[edge]
    else:
        following[before] = following[edge]
    if last[i] == edge:
        last[i] = before
    return before


@kernel
def _append(first: I32, last: I32, following: I32, i: int, j: int) -> None:
    """Hang the list of node j behind that of node i."""
    if first[j] < 0:
        return
    if first[i] < 0:
        first[i] = first[j]
    else:
        following[last[i]] = first[j]
    last[i] = last[j]


@kernel
def _push(heap: F64, size: int, mse: float, i: int, version: int) -> int:
    """Put an entry into the heap (least mse on top, then least number); returns the new size."""
    k = size
    heap[k, 0], heap[k, 1], heap[k, 2] = mse, i, version
    while k > 0:
        up = (k - 1) // 2
        if not _before(heap, k, up):
            break
        _swap(heap, k, up)
        k = up
    return size + 1


@kernel
def _pop(heap: F64, size: int) -> int:
    """Take the top off the heap; returns the new size."""
    size -= 1
    _swap(heap, 0, size)
    k = 0
    while 2 * k + 1 < size:
        down = 2 * k + 1
        if down + 1 < size and _before(heap, down + 1, down):
            down += 1
        if not _before(heap, down, k):
            break
        _swap(heap, k, down)
        k = down
    return size


@kernel
def _before(heap: F64, k: int, m: int) -> bool:
    return heap[k, 0] < heap[m, 0] or (heap[k, 0] == heap[m, 0] and heap[k, 1] < heap[m, 1])


@kernel
def _swap(heap: F64, k: int, m: int) -> None:
    for i in range(3):
        heap[k, i], heap[m, i] = heap[m, i], heap[k, i]
