"""Geometry on random rotations and motions."""

import numpy as np
import pytest

from trihedron.pipeline.core import geometry as g
from trihedron.pipeline.core import lie

RNG = np.random.default_rng(0)
ANGLES = [0.0, 1e-10, 1e-6, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-6]


def random_pose():
    return lie.exp_se3(RNG.normal(size=6))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_are_inverse(angle):
    for _ in range(50):
        axis = RNG.normal(size=3)
        phi = angle * axis / np.linalg.norm(axis)
        R = lie.exp_so3(phi)
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-14) and np.linalg.det(R) > 0
        assert np.allclose(lie.log_so3(R), phi, atol=1e-9)
        xi = np.concatenate([RNG.normal(size=3), phi])
        assert np.allclose(lie.log_se3(lie.exp_se3(xi)), xi, atol=1e-8)


def test_exp_is_a_one_parameter_group():
    xi = RNG.normal(size=6)
    assert np.allclose(lie.exp_se3(0.3 * xi) @ lie.exp_se3(0.7 * xi), lie.exp_se3(xi))


def test_quaternions():
    for _ in range(200):
        R = random_pose()[:3, :3]
        q = g.quaternion_from_rotation(R)
        assert q[3] >= 0 and np.allclose(g.rotation_from_quaternion(q), R)
    for bad in (np.zeros(4), np.full(4, np.nan)):
        with pytest.raises(ValueError, match="not a rotation"):
            g.rotation_from_quaternion(bad)


def test_planes_move_with_their_points():
    T = random_pose()
    n = RNG.normal(size=(5, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    d = RNG.normal(size=5)
    points = RNG.normal(size=(5, 3))
    points -= ((points * n).sum(1) + d)[:, None] * n
    moved = g.transform_planes(T, np.column_stack([n, d]))
    assert np.allclose((moved[:, :3] * g.transform(T, points)).sum(1) + moved[:, 3], 0)


def test_inverse_and_transform():
    T = np.stack([random_pose() for _ in range(4)])
    assert np.allclose(g.invert(T) @ T, np.eye(4))
    points = RNG.normal(size=(7, 3))
    assert np.allclose(g.transform(g.invert(T)[0], g.transform(T[0], points)), points)


def test_the_adjoint_moves_a_twist_to_the_other_side():
    T, xi = np.stack([random_pose(), random_pose()]), RNG.normal(size=(2, 6)) * 0.1
    for one, twist, moved in zip(T, xi, lie.adjoint(T)):
        assert np.allclose(lie.exp_se3(moved @ twist), one @ lie.exp_se3(twist) @ g.invert(one))


def test_tangent_basis_is_orthonormal_everywhere():
    n = np.vstack([RNG.normal(size=(500, 3)), np.eye(3), -np.eye(3)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    B = np.concatenate([g.tangent_basis(n), n[..., None]], axis=-1)
    assert np.allclose(np.swapaxes(B, 1, 2) @ B, np.eye(3))


def test_umeyama_recovers_a_motion_and_never_reflects():
    T = random_pose()
    points = RNG.normal(size=(30, 3))
    assert np.allclose(g.umeyama(points, g.transform(T, points)), T)
    flat = points * [1, 1, 0]
    assert np.linalg.det(g.umeyama(flat, flat * [1, -1, 1])[:3, :3]) == pytest.approx(1)


def test_nearest_rotation():
    R = random_pose()[:3, :3]
    assert np.allclose(g.nearest_rotation(2.5 * R), R)
    assert np.linalg.det(g.nearest_rotation(-R)) == pytest.approx(1)
    assert lie.rotation_angle_deg(lie.exp_so3(np.array([0, 0, np.radians(1e-4)]))) == pytest.approx(1e-4)
