"""Key points of images and depths that are known."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from trihedron.plugins.keypoints.orb import Orb
from trihedron.plugins.none import NoKeypoints

FLAT = np.full((480, 640), 2.0)
FIELDS = ("pixels", "points_m", "sigma_px", "sigma_m", "octaves", "angles_deg", "descriptors")


def blobs(seed=0, count=400, shift=(0, 0)):
    """Grey discs and boxes, moved by whole pixels."""
    rng, image = np.random.default_rng(seed), np.full((480, 640), 110, np.uint8)
    for _ in range(count):
        x, y, r, grey = rng.integers(20, 620), rng.integers(20, 460), rng.integers(3, 14), int(rng.integers(0, 255))
        cv2.rectangle(image, (int(x + shift[0]), int(y + shift[1])), (int(x + r + shift[0]), int(y + r + shift[1])), grey, -1)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def test_points_move_with_the_image_and_are_recognised(analytic):
    first, second = Orb()(analytic.frame(FLAT, gray=blobs())), Orb()(analytic.frame(FLAT, gray=blobs(shift=(6, 4))))
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, True).match(first.descriptors, second.descriptors)
    moved = np.array([second.pixels[m.trainIdx] - first.pixels[m.queryIdx] for m in matches if m.distance < 40])
    scale = np.array([1.2 ** first.octaves[m.queryIdx] for m in matches if m.distance < 40])
    assert len(moved) > 300
    error = np.linalg.norm(moved - [6, 4], axis=1)
    assert (error < 1.5 * scale).mean() > 0.9 and np.median(error / scale) < 0.5


def test_levels_agree_on_where_a_point_is(analytic):
    """A symmetric blob is at the same place on every level; without the half-pixel correction level 7 is off by 1.3 px."""
    rng, offsets = np.random.default_rng(2), []
    for _ in range(20):
        centre = rng.uniform((200, 200), (440, 280))
        v, u = np.mgrid[0:480, 0:640]
        image = 40 + 180 * np.exp(-((np.hypot(u - centre[0], v - centre[1]) / 9.0) ** 4))
        found = Orb(fast_threshold_low=5)(analytic.frame(FLAT, gray=image.astype(np.uint8)))
        if (found.octaves >= 5).any():
            offsets.append((found.pixels - centre)[found.octaves >= 5].mean(0))
    assert len(offsets) >= 10 and np.abs(np.mean(offsets, axis=0)).max() < 0.5


def test_a_textured_corner_does_not_take_them_all(analytic):
    image = (110 + (blobs(1, 600).astype(float) - 110) * 0.15).astype(np.uint8)  # faint boxes, and noise in the corner
    image[:160, :210] = np.random.default_rng(0).integers(0, 255, (160, 210))
    pixels = Orb()(analytic.frame(FLAT, gray=image)).pixels
    inside = (pixels[:, 0] < 225) & (pixels[:, 1] < 175)
    assert len(pixels) == 1000 and inside.mean() < 0.4


def test_order_and_shapes(analytic):
    found = Orb(features=300)(analytic.frame(FLAT, gray=blobs()))
    keys = [tuple(row) for row in zip(found.octaves, found.pixels[:, 1], found.pixels[:, 0])]
    assert len(keys) == 300 and keys == sorted(keys) and found.descriptors.shape == (300, 32) and found.metric == "hamming"
    assert np.allclose(found.sigma_px, 0.6 * 1.2 ** found.octaves.astype(float), rtol=1e-6)


def test_depth_of_a_tilted_plane_is_exact(analytic):
    depth = analytic.plane((0.4, 0.3, -1), 1.5)
    found = Orb()(analytic.frame(depth, gray=blobs()))
    n = np.array([0.4, 0.3, -1]) / np.linalg.norm([0.4, 0.3, -1])
    assert np.isfinite(found.points_m).all(1).mean() > 0.99
    assert np.nanmax(np.abs(found.points_m.astype(float) @ n + 1.5)) < 0.002
    assert np.nanmax(np.abs(analytic.exact.project(found.points_m.astype(float)) - found.pixels)) < 1e-3


def test_no_depth_across_an_edge_or_a_hole(analytic):
    depth = np.where(np.arange(640) < 300, 1.5, 1.7) * np.ones((480, 1))
    depth[200:260, 400:500] = 0.0
    found = Orb()(analytic.frame(analytic.noisy(depth), analytic.sensor, blobs()))
    x, y = found.pixels.T
    z = found.points_m[:, 2]
    assert np.isnan(z[np.abs(x - 299.5) < 1.0]).all()
    hole = (x > 402) & (x < 497) & (y > 202) & (y < 257)
    assert hole.sum() > 5 and np.isnan(z[hole]).all() and np.isnan(found.sigma_m[hole]).all()
    kept = np.isfinite(z)
    error = np.abs(z[kept] - np.where(x[kept] < 299.5, 1.5, 1.7))
    assert kept.mean() > 0.85 and error.max() < 4.0 * analytic.sensor.depth_noise.sigma_m(1.7)
    assert np.isfinite(found.sigma_m[kept]).all()


def test_depth_at_a_crease_is_kept(analytic):
    depth = np.minimum(analytic.plane((-0.7, 0, -1), 2.0), analytic.plane((0.7, 0, -1), 2.0))
    found = Orb()(analytic.frame(depth, gray=blobs()))
    crease = np.abs(found.pixels[:, 0] - 319.5) < 2.0
    assert crease.sum() > 3 and np.isfinite(found.points_m[crease]).all(1).mean() > 0.9


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_points_without_depth_are_kept_without_a_position(analytic, value):
    found = Orb()(analytic.frame(np.full((480, 640), value), gray=blobs()))
    assert len(found.pixels) > 500 and np.isnan(found.points_m).all() and np.isnan(found.sigma_m).all()


@pytest.mark.parametrize(("shape", "level"), [((480, 640), 0), ((480, 640), 255), ((20, 20), 90), ((1, 1), 3)])
def test_flat_and_small_images_have_no_points(analytic, shape, level):
    found = Orb()(analytic.frame(np.ones(shape), gray=np.full(shape, level, np.uint8)))
    assert len(found.pixels) == 0 and found.descriptors.shape == (0, 32) and found.points_m.shape == (0, 3)


def test_two_threads_in_flight_give_the_bytes_of_one(analytic):
    stage, frames = Orb(), [analytic.frame(FLAT, gray=blobs(k)) for k in range(6)]
    alone = [stage(frame) for frame in frames]
    with ThreadPoolExecutor(2) as pool:
        for together in (list(pool.map(stage, frames)) for _ in range(3)):
            for a, b in zip(alone, together):
                assert all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in FIELDS)


@pytest.mark.parametrize(
    "wrong", [{"features": 0}, {"scale": 1.0}, {"levels": 0}, {"fast_threshold": 5}, {"cell_px": 2}, {"fineness": -1.0}, {"depth_share": 0.0}]
)
def test_ranges(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Orb(**wrong)


def test_none(analytic):
    found = NoKeypoints()(analytic.frame(FLAT))
    assert len(found.pixels) == 0 and found.descriptors.shape == (0, 32)
    with pytest.raises(ValueError, match="descriptor_bytes"):
        NoKeypoints(descriptor_bytes=0)
