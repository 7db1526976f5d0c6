"""Geometry, residuals and solvers at any rotation and any scale from a millimetre to a kilometre (hypothesis)."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core import geometry as g
from trihedron.pipeline.core import lie
from trihedron.plugins.bundle import local_window_kernels
from trihedron.plugins.bundle.local_window_kernels import line_basis
from trihedron.plugins.shared import pose_graph, pose_optimizer, pose_optimizer_kernels, relative_motion_kernels, residuals_kernels
from trihedron.plugins.shared.pose_optimizer import NO_LINES, NO_PLANES, solve_pose
from trihedron.plugins.shared.residuals_kernels import PARALLEL, PERPENDICULAR, SAME, PlaneTerms, PointTerms, Weights

sys.path.insert(0, str(Path(__file__).parent))
from derivatives import numeric
from landmark_world import CAMERA

INTRINSICS = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
SMALLEST_M, LARGEST_M = 1e-3, 1e3
MANY = settings(max_examples=60, deadline=None, derandomize=True)
FEW = settings(MANY, max_examples=15)

numbers = st.integers(0, 2**32 - 1).map(np.random.default_rng)
angles = st.one_of(st.floats(0.0, np.pi - 1e-7), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, np.pi - 1e-7]))
scales_m = st.floats(np.log10(SMALLEST_M), np.log10(LARGEST_M)).map(lambda power: 10.0**power)


def direction(rng):
    n = rng.normal(size=3)
    return n / np.linalg.norm(n)


def pose(rng, angle, scale_m):
    return g.pose_matrix(lie.exp_so3(angle * direction(rng)), scale_m * rng.normal(size=3))


def parts(T):
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def agree(analytic, by_differences, size):
    """Within what differences of numbers of that size can tell."""
    return np.allclose(analytic, by_differences, rtol=2e-5, atol=1e-6 * size)


@MANY
@given(numbers, angles, scales_m)
def test_exp_and_log_undo_each_other(rng, angle, scale_m):
    xi = np.concatenate([scale_m * rng.normal(size=3), angle * direction(rng)])
    T = lie.exp_se3(xi)
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-14 and np.linalg.det(T[:3, :3]) > 0.0
    assert np.abs(lie.exp_so3(lie.log_so3(T[:3, :3])) - T[:3, :3]).max() < 1e-13  # near 180° the vector itself may be the other one
    assert np.allclose(lie.exp_se3(lie.log_se3(T)), T, rtol=0.0, atol=1e-9 * max(1.0, scale_m))
    if angle < 3.0:
        assert np.allclose(lie.log_se3(T), xi, rtol=1e-9, atol=1e-12)


@MANY
@given(numbers, angles, scales_m)
def test_a_motion_and_its_inverse_and_quaternions(rng, angle, scale_m):
    T = pose(rng, angle, scale_m)
    assert np.allclose(g.invert(T) @ T, np.eye(4), atol=1e-12 * max(1.0, scale_m))
    assert np.allclose(g.rotation_from_quaternion(g.quaternion_from_rotation(T[:3, :3])), T[:3, :3], atol=1e-12)
    points = g.transform(T, scale_m * rng.normal(size=(5, 3)))
    plane = np.append(direction(rng), scale_m * rng.normal())
    there = g.transform_planes(T, plane[None])[0]
    assert np.allclose(points @ there[:3] + there[3], g.transform(g.invert(T), points) @ plane[:3] + plane[3], atol=1e-12 * max(1.0, scale_m))


@MANY
@given(numbers, angles, scales_m, st.booleans())
def test_a_point_s_derivatives(rng, angle, scale_m, with_depth):
    """By the pose, at depths from 10 cm to a kilometre; and the normal equations of tracking, which are written out, are those of them."""
    T, depth = pose(rng, angle, scale_m), max(scale_m, 0.1)
    local = np.array([0.3, -0.4, 1.0]) * depth * rng.uniform(0.7, 1.4)
    world, pixel, seen = g.transform(T, local), np.array([300.0, 200.0]), depth if with_depth else np.nan
    r, D, J = np.empty(3), np.empty((3, 3)), np.empty((3, 6))

    def residual(T):
        assert residuals_kernels.point_residual(g.transform(g.invert(T), world), pixel, seen, INTRINSICS, r, D)
        return r.copy()

    residual(T)
    residuals_kernels.pose_jacobian(D, 3, g.transform(g.invert(T), world), J)
    step = np.array([depth, depth, depth, 1.0, 1.0, 1.0])
    assert agree(J * step, numeric(lambda d: residual(T @ lie.exp_se3(step * d)), 6), 1e3)
    W = np.diag([1.0, 0.7, depth**2 if with_depth else 0.0])
    W[0, 1] = W[1, 0] = 0.2
    one, none = np.ones(1), (np.empty((0, 2, 2)), np.empty((0, 2, 2)), np.empty((0, 3, 3)))
    terms = PointTerms(world[None], np.zeros((1, 3, 3)), pixel[None], np.array([seen]), one, one)
    flags = pose_optimizer.Flags(np.full(1, pose_optimizer.INLIER, np.uint8), np.empty(0, np.uint8), np.empty(0, np.uint8))
    H, gradient, chi2 = np.empty((6, 6)), np.empty(6), pose_optimizer_kernels.Chi2(np.empty(1), np.empty(0), np.empty(0), np.empty(0))
    weights = Weights(W[None], *none)
    pose_optimizer_kernels.linearise(*parts(T), INTRINSICS, terms, NO_LINES, NO_PLANES, weights, flags, False, 6, H, gradient, chi2)
    wanted = residual(T)
    assert chi2.points[0] == pytest.approx(wanted @ W @ wanted, rel=1e-6)
    assert np.allclose(np.tril(H * np.outer(step, step)), np.tril((J * step).T @ W @ (J * step)), rtol=1e-6, atol=1.0)
    assert np.allclose(gradient * step, (J * step).T @ W @ wanted, rtol=1e-6, atol=1e-2)


@MANY
@given(numbers, angles, scales_m)
def test_a_line_s_derivatives(rng, angle, scale_m):
    """Across the segment in the image and along its free direction in depth, by pose and by the line."""
    T, depth = pose(rng, angle, scale_m), max(scale_m, 0.1)
    local = np.array([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.2]]) * depth * rng.uniform(0.8, 1.2, (2, 1))
    line, segment, observed = g.transform(T, local), np.array([[380.0, 160.0], [210.0, 260.0]]), local * rng.uniform(0.95, 1.05, (2, 1))
    N, m, J, p = np.empty((3, 2)), np.empty(3), np.empty(10), np.empty(3)
    line_basis(line, N)
    assert residuals_kernels.depth_direction(observed, m)

    def image(T, line):
        return np.array([local_window_kernels.line_term(*parts(T), line, N, 0.3, segment, INTRINSICS, J, p)[0]])

    def depths(T, line):
        image(T, line)
        return np.array([local_window_kernels.line_depth_term(parts(T)[0], N, 0.3, observed, m, J, p)[0]]) / depth

    step = np.array([depth, depth, depth, 1.0, 1.0, 1.0])
    for residual, unit, size in ((image, 1.0, 1e3), (depths, depth, 1.0)):
        residual(T, line)
        by_pose, by_line = J[:6] * step / unit, J[6:] * depth / unit
        assert agree(by_pose, numeric(lambda d, f=residual: f(T @ lie.exp_se3(step * d), line), 6)[0], size)
        assert agree(by_line, numeric(lambda d, f=residual: f(T, line + depth * np.stack([N @ d[:2], N @ d[2:]])), 4)[0], size)


@MANY
@given(numbers, angles, scales_m, st.sampled_from([(SAME, 3), (PARALLEL, 2), (PERPENDICULAR, 1)]))
def test_a_plane_s_derivatives(rng, angle, scale_m, kind):
    kind, rows = kind
    T = pose(rng, angle, scale_m)
    observed = np.append(direction(rng), scale_m)
    B = g.tangent_basis(observed[:3])
    local = observed[:3] if kind != PERPENDICULAR else B[:, 0]
    world = g.transform_planes(T, np.append(local, scale_m * 1.01)[None])[0] * (-1.0 if kind == PARALLEL else 1.0)

    def residual(T, J=None):
        r, J = np.empty(3), np.empty((3, 6)) if J is None else J
        assert residuals_kernels.plane_residual(kind, *parts(T), world, observed, B, r, J) == rows
        return r[:rows] / np.array([1.0, 1.0, scale_m])[:rows]

    J, step = np.empty((3, 6)), np.repeat([scale_m, 1.0], 3)
    residual(T, J)
    found = J[:rows] * step / np.array([1.0, 1.0, scale_m])[:rows, None]
    assert agree(found, numeric(lambda d: residual(T @ lie.exp_se3(step * d)), 6), 1.0)


@MANY
@given(numbers, angles, scales_m)
def test_the_gradient_of_the_motion_between_two_frames(rng, angle, scale_m):
    """Places and planes, as `solve_motion` weighs them; without robust weights (a very large scale)."""
    R, t = lie.exp_so3(angle * direction(rng)), scale_m * rng.normal(size=3)
    before = scale_m * rng.normal(size=(4, 3))
    after = before @ R.T + t + 0.05 * scale_m * rng.normal(size=(4, 3))
    A = rng.normal(size=(4, 3, 3))
    planes = np.array([np.append(direction(rng), scale_m) for _ in range(2)])
    seen = g.transform_planes(g.pose_matrix(R, t), planes) + 0.02 * np.array([1.0, 1.0, 1.0, scale_m])
    weight = np.diag([1.0, 1.0, 1.0, scale_m**-2])
    terms = relative_motion_kernels.Terms(before, after, A @ np.swapaxes(A, 1, 2) / scale_m**2, planes, seen, np.tile(weight, (2, 1, 1)))
    H, gradient = np.zeros((6, 6)), np.zeros(6)
    relative_motion_kernels._normal_equations(terms, R, t, 1e30, H, gradient)

    def cost(d):
        R_there = np.ascontiguousarray(lie.exp_so3(d[:3]) @ R)
        return np.array([0.5 * relative_motion_kernels._squared_distances(terms, R_there, t + scale_m * d[3:]).sum()])

    step = np.repeat([1.0, scale_m], 3)
    assert agree(gradient * step, numeric(cost, 6)[0], 1e2)


@FEW
@given(numbers, angles, scales_m)
def test_the_gradient_of_a_graph_of_poses(rng, angle, scale_m):
    poses = np.array([pose(rng, angle, scale_m) for _ in range(3)])
    noise = np.repeat([1e-5 * scale_m, 1e-5], 3)  # the derivatives are those of small errors
    pairs = np.array([[0, 1], [1, 2], [0, 2]], np.int32)
    measured = np.array([g.invert(poses[a]) @ poses[b] @ lie.exp_se3(noise * rng.normal(size=6)) for a, b in pairs])
    information = np.tile(np.diag(noise**-2.0), (3, 1, 1))
    edges = pose_graph.Edges(pairs, measured, information)
    gradient = pose_graph._normal_equations(poses, edges)[2].reshape(3, 6)
    unit = np.repeat([scale_m, 1.0], 3)

    def half_cost(d):
        return np.array([0.5 * pose_graph._normal_equations(pose_graph._retract(poses, unit * d.reshape(3, 6)), edges)[0]])

    found = numeric(half_cost, 18, 1e-7)
    assert np.allclose(gradient * unit, found.reshape(3, 6), rtol=1e-3, atol=1e-3 * np.abs(found).max())
    moved = pose(rng, 2.0, 1.0) @ poses  # the gauge: where the world is does not matter
    assert pose_graph._normal_equations(moved, edges)[0] == pytest.approx(pose_graph._normal_equations(poses, edges)[0], rel=1e-3)


def measured(rng, T, n):
    """Points 1 to 5 m before a camera at T, with noise."""
    local = CAMERA.back_project(rng.uniform([0, 0], [640, 480], (n, 2)), rng.uniform(1.0, 5.0, n))
    pixels, depth = CAMERA.project(local) + rng.normal(size=(n, 2)), local[:, 2] + 0.01 * rng.normal(size=n)
    return PointTerms(g.transform(T, local), np.tile(1e-6 * np.eye(3), (n, 1, 1)), pixels, depth, np.ones(n), np.full(n, 0.01))


PRIOR = np.diag(np.repeat([0.05**-2, 0.03**-2], 3))


@MANY
@given(numbers, angles, scales_m)
def test_where_the_world_begins_changes_neither_the_cost_nor_the_motion(rng, angle, scale_m):
    """Gauge invariance of tracking: the same camera and points seen from a world that is turned and moved, up to a kilometre."""
    T, G = pose(rng, 0.5, 1.0), pose(rng, angle, scale_m)
    terms, start = measured(rng, T, 30), T @ lie.exp_se3(0.01 * rng.normal(size=6))
    moved = terms._replace(positions_m=g.transform(G, terms.positions_m))  # their covariance is round
    one, other = solve_pose(start, CAMERA, start, PRIOR, terms), solve_pose(G @ start, CAMERA, G @ start, PRIOR, moved)
    assert np.allclose(other.T_world_camera, G @ one.T_world_camera, atol=1e-7 * max(1.0, scale_m))
    assert other.cost == pytest.approx(one.cost, rel=1e-5) and np.allclose(other.covariance, one.covariance, rtol=1e-4, atol=1e-12)
    assert np.array_equal(other.points, one.points)


@MANY
@given(numbers, angles, st.integers(0, 2))
def test_what_the_data_do_not_see_stays_at_the_prior(rng, angle, count):
    """None to two walls say nothing of the way along both: there the position stays, and is as uncertain as the prior says."""
    T = pose(rng, angle, 1.0)
    local = np.array([np.append(direction(rng), 2.0) for _ in range(count)]).reshape(-1, 4)
    tight = np.tile(np.diag([1e-3, 1e-3, 1e-3]) ** 2, (count, 1, 1))
    seen = local + 0.01 * np.array([0.0, 0.0, 0.0, 1.0])
    planes = PlaneTerms(np.full(count, SAME, np.int32), g.transform_planes(T, local), tight, seen, tight)
    found = solve_pose(T, CAMERA, T, PRIOR, planes=planes)
    moved = lie.log_se3(g.invert(T) @ found.T_world_camera)
    blind = np.linalg.svd(local[:, :3])[2][count:] if count else np.eye(3)
    assert np.abs(blind @ moved[:3]).max() < 1e-5  # the null space of the walls' normals
    assert np.allclose(np.einsum("ki,ij,kj->k", blind, found.covariance[:3, :3], blind), 0.05**2, rtol=1e-3)
    assert found.unobservable.shape[1] >= 3 - count and np.isfinite(found.covariance).all()
