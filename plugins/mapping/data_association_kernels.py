"""Kernels of `data_association.py`: parallel and perpendicular planes, and one-to-one pairs."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32


@kernel
def related_planes(
    planes: F64, known: F64, same: I32, order: NDArray[np.int64], ids: I32, parallel_above: float, perpendicular_below: float, most: int
) -> tuple[I32, I32]:
    """Pair (row, id) each plane with up to `most` known ones, first in order, that are parallel to it, and perpendicular, without the same plane."""
    n, one = len(planes), np.full(len(planes), -1, np.int32)
    parallel, perpendicular = np.empty((n * most, 2), np.int32), np.empty((n * most, 2), np.int32)
    p, q = 0, 0
    for k in range(len(same)):
        one[same[k, 0]] = same[k, 1]
    for i in range(n):
        p_end, q_end = p + most, q + most
        for j in order:
            cosine = abs(planes[i, 0] * known[j, 0] + planes[i, 1] * known[j, 1] + planes[i, 2] * known[j, 2])
            if j == one[i]:
                continue
            if cosine > parallel_above and p < p_end:
                parallel[p, 0], parallel[p, 1] = i, ids[j]
                p += 1
            if cosine < perpendicular_below and q < q_end:
                perpendicular[q, 0], perpendicular[q, 1] = i, ids[j]
                q += 1
    return parallel[:p], perpendicular[:q]


@kernel(nogil=False)
def pairs_by_row(found: I32, ids: I32, count: int) -> I32:
    """Sort the rows found for landmarks (-1 = none; of `count` rows, none for two) into pairs (row, id), (n, 2), by row."""
    owner, pairs, n = np.full(count, -1, np.int32), np.empty((len(found), 2), np.int32), 0
    for i in range(len(found)):
        if found[i] >= 0:
            owner[found[i]] = ids[i]
    for row in range(count):
        if owner[row] >= 0:
            pairs[n, 0], pairs[n, 1] = row, owner[row]
            n += 1
    return pairs[:n]
