"""Residuals of the bundle adjustment: analytic derivatives against numeric ones."""

import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, tangent_basis
from trihedron.pipeline.core.lie import exp_se3, log_so3
from trihedron.pipeline.core.linalg_kernels import tangent_columns
from trihedron.plugins.bundle import local_window_kernels as terms_kernels
from trihedron.plugins.bundle.local_window_kernels import SQUARES, NormalEquations, line_basis, linearise_bundle
from trihedron.plugins.bundle.window import BundleMeasurements, BundleState
from trihedron.plugins.shared.residuals_kernels import PARALLEL, PERPENDICULAR, SAME, depth_direction, plane_residual

sys.path.insert(0, str(Path(__file__).parent))
from derivatives import numeric
from landmark_world import CAMERA

INTRINSICS = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


def shifted(T, xi):
    return T @ exp_se3(xi)


def parts(T):
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


@pytest.fixture(scope="module")
def view():
    """A camera, and what it might see."""
    rng = np.random.default_rng(3)
    T = exp_se3(rng.normal(size=6) * 0.3)
    x = T[:3, :3] @ np.array([0.4, -0.3, 2.5]) + T[:3, 3]
    line = x + np.array([[0.3, 0.1, -0.2], [-0.4, 0.2, 0.3]])
    return T, x, line, np.array([[350.0, 200.0], [300.0, 260.0]])


@pytest.mark.parametrize("depth_m", [2.6, np.nan])
def test_the_normal_equations_of_a_point(view, depth_m):
    """JᵀWJ and JᵀWr with J by numeric derivatives of pixel and inverse depth. A held keyframe measured the same: of one alone H knows nothing."""
    T, x, _, segment = view
    pixel, rows = segment[0], 3 if np.isfinite(depth_m) else 2
    W = np.diag([1.0 / 0.8**2, 1.0 / 0.8**2, (depth_m**2 / 0.02) ** 2][:rows])
    state = BundleState(np.stack([T[:3, :3]] * 2), np.stack([T[:3, 3]] * 2), x[None], np.zeros((0, 2, 3)), np.zeros((0, 4)))
    both, none, pixels = np.arange(2, dtype=np.int32), np.zeros(0, np.int32), np.stack([pixel] * 2)
    seen = BundleMeasurements(
        1, np.stack([INTRINSICS] * 2), np.array([0, 2], np.int32), both, pixels, np.full(2, depth_m), np.full(2, 0.8), np.full(2, 0.02),
        both[:1], none, np.zeros((0, 2, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3, 3)), 1.0,
        none, none, np.zeros((0, 4)), np.zeros((0, 3, 3)), np.zeros((0, 3), np.int32), np.zeros(0),
        np.zeros((0, 2), np.int32), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), True,
    )  # fmt: skip
    out = NormalEquations(np.empty((6, 6)), np.empty(6), np.empty((1, 4, 4)), np.empty((1, 4)), np.empty((2, 6, 4)))

    def residual(T, x):
        local = T[:3, :3].T @ (x - T[:3, 3])
        return np.append(CAMERA.project(local) - pixel, 1.0 / local[2] - 1.0 / depth_m)[:rows]

    r, J = residual(T, x), np.hstack([numeric(lambda d: residual(shifted(T, d), x), 6), numeric(lambda d: residual(T, x + d), 3)])
    assert linearise_bundle(state, seen, SQUARES, out) == pytest.approx(2.0 * r @ W @ r)
    H, g = J.T @ W @ J, J.T @ W @ r
    for found, wanted in (
        (np.tril(out.H), np.tril(H[:6, :6])),
        (np.tril(out.V[0, :3, :3]), 2.0 * np.tril(H[6:, 6:])),
        (out.W[0, :, :3], H[:6, 6:]),
        (np.append(out.g, 0.5 * out.b[0, :3]), g),
    ):
        assert np.allclose(found, wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())


def test_the_normal_equations_of_odometry(view):
    """JᵀLJ and JᵀLr by numeric derivatives, for neighbours in either order of the state, and beside a keyframe that is fixed."""
    rng = np.random.default_rng(6)
    T = [view[0], view[0] @ exp_se3(rng.normal(size=6) * 0.2)]
    Z, L = invert(T[0]) @ T[1] @ exp_se3(rng.normal(size=6) * 1e-3), np.diag(rng.uniform(1.0, 5.0, 6))
    none, lines = np.zeros(0, np.int32), (np.zeros((0, 2, 3)), np.zeros((0, 4)))
    state = BundleState(np.stack([one[:3, :3] for one in T]), np.stack([one[:3, 3] for one in T]), np.zeros((0, 3)), *lines)

    def residual(a, b):
        d = invert(Z) @ invert(a) @ b
        return np.concatenate([d[:3, 3], log_so3(d[:3, :3])])

    for free, (a, b) in ((2, (0, 1)), (1, (0, 1))):
        seen = BundleMeasurements(
            free, np.stack([INTRINSICS] * 2), np.zeros(1, np.int32), none, np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0),
            np.zeros(1, np.int32), none, np.zeros((0, 2, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3, 3)), 1.0,
            none, none, np.zeros((0, 4)), np.zeros((0, 3, 3)), np.zeros((0, 3), np.int32), np.zeros(0),
            np.array([[a, b]], np.int32), Z[None], L[None], True,
        )  # fmt: skip
        out = NormalEquations(np.empty((6 * free, 6 * free)), np.empty(6 * free), np.empty((0, 4, 4)), np.empty((0, 4)), np.empty((0, 6, 4)))
        r = residual(T[a], T[b])
        J = np.hstack([numeric(lambda d: residual(shifted(T[0], d), T[1]), 6), numeric(lambda d: residual(T[0], shifted(T[1], d)), 6)])[:, : 6 * free]
        assert linearise_bundle(state, seen, SQUARES, out) == pytest.approx(r @ L @ r)
        assert np.allclose(np.tril(out.H), np.tril(J.T @ L @ J), atol=2e-2) and np.allclose(out.g, J.T @ L @ r, atol=1e-4)


@pytest.mark.parametrize("share", [0.2, 1.1])
def test_the_derivatives_of_a_line(view, share):
    T, _, line, segment = view
    N, m = np.empty((3, 2)), np.empty(3)
    line_basis(line, N)
    J, p = np.empty(10), np.empty(3)
    observed = np.array([[0.7, -0.2, 2.3], [0.0, -0.1, 2.8]])
    assert depth_direction(observed, m)

    def image(T, line):
        return np.array([terms_kernels.line_term(*parts(T), line, N, share, segment, INTRINSICS, J, p)[0]])

    def depth(T, line):
        image(T, line)
        return np.array([terms_kernels.line_depth_term(parts(T)[0], N, share, observed, m, J, p)[0]])

    for residual in (image, depth):
        residual(T, line)
        by_pose, by_line = J[:6].copy(), J[6:].copy()
        assert np.allclose(by_pose, numeric(lambda d, f=residual: f(shifted(T, d), line), 6)[0], rtol=1e-6, atol=1e-5)
        by_hand = numeric(lambda d, f=residual: f(T, line + np.stack([N @ d[:2], N @ d[2:]])), 4)[0]
        assert np.allclose(by_line, by_hand, rtol=1e-6, atol=1e-5)


def moved_plane(plane, d):
    n = plane[:3] + tangent_basis(plane[:3]) @ d[:2]
    return np.append(n / np.linalg.norm(n), plane[3] + d[2])


def some_planes():
    """Two planes near a right angle, and one near parallel to the first but facing it."""
    rng = np.random.default_rng(4)
    n = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    planes = [np.append(n[0], 1.5), np.append(n[1], -0.7), np.append(-n[0], 2.0)]
    return [moved_plane(plane, rng.normal(size=3) * 0.02) for plane in planes]


def test_the_derivatives_of_a_plane(view):
    T, first = view[0], some_planes()[0]
    observed = np.append(T[:3, :3].T @ moved_plane(first, np.array([0.02, -0.03, 0.0]))[:3], 1.4)
    B, r, J_pose, J_plane = np.empty((3, 2)), np.empty(3), np.empty((3, 6)), np.empty((3, 3))
    tangent_columns(observed[:3], B)

    def at(T, plane):
        plane_residual(SAME, *parts(T), plane, observed, B, r, J_pose)
        return r.copy()

    at(T, first)
    by_pose = J_pose.copy()
    terms_kernels.plane_jacobian(*parts(T), first, B, J_plane)
    assert np.allclose(by_pose, numeric(lambda d: at(shifted(T, d), first), 6), atol=1e-8)
    assert np.allclose(J_plane, numeric(lambda d: at(T, moved_plane(first, d)), 3), atol=1e-8)


@pytest.mark.parametrize("kind, other", [(PERPENDICULAR, 1), (PARALLEL, 2)])
def test_the_derivatives_of_a_relation(kind, other):
    planes = some_planes()
    a, b = planes[0], planes[other]
    B, r, J_a, J_b = np.empty((3, 2)), np.empty(2), np.empty((2, 3)), np.empty((2, 3))
    tangent_columns(b, B)

    def at(a, b):
        rows = terms_kernels.relation_residual(kind, a, b, B, r, J_a, J_b)
        return r[:rows].copy()

    rows = len(at(a, b))
    by_a, by_b = J_a[:rows].copy(), J_b[:rows].copy()
    assert rows == (1 if kind == PERPENDICULAR else 2)
    assert np.allclose(by_a, numeric(lambda d: at(moved_plane(a, d), b), 3), atol=1e-8)
    assert np.allclose(by_b, numeric(lambda d: at(a, moved_plane(b, d)), 3), atol=1e-8)
