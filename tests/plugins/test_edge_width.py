"""The blur of an image by the width of its edges."""

import dataclasses

import cv2
import numpy as np
import pytest

import trihedron as th
from trihedron.plugins.shared.edge_width import MEDIAN_OF_NARROW, SHARP_PX, motion_blur_px
from trihedron.plugins.shared.edge_width_kernels import edge_widths


def boxes(blur_x=0.0, blur_y=0.0):
    """An image (480, 640) of grey boxes with sharp borders, blurred by Gaussians of these standard deviations along x and y."""
    rng = np.random.default_rng(0)
    grey = np.kron(rng.choice([40.0, 130.0, 220.0], (12, 16)), np.ones((40, 40)))
    return np.rint(cv2.GaussianBlur(grey, (0, 0), max(blur_x, 1e-3), sigmaY=max(blur_y, 1e-3))).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.5, 2.0, 3.0])
def test_blur_is_that_of_the_edges_beyond_sharp_ones(sigma):
    excess = np.sqrt((MEDIAN_OF_NARROW * sigma) ** 2 - SHARP_PX**2)  # all edges are alike here, the narrow ones too
    assert motion_blur_px(boxes(sigma, sigma)) == pytest.approx(excess, rel=0.12)
    along_x = motion_blur_px(boxes(sigma, 0.0))  # the other axis is sharp
    assert along_x == pytest.approx(excess / np.sqrt(2.0), rel=0.12) == motion_blur_px(boxes(0.0, sigma))


def test_a_sharp_image_and_one_without_edges_have_none():
    assert motion_blur_px(boxes()) == motion_blur_px(boxes(0.8, 0.8)) == 0.0
    assert motion_blur_px(np.full((480, 640), 90, np.uint8)) == motion_blur_px(np.zeros((0, 0), np.uint8)) == 0.0
    noise = np.random.default_rng(0).integers(80, 100, (480, 640)).astype(np.uint8)
    assert motion_blur_px(cv2.GaussianBlur(noise, (0, 0), 5.0)) == 0.0  # no edge of 40 grey levels


def test_a_surface_whose_texture_is_smooth_is_no_blur():
    """Two thirds of the edges are wide and the others sharp; then all of it is blurred."""
    image = boxes()
    image[160:] = boxes(3.0, 3.0)[160:]
    assert motion_blur_px(image) == 0.0 < motion_blur_px(boxes(3.0, 3.0)) and motion_blur_px(cv2.GaussianBlur(image, (0, 0), 2.0)) > 1.5


@pytest.mark.parametrize("plugin", ["orb", "sift", "akaze", "opencv_orb"])
def test_the_noise_of_key_points_includes_the_blur(plugin):
    frame = th.dataset.synthetic()(0)
    blurred = dataclasses.replace(frame, color=cv2.GaussianBlur(frame.color, (0, 0), 3.0))
    detect = getattr(th.keypoints, plugin)()
    sharp, found = detect(frame), detect(blurred)
    assert sharp.blur_px == 0.0 and found.blur_px == motion_blur_px(blurred.gray) > 1.5
    assert len(found.pixels) and (found.sigma_px > found.blur_px).all()


def test_an_edge_at_every_pixel_is_counted_within_the_arrays():
    """Black and white by turns: one edge a pixel along a row, all of them sharp; and no more edges than pixels in noise."""
    stripes = np.tile(np.array([0, 255], np.uint8), (48, 32))
    rows, columns = edge_widths(stripes, 8, 40)
    assert len(rows) == 6 * 63 and (rows == 1.0).all() and not len(columns)
    for seed in range(20):
        noise = np.random.default_rng(seed).integers(0, 256, (41, 67), dtype=np.uint8)
        rows, columns = edge_widths(noise, 1, 1)
        assert 0 < len(rows) < 41 * 67 and 0 < len(columns) < 41 * 67 and motion_blur_px(noise) >= 0.0
