"""FAST corners against OpenCV's, pixel for pixel."""

import cv2
import numpy as np
import pytest

from trihedron.plugins.keypoints.orb_kernels import fast_corners

MARGIN = 4


def images():
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 256, (97, 131)).astype(np.uint8)
    steps = np.kron(rng.integers(0, 256, (9, 13)), np.ones((11, 11))).astype(np.uint8)
    return {"noise": noise, "blurred": cv2.GaussianBlur(noise, (0, 0), 1.5), "squares": steps, "flat": np.full((60, 80), 17, np.uint8)}


@pytest.mark.parametrize("name", images())
@pytest.mark.parametrize("threshold", [1, 7, 20, 90])
def test_they_are_opencv_s_with_the_same_strengths(name, threshold):
    image = images()[name]
    h, w = image.shape
    expected = {(round(k.pt[0]), round(k.pt[1]), int(k.response)) for k in cv2.FastFeatureDetector_create(threshold, True).detect(image)}
    expected = {(x, y, s) for x, y, s in expected if MARGIN <= x < w - MARGIN and MARGIN <= y < h - MARGIN}
    pixels, strengths = fast_corners(image, threshold, MARGIN)
    assert {(x, y, s) for (x, y), s in zip(pixels.tolist(), strengths.tolist())} == expected
    assert len(strengths) == len(expected)
    assert len(expected) > 50 or name in ("flat", "squares") or threshold == 90


def test_corners_at_a_higher_threshold_are_those_of_that_strength():
    image = images()["noise"]
    low, strengths = fast_corners(image, 7, 10)
    high, _ = fast_corners(image, 60, 10)
    np.testing.assert_array_equal(low[strengths >= 60], high)
    assert 0 < len(high) < len(low)


@pytest.mark.parametrize("shape", [(1, 1), (7, 200), (200, 9)])
def test_an_image_too_small_has_none(shape):
    assert len(fast_corners(np.zeros(shape, np.uint8), 7, MARGIN)[0]) == 0
