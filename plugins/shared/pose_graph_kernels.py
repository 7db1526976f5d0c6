"""Kernel of `pose_graph.py`: Cholesky factorisation of a sparse matrix within its envelope."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32


@kernel
def solve_envelope(starts: I32, columns: I32, values: F64, g: F64) -> F64:
    """Solve `H x = g` for a symmetric positive definite H (n, n) in compressed rows, of which the lower triangle is read (George and Liu, Computer
    Solution of Large Sparse Positive Definite Systems, 1981, chapter 4). Returns x (n, m), as g, NaN when H is not positive definite."""
    n = len(g)
    first = np.arange(n)  # column of each row's first element
    for i in range(n):
        for k in range(starts[i], starts[i + 1]):
            first[i] = min(first[i], columns[k])
    at = np.zeros(n, np.int64)  # element (i, j) of the factor is L[at[i] + j]
    size = 0
    for i in range(n):
        at[i] = size - first[i]
        size += i + 1 - first[i]
    L, x = np.zeros(size), g.copy()
    for i in range(n):
        for k in range(starts[i], starts[i + 1]):
            if columns[k] <= i:
                L[at[i] + columns[k]] = values[k]
        for j in range(first[i], i + 1):
            total = L[at[i] + j]
            for k in range(max(first[i], first[j]), j):
                total -= L[at[i] + k] * L[at[j] + k]
            if j < i:
                L[at[i] + j] = total / L[at[j] + j]
            elif total > 0.0:
                L[at[i] + i] = np.sqrt(total)
            else:
                return np.full(g.shape, np.nan)
        for c in range(g.shape[1]):
            for k in range(first[i], i):
                x[i, c] -= L[at[i] + k] * x[k, c]
            x[i, c] /= L[at[i] + i]
    for i in range(n - 1, -1, -1):
        for c in range(g.shape[1]):
            x[i, c] /= L[at[i] + i]
            for k in range(first[i], i):
                x[k, c] -= L[at[i] + k] * x[i, c]
    return x
