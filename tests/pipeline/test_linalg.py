"""Linear algebra without BLAS and LAPACK: equal to NumPy's within rounding, and a function of values and shapes alone, whatever the strides."""

import numpy as np
import pytest

from trihedron.pipeline.core import linalg, linalg_kernels

SHAPES = [
    ((3, 3), (3, 3)), ((3, 3), (3,)), ((3,), (3, 2)), ((6,), (6,)), ((3,), (5, 3, 2)), ((5, 2, 3), (3,)), ((5, 2, 3), (3, 4)), ((2, 3), (5, 3, 4)),
    ((5, 1, 2, 3), (4, 3, 3)), ((7, 6, 6), (7, 6, 6)), ((1, 6, 6), (40, 6, 6)), ((40, 6, 6), (1, 6, 6)), ((3, 40, 6, 6), (40, 6, 3)),
    ((300, 1, 6, 6), (4, 6, 3)), ((6, 6), (40, 6, 6)), ((500, 3), (3, 3)), ((20, 500, 3), (3, 3)), ((60, 128), (128, 50)), ((0, 3), (3, 3)),
    ((4, 0), (0, 3)), ((0, 3, 3), (0, 3, 3)),
]  # fmt: skip


def strided(x):
    """The same values with other strides: every second element of an array in Fortran's order."""
    out = np.zeros(tuple(2 * n for n in x.shape), x.dtype, order="F")[tuple(slice(None, None, 2) for _ in x.shape)]
    out[...] = x
    return out


@pytest.mark.parametrize("shapes", SHAPES, ids=str)
def test_products(shapes):
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=shape) for shape in shapes)
    found = linalg.matmul(a, b)
    np.testing.assert_allclose(found, a @ b, rtol=1e-12, atol=1e-12)
    assert np.shape(found) == np.shape(a @ b)
    np.testing.assert_array_equal(linalg.matmul(strided(a), strided(b)), found)
    for first, second in ((np.float32, np.float32), (np.float32, np.float64)):
        x, y = a.astype(first), b.astype(second)
        assert linalg.matmul(x, y).dtype == (x @ y).dtype
        np.testing.assert_allclose(linalg.matmul(x, y), x @ y, rtol=1e-4, atol=1e-4)


def test_products_of_several_of_integers_and_of_shapes_that_do_not_fit():
    a, b, c = np.random.default_rng(1).normal(size=(3, 4, 4))
    np.testing.assert_array_equal(linalg.matmul(a, b, c), linalg.matmul(linalg.matmul(a, b), c))
    np.testing.assert_array_equal(linalg.matmul(np.arange(6), np.arange(12).reshape(6, 2)), np.arange(6) @ np.arange(12).reshape(6, 2))
    for n in (2, 200):
        with pytest.raises(ValueError):
            linalg.matmul(np.ones((n, 3)), np.ones((4, 3)))
    assert linalg.norm(strided(a)) == linalg.norm(a) == pytest.approx(np.linalg.norm(a), rel=1e-15)


def matrices(n):
    """Regular, symmetric positive definite, of ranks 1 and n - 1, ill-conditioned, diagonal, with equal eigenvalues, zero; (m, n, n)."""
    rng = np.random.default_rng(n)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    spectra = [rng.uniform(1, 2, n), rng.normal(size=n), np.eye(n)[0], np.r_[0.0, np.ones(n - 1)], np.logspace(-12, 0, n), np.ones(n)]
    return np.array([*((Q * s) @ Q.T for s in spectra), np.diag(np.arange(n)[::-1]), np.eye(n), np.zeros((n, n))])


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_eigenvalues(n):
    A = matrices(n)
    A = 0.5 * (A + np.swapaxes(A, 1, 2))
    values, vectors = linalg.eigh(A)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-14 * n)
    np.testing.assert_array_equal(values, linalg.eigvalsh(A))
    np.testing.assert_allclose(np.swapaxes(vectors, 1, 2) @ vectors, np.broadcast_to(np.eye(n), A.shape), atol=1e-14)
    np.testing.assert_allclose((vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2), A, atol=1e-14 * n)
    for k in range(len(A)):
        found = linalg.eigh(strided(A[k])), linalg_kernels.eigh(np.tril(A[k]))
        for one in found:
            np.testing.assert_array_equal(one[0], values[k])
            np.testing.assert_array_equal(one[1], vectors[k])
    assert linalg.eigh(np.full((n, n), np.nan))[0].shape == (n,)
    assert [one.shape for one in linalg.eigh(np.zeros((0, n, n)))] == [(0, n), (0, n, n)]
    small = linalg.eigh(1e-200 * A)[0]
    np.testing.assert_allclose(small, 1e-200 * values, atol=1e-214 * n)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_solutions_inverses_determinants_and_factors(n):
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(8, n, n)), rng.normal(size=(8, n, 2))
    A[0] = np.eye(n)[::-1]  # needs pivots
    np.testing.assert_allclose(linalg.inv(A), np.linalg.inv(A), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linalg.solve(A, b), np.linalg.solve(A, b), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linalg.solve(A[3], b[:, :, :]), np.linalg.solve(A[3], b), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linalg.solve(A[2], b[2, :, 0]), np.linalg.solve(A[2], b[2, :, 0]), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(linalg.solve(A[2], b[2, :, 0]), linalg_kernels.solve(A[2], b[2, :, 0]))
    np.testing.assert_allclose(linalg.det(A), np.linalg.det(A), rtol=1e-12, atol=1e-12)
    assert linalg.det(A[1]) == linalg.det(strided(A[1])) == linalg.det(A)[1]
    H = A @ np.swapaxes(A, 1, 2) + np.eye(n)
    np.testing.assert_allclose(linalg.cholesky(H), np.linalg.cholesky(H), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linalg.inv(1e-100 * np.eye(n)), 1e100 * np.eye(n))  # whose determinant is 0 in double precision
    assert linalg.inv(A.astype(np.float32)).dtype == linalg.det(A.astype(np.float32)).dtype == np.float32
    assert linalg.inv(A[:0]).shape == linalg.cholesky(A[:0]).shape == linalg.solve(A[:0], A[:0]).shape == (0, n, n)
    singular = np.zeros((2, n, n)) + np.eye(n)
    singular[1, -1] = 0.0
    np.testing.assert_array_equal(linalg.det(singular), [1.0, 0.0])
    for call in (linalg.inv, linalg.cholesky, lambda A: linalg.solve(A, np.ones(n))):
        with pytest.raises(np.linalg.LinAlgError):
            call(singular)
    with pytest.raises(np.linalg.LinAlgError):
        linalg.cholesky(-np.eye(n))


def test_products_in_kernels():
    A, B = np.random.default_rng(2).normal(size=(2, 6, 6))
    np.testing.assert_allclose(linalg_kernels.matmul(A.T, B), A.T @ B, rtol=1e-12)
    np.testing.assert_allclose(linalg_kernels.matvec(A, B[0]), A @ B[0], rtol=1e-12)
    assert linalg_kernels.dot(A[0], B[0]) == pytest.approx(A[0] @ B[0], rel=1e-12)
