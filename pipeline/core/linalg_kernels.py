"""Kernels of small linear algebra in a fixed order, which depends on no BLAS or LAPACK: products, Cholesky, elimination, eigenvalues, inverses,
tangent basis, nearest rotation (polar decomposition)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64

# In loops where numpy would take an expression: numba compiles a sum over an axis, or an assignment to a slice, for a second and more.


@kernel
def copy_matrix(A: F64, out: F64) -> None:
    """Copy A (m, n) into `out`."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j]


@kernel
def sum_matrices(matrices: F64) -> F64:
    """Sum (m, n) of matrices (k, m, n)."""
    out = np.zeros((matrices.shape[1], matrices.shape[2]))
    for k in range(len(matrices)):
        add_matrix(matrices[k], out)
    return out


@kernel
def add_matrix(A: F64, out: F64) -> None:
    """Add A (m, n) to `out`."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] += A[i, j]


@kernel
def add_block(A: F64, out: F64, row: int, column: int) -> None:
    """Add A (m, n) to the block of `out` that begins at (row, column)."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[row + i, column + j] += A[i, j]


@kernel
def split_pose(T: F64) -> tuple[F64, F64]:
    """Rotation (3, 3) and position (3,) of a pose (4, 4)."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        t[i] = T[i, 3]
        for j in range(3):
            R[i, j] = T[i, j]
    return R, t


@kernel
def dot(a: F64, b: F64) -> float:
    """Inner product of (n,) and (n,) numbers."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@kernel
def matvec(A: F64, x: F64) -> F64:
    """Product (m,) of A (m, n) and x (n,)."""
    out = np.empty(A.shape[0])
    for i in range(A.shape[0]):
        out[i] = dot(A[i], x)
    return out


@kernel
def matmul(A: F64, B: F64) -> F64:
    """Product (m, n) of A (m, k) and B (k, n)."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def matmul_each(a: F64, b: F64, out: F64) -> None:
    """Products (p, m, n) of a (p or 1, m, k) and b (p or 1, k, n), k not 0, in the precision of `out`."""
    for p in range(len(out)):
        A, B = a[p if len(a) > 1 else 0], b[p if len(b) > 1 else 0]
        if B.shape[1] < 8:
            for i in range(A.shape[0]):
                for j in range(B.shape[1]):
                    total = A[i, 0] * B[0, j]
                    for k in range(1, A.shape[1]):
                        total += A[i, k] * B[k, j]
                    out[p, i, j] = total
        else:  # the same sums, in an order that reads rows
            for i in range(A.shape[0]):
                for j in range(B.shape[1]):
                    out[p, i, j] = A[i, 0] * B[0, j]
                for k in range(1, A.shape[1]):
                    for j in range(B.shape[1]):
                        out[p, i, j] += A[i, k] * B[k, j]


@kernel
def factor_positive(H: F64, L: F64) -> bool:
    """Fill the lower triangle of L (n, n) with the Cholesky factor of a symmetric H, of which the lower triangle is read; False when H is not
    positive definite."""
    for i in range(len(H)):
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
    return True


@kernel
def solve_positive(H: F64, g: F64, x: F64) -> bool:
    """Fill x with the solution (n,) of `H x = g` for a symmetric positive definite H (n, n), by Cholesky; False, and x zero, when H is not."""
    n = len(g)
    L = np.zeros((n, n))
    for i in range(n):
        x[i] = 0.0
    if not factor_positive(H, L):
        return False
    for i in range(n):
        x[i] = g[i]
    _substitute(L, x)
    return True


@kernel(forceinline=True)
def _substitute(L: F64, x: F64) -> None:
    """Replace the first n numbers of x by the solution of `L Lᵀ y = x` for a Cholesky factor L (n, n)."""
    n = len(L)
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]


@kernel
def inverse_positive(H: F64) -> F64:
    """Inverse of a symmetric positive definite H (n, n); zeros where it is none."""
    n = len(H)
    out, L = np.zeros((n, n)), np.zeros((n, n))
    if factor_positive(H, L):
        for k in range(n):
            out[k, k] = 1.0
            _substitute(L, out[k])
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
def invert_small(S: F64, rows: int, W: F64) -> None:
    """Invert the leading block of 1, 2 or 3 rows of a symmetric matrix into W; the rest is 0."""
    W[:] = 0.0
    if rows == 1:
        W[0, 0] = 1.0 / S[0, 0]
        return
    if rows == 2:
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
        W[0, 0], W[1, 1], W[0, 1], W[1, 0] = S[1, 1] / det, S[0, 0] / det, -S[0, 1] / det, -S[1, 0] / det
        return
    W[0, 0] = S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1]
    W[0, 1] = S[0, 2] * S[2, 1] - S[0, 1] * S[2, 2]
    W[0, 2] = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    W[1, 1] = S[0, 0] * S[2, 2] - S[0, 2] * S[2, 0]
    W[1, 2] = S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2]
    W[2, 2] = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    W[1, 0], W[2, 0], W[2, 1] = W[0, 1], W[0, 2], W[1, 2]
    det = S[0, 0] * W[0, 0] + S[0, 1] * W[1, 0] + S[0, 2] * W[2, 0]
    for i in range(3):
        for j in range(3):
            W[i, j] /= det


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


@kernel
def invert_each(matrices: F64) -> bool:
    """Put the inverses of (n, 3, 3) symmetric matrices in their place; False when one is singular."""
    regular = True
    for k in range(len(matrices)):
        regular &= invert_symmetric(matrices[k], matrices[k]) != 0.0
    return regular


@kernel
def factor_each(matrices: F64) -> bool:
    """Put the Cholesky factors (lower triangles) of (n, k, k) symmetric matrices in their place; False when one is not positive definite."""
    positive = True
    for p in range(len(matrices)):
        L = np.zeros(matrices[p].shape)
        positive &= factor_positive(matrices[p], L)
        copy_matrix(L, matrices[p])
    return positive


@kernel
def solve_each(A: F64, B: F64) -> tuple[bool, F64]:
    """Put solutions X of `A X = B` for (n, k, k) matrices in the place of B (n, k, m), by elimination with row pivots, which overwrites A. Returns
    False when one is singular, and the determinants (n,)."""
    k, regular, determinants = A.shape[1], True, np.ones(len(A))
    for p in range(len(A)):
        M, X = A[p], B[p]
        for c in range(k):
            pivot = c
            for r in range(c + 1, k):
                if abs(M[r, c]) > abs(M[pivot, c]):
                    pivot = r
            if pivot != c:
                determinants[p] = -determinants[p]
                for j in range(c, k):
                    M[c, j], M[pivot, j] = M[pivot, j], M[c, j]
                for j in range(X.shape[1]):
                    X[c, j], X[pivot, j] = X[pivot, j], X[c, j]
            determinants[p] *= M[c, c]
            if M[c, c] == 0.0:
                regular = False
                break
            for r in range(c + 1, k):
                factor = M[r, c] / M[c, c]
                if factor != 0.0:
                    for j in range(c + 1, k):
                        M[r, j] -= factor * M[c, j]
                    for j in range(X.shape[1]):
                        X[r, j] -= factor * X[c, j]
        for r in range(k - 1, -1, -1):
            for j in range(X.shape[1]):
                for c in range(r + 1, k):
                    X[r, j] -= M[r, c] * X[c, j]
                X[r, j] /= M[r, r]
    return regular, determinants


@kernel
def eigh_each(matrices: F64) -> tuple[F64, F64]:
    """Return the eigenvalues (n, k), increasing, and unit eigenvectors (n, k, k), in columns, of symmetric matrices (n, k, k), of which the lower
    triangles are read: by cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, section 8.5). `matrices` is overwritten."""
    n, k = matrices.shape[0], matrices.shape[1]
    values, vectors = np.empty((n, k)), np.zeros((n, k, k))
    for m in range(n):
        A, V = matrices[m], vectors[m]
        for i in range(k):
            V[i, i] = 1.0
            for j in range(i):
                A[j, i] = A[i, j]
        for _ in range(50):
            rotated = False
            for p in range(k - 1):
                for q in range(p + 1, k):
                    if not abs(A[p, q]) > 1e-17 * (abs(A[p, p]) + abs(A[q, q])):  # not NaN either
                        continue
                    rotated = True
                    tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                    t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                    c = 1.0 / np.sqrt(1.0 + t * t)
                    s = t * c
                    for i in range(k):
                        x, y = A[i, p], A[i, q]
                        A[i, p], A[i, q] = c * x - s * y, s * x + c * y
                    for i in range(k):
                        x, y = A[p, i], A[q, i]
                        A[p, i], A[q, i] = c * x - s * y, s * x + c * y
                        x, y = V[i, p], V[i, q]
                        V[i, p], V[i, q] = c * x - s * y, s * x + c * y
                    A[p, q] = A[q, p] = 0.0
            if not rotated:
                break
        for i in range(k):  # sort by insertion, equal ones in their order
            value, j = A[i, i], i
            while j > 0 and values[m, j - 1] > value:
                values[m, j] = values[m, j - 1]
                j -= 1
            values[m, j] = value
            for c in range(i, j, -1):
                for r in range(k):
                    V[r, c - 1], V[r, c] = V[r, c], V[r, c - 1]
    return values, vectors


@kernel
def eigh(A: F64) -> tuple[F64, F64]:
    """Return the eigenvalues (k,), increasing, and unit eigenvectors (k, k), in columns, of a symmetric A (k, k), of which the lower triangle is
    read."""
    copy = np.empty((1, len(A), len(A)))
    copy_matrix(A, copy[0])
    values, vectors = eigh_each(copy)
    return values[0], vectors[0]


@kernel
def solve(A: F64, b: F64) -> F64:
    """Return x (k,) with `A x = b`, by elimination with row pivots; not finite where A is singular."""
    matrix, x = np.empty((1, len(A), len(A))), np.empty((1, len(A), 1))
    copy_matrix(A, matrix[0])
    for i in range(len(b)):
        x[0, i, 0] = b[i]
    solve_each(matrix, x)
    return x[0, :, 0]
