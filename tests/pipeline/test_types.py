"""Values check their arrays when they are made."""

import numpy as np
import pytest

from trihedron.pipeline.types import Camera, DepthNoise, Keypoints, LineSegments


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
