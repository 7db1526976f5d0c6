"""Registration of depth to colour from edges, of cameras whose parameters are known."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from trihedron.pipeline.core.types import F32, F64, U8, Camera, Frame
from trihedron.tools.calibrate import REGISTRATIONS, _by_edges
from trihedron.tools.calibration_edges import NAMES, Edges, edges_of, moved_px, register_depth
from trihedron.tools.calibration_judgement import Judgement, blocks_of

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FRAMES, BOXES, SUBPIXEL = 16, 10, 4
TRUE = np.array([-0.08, 6.0, -4.0, -0.03, 0.015, 0.015])  # in the order of NAMES; pixels at 640 a line


def boxes(seed: int) -> F64:
    """(n, 5) centre x, y at depth z, and half sizes, metres; the farthest first."""
    rng = np.random.default_rng(seed)
    z = np.sort(rng.uniform(1.0, 4.0, BOXES))[::-1]
    return np.column_stack([z * rng.uniform(-0.5, 0.5, BOXES), z * rng.uniform(-0.35, 0.35, BOXES), z, rng.uniform(0.1, 0.4, (BOXES, 2))])


def painted(corner: F64, values: F64, background: float) -> F32:
    """Paint boxes whose corners (n, 2, 2) are in pixels, without resolution finer than a pixel."""
    image = np.full((CAMERA.height * SUBPIXEL, CAMERA.width * SUBPIXEL), background, np.float32)
    for (a, b), value in zip(np.rint((corner + 0.5) * SUBPIXEL).astype(int).tolist(), values):
        cv2.rectangle(image, a, [b[0] - 1, b[1] - 1], float(value), -1)
    return image


def frame(index: int, truth: F64, motion: F64) -> Frame:
    """Colour of the camera, and depth of one that is smaller by exp(log_scale), shifted, beside it and late."""
    found, rng = boxes(index), np.random.default_rng([index, 1])
    x, y, z, half_x, half_y = found.T
    corners = np.stack([np.column_stack([x - half_x, y - half_y, z]), np.column_stack([x + half_x, y + half_y, z])], axis=1)
    focal, center = CAMERA.fx, np.array([CAMERA.cx, CAMERA.cy])
    color = painted(focal * corners[:, :, :2] / corners[:, :, 2:] + center, rng.permutation(np.linspace(40.0, 250.0, BOXES)), 10.0)
    late = corners - truth[5] * (motion[3:] + np.cross(motion[:3], corners))
    beside = late[:, :, :2] - truth[3:5]
    pixels = (focal * beside / late[:, :, 2:] - truth[1:3] * CAMERA.width / 640.0) / np.exp(truth[0]) + center
    depth = painted(pixels, z, 6.0)[SUBPIXEL // 2 :: SUBPIXEL, SUBPIXEL // 2 :: SUBPIXEL]
    small = cv2.resize(color, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    rgb: U8 = np.repeat(small.round().astype(np.uint8)[..., None], 3, axis=2)
    return Frame(index, index * 33_000_000, rgb, np.ascontiguousarray(depth), CAMERA)


@cache
def edges(wrong: bool) -> Edges:
    rng = np.random.default_rng(7)
    motions = np.concatenate([rng.normal(0.0, 0.5, (FRAMES, 3)), rng.normal(0.0, 0.3, (FRAMES, 3))], axis=1)
    frames = [frame(index, TRUE if wrong else np.zeros(6), motion) for index, motion in enumerate(motions)]
    return edges_of(frames, motions, blocks_of(FRAMES))


def test_scale_shift_offset_and_delay_are_found() -> None:
    found = register_depth(edges(True), range(len(NAMES)))
    sigmas, errors = np.sqrt(np.diag(found.covariance)), found.parameters - TRUE
    print(found.parameters, sigmas)
    assert (np.abs(errors) < 4.0 * sigmas + [0.002, 0.7, 0.7, 0.003, 0.003, 0.003]).all()
    assert (sigmas < [0.02, 4.0, 4.0, 0.02, 0.02, 0.01]).all()


def test_depth_of_another_camera_is_registered_by_the_recommendation() -> None:
    judgements: dict[str, Judgement] = {}
    recommended, _ = _by_edges(edges(True), judgements)
    print(judgements, recommended)
    assert judgements["registration"].recommended and judgements["registration"].gain > 0.1
    assert abs(recommended[0] - TRUE[0]) < 0.01 and len(REGISTRATIONS) == 3


def test_a_registration_within_the_window_of_a_sensor_is_not_recommended() -> None:
    """A shift of 3 px of the image is found, and may be that of the edges alone."""
    rng = np.random.default_rng(7)
    motions = np.concatenate([rng.normal(0.0, 0.5, (FRAMES, 3)), rng.normal(0.0, 0.3, (FRAMES, 3))], axis=1)
    shifted = np.array([0.0, 6.0, 0.0, 0.0, 0.0, 0.0])
    found = edges_of([frame(index, shifted, motion) for index, motion in enumerate(motions)], motions, blocks_of(FRAMES))
    assert moved_px(found, register_depth(found, (1, 2, 5)).parameters) == pytest.approx(3.0, abs=0.3)
    judgements: dict[str, Judgement] = {}
    recommended, _ = _by_edges(found, judgements)
    assert not recommended[:5].any() and not judgements["registration"].recommended
    assert judgements["registration"].gain > 0.05


def test_depth_that_is_registered_is_left_alone() -> None:
    judgements: dict[str, Judgement] = {}
    recommended, (everything, sigmas) = _by_edges(edges(False), judgements)
    print(judgements, everything, sigmas)
    assert not recommended.any() and not judgements["registration"].recommended and not judgements["depth_delay_s"].recommended
