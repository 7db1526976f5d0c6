"""Line segments of images whose edges are known."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from trihedron.plugins.lines.edge_drawing import EdgeDrawing
from trihedron.plugins.lines.fast_line import FastLine
from trihedron.plugins.lines.lsd import Lsd
from trihedron.plugins.none import NoLines

DEPTH = np.ones((480, 640))
each = pytest.mark.parametrize("plugin", [Lsd, FastLine, EdgeDrawing], ids=lambda plugin: plugin.__name__)


def half_plane(angle_deg, offset_px, dark=60.0, bright=180.0, blur=0.8):
    """An image bright on the side of the normal (cos, sin) of a line through the centre (319.5, 239.5) + offset · normal."""
    v, u = np.mgrid[0:480, 0:640]
    a = np.radians(angle_deg)
    distance = (u - 319.5) * np.cos(a) + (v - 239.5) * np.sin(a) - offset_px
    step = np.clip(distance / (2.0 * blur) + 0.5, 0.0, 1.0)
    return np.rint(dark + (bright - dark) * step).astype(np.uint8)


def scene(shift=(0, 0)):
    """Boxes of different grey in front of a grey wall, moved by whole pixels."""
    image = np.full((480, 640), 128, np.uint8)
    shapes = np.random.default_rng(4)
    for _ in range(14):
        centre, size = shapes.uniform((80, 80), (560, 400)), shapes.uniform(40, 160, 2)
        centre = centre + shift
        box = cv2.boxPoints(((float(centre[0]), float(centre[1])), (float(size[0]), float(size[1])), float(shapes.uniform(0, 90))))
        cv2.fillPoly(image, [np.rint(box * 16).astype(np.int32)], int(shapes.integers(20, 235)), cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def busy(seed):
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 100, np.uint8)
    for _ in range(60):
        a, b = rng.integers(0, (640, 480), (2, 2))
        cv2.rectangle(image, a.tolist(), b.tolist(), int(rng.integers(0, 255)), -1)
    return image


@each
@pytest.mark.parametrize("angle", [0.0, 17.0, 44.0, 90.0, 133.0, 180.0, 201.0, 270.0, 358.0])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_edge_is_found_to_a_fraction_of_a_pixel_with_the_bright_side_on_the_right(analytic, plugin, angle, noise):
    image = half_plane(angle, 5.3) + np.random.default_rng(0).normal(0.0, noise, (480, 640)) * (noise > 0.0)
    found = plugin()(analytic.frame(DEPTH, gray=np.clip(np.rint(image), 0, 255).astype(np.uint8))).endpoints_px.astype(float)
    normal = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    start, end = found[0]
    assert np.linalg.norm(end - start) > 400.0
    assert np.abs((found[0] - [319.5, 239.5]) @ normal - 5.3).max() < 0.1
    direction = (end - start) / np.linalg.norm(end - start)
    assert np.array([-direction[1], direction[0]]) @ normal > 0.9999  # x right, y down: (−dy, dx) is the right-hand side


@each
def test_fragments_of_one_edge_are_joined_but_not_across_a_wide_gap(analytic, plugin):
    image = half_plane(90.0, 0.0)
    image[:, 200:208] = 60
    image[:, 400:460] = 60
    found = plugin()(analytic.frame(DEPTH, gray=image)).endpoints_px
    along = found[np.abs(found[:, 0, 1] - found[:, 1, 1]) < 2.0]
    lengths = np.sort(np.abs(along[:, 1, 0] - along[:, 0, 0]))[::-1]
    assert len(lengths) == 2 and abs(lengths[0] - 400) < 12 and abs(lengths[1] - 180) < 12


@each
def test_border_of_the_image_is_not_a_line(analytic, plugin):
    image = np.full((480, 640), 140, np.uint8)
    image[:, :2], image[478:] = 0, 0  # as registration leaves it
    assert len(plugin()(analytic.frame(DEPTH, gray=image)).endpoints_px) == 0


@each
def test_longest_first_and_no_more_than_wanted(analytic, plugin):
    frame = analytic.frame(DEPTH, gray=busy(0))
    every, some = plugin(segments=400)(frame), plugin(segments=12)(frame)
    lengths = np.linalg.norm(every.endpoints_px[:, 1] - every.endpoints_px[:, 0], axis=1)
    assert len(every.endpoints_px) > 24 and len(some.endpoints_px) == 12 and lengths.min() >= 19.0
    assert np.linalg.norm(some.endpoints_px[:, 1] - some.endpoints_px[:, 0], axis=1).min() > np.median(lengths)


@each
def test_descriptors_find_the_same_line_again(analytic, plugin):
    first = plugin()(analytic.frame(DEPTH, gray=scene()))
    second = plugin()(analytic.frame(DEPTH, gray=scene((9, -6))))
    moved = first.endpoints_px + np.float32([9, -6])
    distance = np.unpackbits(first.descriptors[:, None] ^ second.descriptors[None], axis=-1).sum(-1)
    best = distance.argmin(1)
    near = np.abs(moved[:, None] - second.endpoints_px[None]).max((2, 3))
    again = near.min(1) < 4.0
    assert first.descriptors.shape[1] == 32 and again.sum() > 20
    assert (near[np.arange(len(best)), best][again] < 4.0).mean() > 0.9
    assert np.median(distance[np.arange(len(best)), best][again]) < 0.2 * np.median(distance)


@each
@pytest.mark.parametrize("level", [0, 255])
def test_flat_image_has_no_lines(analytic, plugin, level):
    found = plugin()(analytic.frame(DEPTH, gray=np.full((480, 640), level, np.uint8)))
    assert found.endpoints_px.shape == (0, 2, 2) and found.descriptors.shape == (0, 32)


@each
@pytest.mark.parametrize("shape", [(480, 640), (33, 47), (3, 3), (1, 1)])
def test_noise_and_small_images_do_not_raise(analytic, plugin, shape):
    gray = np.random.default_rng(1).integers(0, 255, shape).astype(np.uint8)
    found = plugin()(analytic.frame(np.ones(shape), gray=gray))
    assert np.isfinite(found.endpoints_px).all()


@each
def test_two_threads_in_flight_give_the_bytes_of_one(analytic, plugin):
    stage, frames = plugin(), [analytic.frame(DEPTH, gray=busy(k)) for k in range(6)]
    alone = [stage(frame) for frame in frames]
    with ThreadPoolExecutor(2) as pool:
        for together in (list(pool.map(stage, frames)) for _ in range(3)):
            for a, b in zip(alone, together):
                assert a.endpoints_px.tobytes() == b.endpoints_px.tobytes() and a.descriptors.tobytes() == b.descriptors.tobytes()


@each
@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"segments": 0}, {"merge_deg": 50.0}, {"border_px": -1.0}, {"reach_px": 0}, {"band_px": 0}])
def test_ranges(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin(**wrong)


def test_none(analytic):
    found = NoLines()(analytic.frame(DEPTH))
    assert found.endpoints_px.shape == (0, 2, 2) and found.descriptors.shape == (0, 32)
    with pytest.raises(ValueError, match="descriptor_bytes"):
        NoLines(descriptor_bytes=0)
