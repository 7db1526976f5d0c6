"""Kernels of small linear algebra: Cholesky, inverses, tangent basis, nearest rotation (polar decomposition); and sorting."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32


@kernel
def solve_positive(H: F64, g: F64, x: F64) -> bool:
    """x (n,) with `H x = g` for a symmetric positive definite H (n, n), by Cholesky; False, and x zero, when H is not positive definite."""
    n = len(g)
    L = np.zeros((n, n))
    for i in range(n):
        x[i] = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = np.sqrt(total)
            else:
                return False
    for i in range(n):
        x[i] = g[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return True


@kernel
def inverse_positive(H: F64) -> F64:
    """Inverse of a symmetric positive definite H (n, n); zeros where it is none."""
    n = len(H)
    out, unit = np.empty((n, n)), np.zeros(n)
    for k in range(n):
        unit[k] = 1.0
        solve_positive(H, unit, out[k])
        unit[k] = 0.0
    return out


@kernel(forceinline=True)
def invert_symmetric(S: F64, out: F64) -> float:
    """Inverse of a symmetric S (3, 3), in single precision too, into `out`, by cofactors; returns the determinant."""
    a, b, c = np.float64(S[0, 0]), np.float64(S[0, 1]), np.float64(S[0, 2])
    d, e, f = np.float64(S[1, 1]), np.float64(S[1, 2]), np.float64(S[2, 2])
    u, v, w = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * u + b * v + c * w
    out[0, 0], out[1, 1], out[2, 2] = u / determinant, (a * f - c * c) / determinant, (a * d - b * b) / determinant
    out[0, 1], out[0, 2], out[1, 2] = v / determinant, w / determinant, (b * c - a * e) / determinant
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return determinant


@kernel(forceinline=True)
def tangent_columns(n: F64, B: F64) -> None:
    """Fill the columns of B (3, 2) with `geometry.tangent_basis` of a unit vector n (3,)."""
    s = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    B[0, 0], B[1, 0], B[2, 0] = 1.0 + s * n[0] * n[0] * a, s * b, -s * n[0]
    B[0, 1], B[1, 1], B[2, 1] = b, s + n[1] * n[1] * a, -n[1]


@kernel(forceinline=True)
def add_triple(row: F64, first: int, x: float, y: float, z: float) -> None:
    """Add three numbers to a row, from column `first`."""
    row[first] += x
    row[first + 1] += y
    row[first + 2] += z


@kernel(forceinline=True)
def add_triangle(H: F64, k: int, h00: float, h10: float, h11: float, h20: float, h21: float, h22: float) -> None:
    """Add a symmetric block (3, 3), given by rows of its lower triangle, to H at (k, k)."""
    H[k, k] += h00
    H[k + 1, k] += h10
    H[k + 1, k + 1] += h11
    H[k + 2, k] += h20
    H[k + 2, k + 1] += h21
    H[k + 2, k + 2] += h22


@kernel
def polar_rotation(M: F64) -> F64:
    """The rotation nearest to M (3, 3), as `geometry.nearest_rotation`: one-sided Jacobi rotations make the columns of `A = M V` orthogonal
    (Hestenes, 1958), and R takes the two largest of them from V to their directions, the third by the cross product. Small columns keep their
    precision."""
    A, V = M.copy(), np.eye(3)
    for _ in range(12):
        largest = 0.0
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b, c = 0.0, 0.0, 0.0
            for k in range(3):
                a, b, c = a + A[k, p] * A[k, p], b + A[k, q] * A[k, q], c + A[k, p] * A[k, q]
            if c * c <= 1e-32 * a * b:
                continue
            largest = max(largest, c * c / (a * b))
            tau = (b - a) / (2.0 * c)
            t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
            cosine = 1.0 / np.sqrt(1.0 + t * t)
            for X in (A, V):
                for k in range(3):
                    u, v = X[k, p], X[k, q]
                    X[k, p], X[k, q] = cosine * (u - t * v), cosine * (t * u + v)
        if largest < 1e-28:
            break
    return _from_columns(A, V)


@kernel
def _from_columns(A: F64, V: F64) -> F64:
    """The rotation that takes columns of V (3, 3), a rotation, to the directions of the same columns of A (3, 3), orthogonal and of any length."""
    square = np.empty(3)
    for k in range(3):
        square[k] = A[0, k] ** 2 + A[1, k] ** 2 + A[2, k] ** 2
    first, second = 0, 1  # the longest columns
    for k in range(1, 3):
        if square[k] > square[first]:
            first, second = k, first
        elif k == 2 and square[k] > square[second]:
            second = k
    if square[first] == 0.0:
        return np.eye(3)
    U, W = np.zeros((3, 3)), np.empty((3, 3))
    for i, k in ((0, first), (1, second)):
        length = np.sqrt(square[k])
        for r in range(3):
            W[r, i] = V[r, k]
            U[r, i] = A[r, k] / length if length > 0.0 else 0.0
    if square[second] == 0.0:  # any direction across
        axis = 0
        for r in range(1, 3):
            if abs(U[r, 0]) < abs(U[axis, 0]):
                axis = r
        along = U[axis, 0]
        for r in range(3):
            U[r, 1] = (1.0 if r == axis else 0.0) - along * U[r, 0]
        length = np.sqrt(U[0, 1] ** 2 + U[1, 1] ** 2 + U[2, 1] ** 2)
        for r in range(3):
            U[r, 1] /= length
    for X in (U, W):
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            X[k, 2] = X[i, 0] * X[j, 1] - X[j, 0] * X[i, 1]
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += U[i, k] * W[j, k]
    return out


# Sorting, without the interpreter's lock.

DIGIT = 11  # bits sorted by at a time: six digits of a double, whose counts stay in the nearest cache


@kernel
def descending(values: F64) -> I32:
    """Sort the rows of (n,) numbers from the largest to the smallest, equal ones in their order. A radix sort: thousands in a fifth of a merge sort's
    time."""
    n, sign = len(values), np.uint64(1 << 63)
    keys = (0.0 - values).view(np.uint64)  # no -0
    for i in range(n):
        keys[i] = ~keys[i] if keys[i] & sign else keys[i] | sign
    order, other, sorted_keys = np.arange(n).astype(np.int32), np.empty(n, np.int32), np.empty(n, np.uint64)
    count = np.empty(1 << DIGIT, np.int32)
    for shift in range(0, 64, DIGIT):
        count[:] = 0
        for i in range(n):
            count[(keys[i] >> np.uint64(shift)) & np.uint64((1 << DIGIT) - 1)] += 1
        total = 0
        for digit in range(len(count)):
            count[digit], total = total, total + count[digit]
        for i in range(n):
            digit = (keys[i] >> np.uint64(shift)) & np.uint64((1 << DIGIT) - 1)
            sorted_keys[count[digit]], other[count[digit]] = keys[i], order[i]
            count[digit] += 1
        keys, sorted_keys, order, other = sorted_keys, keys, other, order
    return order


@kernel
def invert_each(matrices: F64) -> bool:
    """Put the inverses of (n, 3, 3) symmetric matrices in their place; False when one is singular."""
    regular = True
    for k in range(len(matrices)):
        regular &= invert_symmetric(matrices[k], matrices[k]) != 0.0
    return regular
