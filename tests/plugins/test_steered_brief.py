"""Binary descriptors against their definition, under turns, and against those of OpenCV."""

import cv2
import numpy as np

from trihedron.plugins.keypoints.orb import LONGEST_PX, brief_tests, image_pyramid
from trihedron.plugins.keypoints.orb_kernels import BITS, REACH_PX, WINDOW_PX, steered_brief

TESTS = brief_tests()
MARGIN = 19


def texture(seed=1, size=200):
    noise = np.random.default_rng(seed).integers(0, 256, (size, size)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3.0), None, 0, 255, cv2.NORM_MINMAX)


def described(image, angle=0.0, cells=None, level=0):
    pyramid = image_pyramid(image, 1.2, 3, 2 * MARGIN + 1)
    if cells is None:
        cells = np.random.default_rng(2).integers(MARGIN, min(pyramid.shapes[level]) - MARGIN, (50, 2)).astype(np.int32)
    n = len(cells)
    return cells, steered_brief(pyramid, cells, np.full(n, level, np.int32), np.full(n, angle, np.float32), TESTS)


def differing(a, b):
    return np.unpackbits(a ^ b, axis=1).sum(axis=1)


def test_tests_lie_in_the_patch_and_are_short():
    x1, y1, x2, y2 = TESTS
    assert TESTS.shape == (4, BITS)
    assert max(np.hypot(x1, y1).max(), np.hypot(x2, y2).max()) <= REACH_PX
    assert np.hypot(x1 - x2, y1 - y2).min() >= 1.0 and np.hypot(x1 - x2, y1 - y2).max() <= LONGEST_PX
    assert np.abs(TESTS.mean(axis=1)).max() < 1.0  # all around the key point


def test_each_bit_is_what_the_definition_says():
    image = texture()
    cells, found = described(image, angle=90.0, level=1)
    level = cv2.resize(image, (167, 167), interpolation=cv2.INTER_LINEAR_EXACT)
    mean = cv2.blur(level, (WINDOW_PX, WINDOW_PX)).astype(int)
    x1, y1, x2, y2 = TESTS.astype(int)
    for (x, y), bits in zip(cells, np.unpackbits(found, axis=1, bitorder="little")):
        np.testing.assert_array_equal(bits, mean[y + x1, x - y1] < mean[y + x2, x - y2])  # a quarter turn takes (x, y) to (−y, x)


def test_they_turn_with_the_image():
    """A quarter turn of image and angle changes no bit; without the angle about half of them."""
    image, size = texture(), 200
    cells, here = described(image)
    turned = np.column_stack([size - 1 - cells[:, 1], cells[:, 0]]).astype(np.int32)  # clockwise, as angles in an image go
    image = np.ascontiguousarray(np.rot90(image, -1))
    assert differing(here, described(image, 90.0, turned)[1]).max() <= 2  # rounding of equal means
    assert np.median(differing(here, described(image, 0.0, turned)[1])) > 80


def test_noise_changes_fewer_bits_than_another_place():
    image = texture()
    noisy = np.clip(image + np.random.default_rng(5).normal(0.0, 8.0, image.shape), 0, 255).astype(np.uint8)
    cells, here = described(image)
    again, other = described(noisy, cells=cells)[1], described(image, cells=cells[::-1].copy())[1]
    assert differing(here, again).max() < 50 < np.percentile(differing(here, other), 5)
