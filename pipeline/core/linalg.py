"""Linear algebra whose results depend on the values and shapes alone: on no BLAS or LAPACK, which round as the processor suits them.

The functions are those of NumPy with the same names, for arrays (..., m, n) of float64, or of float32, whose precision the result has. The order of
operations is fixed, whatever the strides. Elementwise functions, sums, `np.einsum` without `optimize`, `np.cross`, `np.outer` and `np.linalg.norm`
with an axis call no BLAS, and need no replacement. Kernels have theirs in `linalg_kernels`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import ArrayLike, NDArray

from trihedron.pipeline.core import linalg_kernels as kernels
from trihedron.pipeline.core.types import F32, F64

SUBSCRIPTS = {(1, 1): "i,i->", (1, 2): "j,...jk->...k", (2, 1): "...ij,j->...i", (2, 2): "...ij,...jk->...ik"}  # by dimensions, two at most
SMALL = 1000  # multiplications, below which the call of a kernel takes longer than they do


def matmul(a: ArrayLike, b: ArrayLike, *more: ArrayLike) -> NDArray[Any]:
    """Multiply matrices (..., m, k) and (..., k, n) as `a @ b` does, vectors (k,) included, and the result by each of `more`."""
    x, y = np.ascontiguousarray(a), np.ascontiguousarray(b)
    if x.ndim > 1 and y.ndim > 1 and x.size * y.shape[-1] > SMALL and x.dtype.kind == y.dtype.kind == "f":
        out = _matmul_each(x, y)
    else:
        out = np.einsum(SUBSCRIPTS[min(x.ndim, 2), min(y.ndim, 2)], x, y)
    return matmul(out, *more) if more else out


def _matmul_each(a: Any, b: Any) -> Any:
    """Multiply contiguous matrices (..., m, k) and (..., k, n), by a kernel."""
    if a.shape[-1] != b.shape[-2]:
        raise ValueError(f"matmul: shapes {a.shape} and {b.shape} do not fit")
    dtype = np.result_type(a, b)
    if b.ndim == 2:  # one long matrix
        out = np.empty((*a.shape[:-1], b.shape[-1]), dtype)
        a, stack = a.reshape(1, -1, a.shape[-1]), out.reshape(1, -1, b.shape[-1])
    else:
        shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        out = np.empty((*shape, a.shape[-2], b.shape[-1]), dtype)
        if math.prod(a.shape[:-2]) > 1:
            a = np.broadcast_to(a, (*shape, *a.shape[-2:]))
        if math.prod(b.shape[:-2]) > 1:
            b = np.broadcast_to(b, (*shape, *b.shape[-2:]))
        stack = out.reshape(-1, *out.shape[-2:])
    kernels.matmul_each(_stack(a, dtype), _stack(b, dtype), stack)
    return out


def _stack(matrices: Any, dtype: Any) -> Any:
    """Reshape (..., m, n) to contiguous (p, m, n), read-only, so that a kernel is compiled for one type of array."""
    stack = np.ascontiguousarray(matrices, dtype).reshape(-1, *matrices.shape[-2:]).view()
    stack.flags.writeable = False
    return stack


def _copies(matrices: ArrayLike) -> tuple[F64, Any, tuple[int, ...]]:
    """Copy square matrices (..., k, k) to (n, k, k) in double precision; returns the precision of results too, and the leading shape."""
    given = np.asarray(matrices)
    copy = np.array(given, np.float64, order="C").reshape(-1, *given.shape[-2:])
    return copy, given.dtype if given.dtype == np.float32 else np.dtype(np.float64), given.shape[:-2]


def norm(x: ArrayLike) -> float:
    """Return the square root of the sum of squares of all elements; `np.linalg.norm` does it along an axis."""
    values = np.ascontiguousarray(x).ravel()
    return float(np.sqrt((values * values).sum()))


def solve(A: ArrayLike, b: ArrayLike) -> NDArray[Any]:
    """Solve `A x = b` for A (..., k, k) and b (k,) or (..., k, m), by elimination with row pivots. Raises LinAlgError where A is singular."""
    matrices, dtype, leading = _copies(A)
    right = np.asarray(b)
    columns = right[:, None] if right.ndim == 1 else right
    shape = np.broadcast_shapes(leading, columns.shape[:-2])
    if shape != leading:
        matrices = np.array(np.broadcast_to(np.asarray(A), (*shape, *matrices.shape[1:])), np.float64, order="C").reshape(-1, *matrices.shape[1:])
    out = np.array(np.broadcast_to(columns, (*shape, *columns.shape[-2:])), np.float64, order="C")
    if not kernels.solve_each(matrices, out.reshape(-1, *out.shape[-2:]))[0]:
        raise LinAlgError("singular matrix")
    return (out[..., 0] if right.ndim == 1 else out).astype(np.result_type(dtype, right), copy=False)


def inv(A: ArrayLike) -> NDArray[Any]:
    """Invert matrices (..., k, k) by elimination with row pivots. Raises LinAlgError where one is singular."""
    matrices, dtype, _ = _copies(A)
    out = np.zeros(matrices.shape)
    out[:] = np.eye(matrices.shape[-1])
    if not kernels.solve_each(matrices, out)[0]:
        raise LinAlgError("singular matrix")
    return out.reshape(np.shape(A)).astype(dtype, copy=False)


def inv_symmetric(matrices: F32 | F64) -> F64:
    """Invert symmetric matrices (..., k, k): covariance to information or the other way round. Raises LinAlgError if one is singular."""
    if matrices.shape[-1] != 3:
        return np.asarray(inv(matrices.astype(np.float64)), np.float64)
    out = np.array(matrices, np.float64, order="C")
    if not kernels.invert_each(out.reshape(-1, 3, 3)):
        raise LinAlgError("Singular matrix")
    return out


def det(A: ArrayLike) -> Any:
    """Return the determinants (...) of matrices (..., k, k)."""
    matrices, dtype, leading = _copies(A)
    found = kernels.solve_each(matrices, np.empty((len(matrices), matrices.shape[-1], 0)))[1]
    return found.reshape(leading).astype(dtype, copy=False)[()]


def cholesky(A: ArrayLike) -> NDArray[Any]:
    """Return the lower triangular L with `A = L Lᵀ` of symmetric matrices (..., k, k). Raises LinAlgError where one is not positive definite."""
    matrices, dtype, _ = _copies(A)
    if not kernels.factor_each(matrices):
        raise LinAlgError("not positive definite")
    return matrices.reshape(np.shape(A)).astype(dtype, copy=False)


def eigh(A: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the eigenvalues (..., k), increasing, and unit eigenvectors (..., k, k), in columns, of symmetric matrices (..., k, k), of which the
    lower triangles are read; by Jacobi rotations."""
    matrices, dtype, _ = _copies(A)
    values, vectors = kernels.eigh_each(matrices)
    return values.reshape(np.shape(A)[:-1]).astype(dtype, copy=False), vectors.reshape(np.shape(A)).astype(dtype, copy=False)


def eigvalsh(A: ArrayLike) -> NDArray[Any]:
    """Return the eigenvalues (..., k), increasing, of symmetric matrices (..., k, k)."""
    return eigh(A)[0]
