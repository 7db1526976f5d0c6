"""Values check their arrays when they are made."""

import numpy as np
import pytest

from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Camera, DepthNoise, Keypoints, LineSegments, Pose
from trihedron.pipeline.run.poses import Poses


def test_wrong_arrays_are_named():
    with pytest.raises(ValueError, match=r"^LineSegments.endpoints_px: expected an array of float32, got float64$"):
        LineSegments(0, 0, np.zeros((3, 2, 2)), np.zeros((3, 32), np.uint8))
    with pytest.raises(ValueError, match=r"^LineSegments.endpoints_px: expected shape \(n, 2, 2\), got \(3, 4\)"):
        LineSegments(0, 0, np.zeros((3, 4), np.float32), np.zeros((3, 32), np.uint8))
    with pytest.raises(ValueError, match=r"^LineSegments.descriptors: expected shape \(n, b\), got \(2, 32\) with {'n': 3}$"):
        LineSegments(0, 0, np.zeros((3, 2, 2), np.float32), np.zeros((2, 32), np.uint8))
    with pytest.raises(ValueError, match=r"^LineSegments.descriptors: expected an array of uint8, got list$"):
        LineSegments(0, 0, np.zeros((3, 2, 2), np.float32), [])


def test_arrays_become_read_only():
    value = LineSegments(0, 0, np.zeros((3, 2, 2), np.float32), np.zeros((3, 32), np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        value.endpoints_px[0] = 1
    assert Keypoints.version == 1 and not Keypoints.dense


def test_projection_and_back_projection_are_inverse():
    camera = Camera(640, 480, 500.0, 510.0, 320.0, 240.0)
    points = np.array([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0]])
    pixels = camera.project(points)
    assert np.allclose(pixels[0], [500 * 0.15 + 320, -510 * 0.1 + 240])
    assert np.allclose(camera.back_project(pixels, points[:, 2]), points)
    assert np.isnan(camera.project(np.array([[0.0, 0.0, -1.0]]))).all()


def test_depth_noise_has_a_floor():
    noise = DepthNoise()
    assert noise.sigma_m(0.2) == 0.001  # the polynomial is negative below 0.35 m
    assert noise.sigma_m(4.0) == pytest.approx(0.00273 * 16 + 0.00074 * 4 - 0.00058)


def test_poses_of_a_run_come_back_as_they_were():
    rng = np.random.default_rng(0)
    motions, counts = [[exp_se3(xi) for xi in pair] for pair in rng.random((5, 2, 6))], np.array([5, 2, 3], np.int32)
    covariances = [half @ half.T for half in rng.random((5, 6, 6))]
    status = (OK, DEGRADED, LOST, OK, OK)
    matrices = [(T, C, R) for (T, R), C in zip(motions, covariances)]
    said = [
        Pose(3 * k, 2**60 + k, *matrices[k], k - 1, counts + k, 1, status[k], f"wherefore é {k}", k, 7, depth_scale_sigma=0.1 * k) for k in range(5)
    ]
    kept = Poses(said)
    assert len(kept) == 5 and [pose.index for pose in kept[1:4]] == [3, 6, 9] and kept[-1].reason == "wherefore é 4"
    for pose, again in zip(said, kept):
        assert all(np.array_equal(getattr(pose, name), getattr(again, name)) for name in vars(pose)) and again.inliers.dtype == np.int32
    with pytest.raises(IndexError):
        kept[5]
