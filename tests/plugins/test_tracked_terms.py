"""Features placed in the world: their covariances are those of what they are made from, by numeric derivatives."""

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis, transform, transform_planes
from trihedron.pipeline.core.lie import exp_se3, exp_so3
from trihedron.pipeline.core.types import Camera
from trihedron.plugins.translation.tracked_terms_kernels import placed_planes, placed_points

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 239.5)
T = exp_se3(np.array([0.4, -0.2, 1.0, 0.3, -0.8, 0.2]))
TURNED = np.diag([1e-4, 4e-4, 2e-4]) + 5e-5
STEP = 1e-6


def jacobian(f, x):
    """(rows, len(x)) central differences."""
    return np.stack([(f(x + d) - f(x - d)) / (2.0 * STEP) for d in STEP * np.eye(len(x))], axis=-1)


def test_points():
    rng = np.random.default_rng(0)
    pixels, z = rng.uniform(0, 480, (20, 2)), rng.uniform(0.5, 5.0, 20)
    points = CAMERA.back_project(pixels, z).astype(np.float32)
    sigma_px, sigma_m = rng.uniform(0.5, 2.0, 20).astype(np.float32), rng.uniform(0.001, 0.05, 20).astype(np.float32)
    world, covariance = placed_points(points, sigma_px, sigma_m, CAMERA.fx, CAMERA.fy, T, TURNED)
    np.testing.assert_allclose(world, transform(T, points.astype(np.float64)), atol=1e-12)
    for i in range(20):
        across = z[i] / np.array([CAMERA.fx, CAMERA.fy])  # of a pixel, where the ray is

        p = points[i].astype(np.float64)

        def place(x, p=p, across=across):
            moved = p * (1.0 + x[2] / p[2]) + np.array([across[0] * x[0], across[1] * x[1], 0.0])
            return transform(T, (exp_so3(x[3:]) @ moved)[None])[0]

        J = jacobian(place, np.zeros(6))
        noise = np.zeros((6, 6))
        noise[:2, :2], noise[2, 2], noise[3:, 3:] = np.eye(2) * sigma_px[i] ** 2, sigma_m[i] ** 2, TURNED
        np.testing.assert_allclose(covariance[i], J @ noise @ J.T, rtol=1e-5, atol=1e-12)


def test_planes():
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(10, 3))
    planes = np.concatenate([normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(0.5, 4.0, (10, 1))], axis=1)
    root = rng.normal(size=(10, 3, 3)) * 1e-2
    noise = root @ np.swapaxes(root, 1, 2)
    world, covariance, added = placed_planes(planes, noise, planes, T, TURNED)
    np.testing.assert_allclose(world, transform_planes(T, planes), atol=1e-12)
    for i in range(10):
        basis = tangent_basis(planes[i : i + 1, :3])[0]
        there = tangent_basis(world[i : i + 1, :3])[0]

        def moved(x, plane=planes[i], basis=basis, there=there, at=world[i]):
            n = plane[:3] + basis @ x[:2]
            out = transform_planes(T, np.append(n / np.linalg.norm(n), plane[3] + x[2])[None])[0]
            return np.append(there.T @ (out[:3] - at[:3]), out[3] - at[3])

        J = jacobian(moved, np.zeros(3))
        np.testing.assert_allclose(covariance[i], J @ noise[i] @ J.T, rtol=1e-5, atol=1e-12)
        Q = jacobian(lambda x, n=planes[i, :3], basis=basis: basis.T @ (exp_so3(x) @ n), np.zeros(3))
        np.testing.assert_allclose(added[i, :2, :2], Q @ TURNED @ Q.T, rtol=1e-5, atol=1e-12)
        assert not added[i, 2].any() and not added[i, :, 2].any()
