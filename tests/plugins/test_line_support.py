"""Line segments of our LSD against OpenCV's, and against lines drawn."""

import cv2
import numpy as np
import pytest

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.plugins.lines.lsd_kernels import line_support_segments

TOLERANCE = np.radians(22.5)


def lengths(lines):
    return np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])


def segments(image):
    return line_support_segments(image, TOLERANCE, 2.0, 0.7)


@pytest.mark.parametrize("texture", [True, False])
def test_long_segments_are_opencv_s(texture):
    image = cv2.resize(Synthetic(texture=texture)(0).gray, (320, 240), interpolation=cv2.INTER_AREA)
    theirs = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0).detect(image)[0].reshape(-1, 4)
    ours = segments(image)
    long = theirs[lengths(theirs) > 15.0]
    apart = np.abs(long[:, None] - ours[None]).max(-1).min(1)
    assert len(long) >= 20
    assert np.mean(apart < 0.05) >= 0.8  # end points, px; float sums in another order move a few
    assert 0.9 < lengths(ours).sum() / lengths(theirs).sum() < 1.1


def test_a_drawn_edge_is_one_segment_along_it_dark_on_one_side():
    y, x = np.mgrid[:120, :160]
    image = np.clip(128 + 60 * (0.6 * x - 0.8 * y + 20.0), 40, 200).astype(np.uint8)
    found = segments(image)
    best = found[np.argmax(lengths(found))]
    across = 0.6 * best[[0, 2]] - 0.8 * best[[1, 3]] + 20.0
    assert lengths(best[None])[0] > 150.0
    assert np.abs(across).max() < 1.0


def test_a_circle_is_cut_into_chords():
    y, x = np.mgrid[:160, :160]
    image = np.where((x - 80.0) ** 2 + (y - 80.0) ** 2 < 50.0**2, 200, 50).astype(np.uint8)
    found = segments(cv2.GaussianBlur(image, (0, 0), 1.0))
    assert 4 <= len(found) <= 60
    assert lengths(found).max() < 50.0


@pytest.mark.parametrize("image", [np.zeros((2, 2), np.uint8), np.full((50, 60), 9, np.uint8), np.zeros((3, 200), np.uint8)])
def test_nothing_in_nothing(image):
    assert segments(image).shape == (0, 4)


def test_noise_draws_almost_nothing():
    noise = np.random.default_rng(1).normal(120.0, 20.0, (240, 320)).clip(0, 255).astype(np.uint8)
    assert len(segments(noise)) <= 5  # OpenCV's finds as few
