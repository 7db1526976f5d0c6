"""The Kinect-like noise: its statistics, holes, shadows and edges."""

from __future__ import annotations

import numpy as np
import pytest

from trihedron.datasets.simulation.depth_noise import IMAGE_SIGMA, kinect_depth, noisy_color
from trihedron.datasets.simulation.motion import camera_pose
from trihedron.datasets.simulation.shading import render
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.types import DepthNoise

NOISE = DepthNoise()


def sensed(depth: np.ndarray, cosine: float = 1.0, seed: int = 0, fx: float = 525.0) -> np.ndarray:
    return kinect_depth(depth, np.full(depth.shape, cosine, dtype=np.float32), fx, NOISE, np.random.default_rng(seed))


@pytest.mark.parametrize("z", [0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 6.0])
def test_the_spread_at_a_distance_is_the_model_s(z: float) -> None:
    error = sensed(np.full((240, 320), z)) - z
    sigma = float(NOISE.sigma_m(z))
    assert error.std() == pytest.approx(sigma, rel=0.05)
    assert abs(error.mean()) < 0.15 * sigma


def test_the_spread_over_a_rendered_room_is_the_model_s() -> None:
    """Sensed less exact depth over σ(z), away from edges: standard deviation 1 within 20 %."""
    dataset = Synthetic(texture=False)
    ratios = []
    for number in (0, 70, 140):
        frame = dataset(number)
        _, exact, faces, cosine = render(*dataset._scene, frame.camera, camera_pose(dataset.motion, 0, number / 30))
        inner = np.ones(faces.shape, dtype=bool)
        for axis in (0, 1):
            for shift in (-3, 3):
                inner &= np.roll(faces, shift, axis) == faces
        inner &= (frame.depth_m > 0) & (cosine > 0.4)
        inner[:4], inner[-4:], inner[:, :4], inner[:, -4:] = False, False, False, False
        ratios.append((frame.depth_m - exact)[inner] / NOISE.sigma_m(exact[inner]))
    spread = np.concatenate(ratios)
    assert len(spread) > 300_000
    assert spread.std() == pytest.approx(1.0, rel=0.2)
    assert abs(spread.mean()) < 0.1


def test_neighbouring_errors_are_alike_and_distant_ones_are_not() -> None:
    error = sensed(np.full((240, 320), 2.0)) - 2.0
    error = error / error.std()
    assert 0.4 < float((error[:, 1:] * error[:, :-1]).mean()) < 0.8
    assert abs(float((error[:, 6:] * error[:, :-6]).mean())) < 0.05


def test_disparity_comes_in_eighths_of_a_pixel() -> None:
    steps = 43.5 * 8.0 / sensed(np.full((48, 64), 3.0)).astype(float)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-4)


def test_depth_is_lost_out_of_range_and_at_grazing_angles() -> None:
    assert (sensed(np.full((24, 32), 0.39)) == 0).all()
    assert (sensed(np.full((24, 32), 8.01)) == 0).all()
    assert (sensed(np.full((240, 320), 2.0), cosine=0.0) == 0).mean() > 0.99
    assert (sensed(np.full((24, 32), 2.0), cosine=0.35) > 0).all()
    assert 0.2 < (sensed(np.full((240, 320), 2.0), cosine=0.14) > 0).mean() < 0.8


def test_a_near_object_shadows_what_is_left_behind_it_and_has_ragged_edges() -> None:
    depth = np.full((240, 320), 3.0)
    depth[:, 200:260] = 1.0
    found = sensed(depth)
    width = 525.0 * 0.075 * (1.0 - 1.0 / 3.0)  # parallax of camera and projector between the two distances
    lost = (found == 0).sum(axis=1)
    assert np.median(lost) == pytest.approx(width, abs=2.0)
    assert (found[:, 170:172] > 0).all() and (found[:, 265:] > 0).all()
    right_edge = np.array([np.flatnonzero((row > 0) & (row < 2.0)).max() for row in found])
    assert 0.3 < right_edge.std() < 1.5 and np.abs(right_edge - 259).max() <= 2


def test_colour_noise_is_of_brightness() -> None:
    color = np.full((240, 320, 3), (100, 120, 140), dtype=np.uint8)
    error = noisy_color(color, np.random.default_rng(0)).astype(int) - color
    assert (error[..., 0] == error[..., 1]).all()
    assert error.std() == pytest.approx(np.hypot(IMAGE_SIGMA, np.sqrt(1 / 12)), rel=0.03)
    assert abs(error.mean()) < 0.02
    assert noisy_color(np.full((8, 8, 3), 255, dtype=np.uint8), np.random.default_rng(0)).min() > 245
