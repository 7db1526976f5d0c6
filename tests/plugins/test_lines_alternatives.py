"""The detectors of line segments beside LSD: what is their own. What all have in common is in test_lines.py."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from trihedron.plugins.lines.edge_drawing import EdgeDrawing
from trihedron.plugins.lines.fast_line import FastLine

DEPTH = np.ones((480, 640))
each = pytest.mark.parametrize("plugin", [FastLine, EdgeDrawing], ids=lambda plugin: plugin.__name__)


def boxes(seed, count=12):
    """Bright boxes on a dark wall, and their sides (n, 2, 2), the bright side on the right."""
    rng, image, sides = np.random.default_rng(seed), np.full((480, 640), 70.0), []
    v, u = np.mgrid[0:480, 0:640]
    for k in range(count):
        centre = np.array([90.0 + 150.0 * (k % 4), 85.0 + 155.0 * (k // 4)]) + rng.uniform(-8, 8, 2)
        half, angle = rng.uniform(30, 48, 2), rng.uniform(0, np.pi)
        x, y = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        along, across = np.abs((u - centre[0]) * x[0] + (v - centre[1]) * x[1]), np.abs((u - centre[0]) * y[0] + (v - centre[1]) * y[1])
        inside = np.minimum(half[0] - along, half[1] - across)
        image += rng.uniform(40, 150) * np.clip(inside / 1.6 + 0.5, 0.0, 1.0)
        corners = [centre + a * half[0] * x + b * half[1] * y for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]  # clockwise: the inside on the right
        sides += list(zip(corners, corners[1:] + corners[:1]))
    return np.rint(image).astype(np.uint8), np.array(sides)


def errors_px(found, sides):
    """Of each true side: the distance across of the found segment closest to it, and the share of its length that segment covers."""
    across, covered = [], []
    for a, b in sides:
        length = np.linalg.norm(b - a)
        u = (b - a) / length
        offset = np.abs((found - a) @ np.array([-u[1], u[0]])).max(1)
        along = np.clip((found - a) @ u, 0.0, length)
        share = (along[:, 1] - along[:, 0]) / length
        best = int(np.argmax(np.where(offset < 2.0, share, -1.0)))
        across.append(offset[best])
        covered.append(share[best])
    return np.array(across), np.array(covered)


@each
@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_sides_of_drawn_boxes(analytic, plugin, scale):
    image, sides = boxes(0)
    found = plugin(scale=scale)(analytic.frame(DEPTH, gray=image)).endpoints_px.astype(float)
    across, covered = errors_px(found, sides)
    good = covered > 0.6
    assert good.mean() > 0.9 and np.median(across[good]) < 0.03 and across[good].max() < 0.1
    assert len(found) < 1.3 * len(sides)


@each
def test_two_threads_in_flight_give_the_bytes_of_one(analytic, plugin):
    """Whatever the detector looked at before, the answer is that of a new one."""
    frames = [analytic.frame(DEPTH, gray=boxes(k)[0]) for k in range(5)] + [analytic.frame(DEPTH)]
    alone, stage = [plugin()(frame) for frame in frames], plugin()
    with ThreadPoolExecutor(2) as pool:
        for together in (list(pool.map(stage, frames)) for _ in range(3)):
            for a, b in zip(alone, together):
                assert a.endpoints_px.tobytes() == b.endpoints_px.tobytes() and a.descriptors.tobytes() == b.descriptors.tobytes()


@pytest.mark.parametrize(
    ("plugin", "wrong"),
    [
        (FastLine, {"scale": 0.0}), (FastLine, {"weak": 60.0}), (FastLine, {"straight_px": 0.1}), (EdgeDrawing, {"band_px": 0}),
        (EdgeDrawing, {"gradient": 0}), (EdgeDrawing, {"anchor": -1}), (EdgeDrawing, {"straight_px": 9.0}),
    ],
)  # fmt: skip
def test_ranges(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin(**wrong)
