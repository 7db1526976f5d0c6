"""Sensors of several kinds: their noise, their holes, and what hidden parameters do to the images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trihedron.datasets.simulation import sensor_depth
from trihedron.datasets.simulation.exposure import expose_image, gain_for, motion_px
from trihedron.datasets.simulation.motion import Motion
from trihedron.datasets.simulation.sensor_models import MODELS, Sensor, SensorParameters, drawn_parameters
from trihedron.datasets.simulation.simulated_sensor import SimulatedSensor
from trihedron.pipeline.core.types import Camera

PERFECT = SensorParameters(0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0, 1.0, 0.0, (1.0, 1.0), (0.0, 0.0), 1.0, (0.0, 0.0))
SMALL: dict[str, Any] = {"width": 160, "height": 120, "motion": Motion.pan, "length": 30, "texture": False}


def with_hidden(dataset: SimulatedSensor, **hidden: Any) -> SimulatedSensor:
    dataset.__dict__["hidden"] = replace(PERFECT, **hidden)
    return dataset


@pytest.mark.parametrize("sensor", list(Sensor))
def test_a_frame_depends_on_its_number_and_the_seeds_alone(sensor: Sensor) -> None:
    first, again, other = (SimulatedSensor(sensor=sensor, sensor_seed=seed, frames=frames, **SMALL) for seed, frames in ((1, ""), (1, "7:"), (2, "")))
    a, b, c = first(7), again(0), other(7)
    assert a is not None and b is not None and c is not None
    assert a.index == b.index == 7 and a.stamp_ns == b.stamp_ns == round(7e9 / MODELS[sensor].fps)
    assert np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m)
    assert not np.array_equal(a.color, c.color) and a.camera == c.camera
    assert 0.3 < (a.depth_m > 0).mean() <= 1.0 and np.isfinite(a.depth_m).all() and a.depth_m.min() >= 0.0


def test_hidden_parameters_stay_within_their_ranges_and_differ_by_the_seed() -> None:
    for sensor, model in MODELS.items():
        drawn = [drawn_parameters(sensor, seed) for seed in range(20)]
        assert len(set(drawn)) == 20
        for one in drawn:
            assert model.delay_ms[0] <= one.delay_ms <= model.delay_ms[1] and model.readout_ms[0] <= one.readout_ms <= model.readout_ms[1]
            assert 1.0 <= np.hypot(*one.misregistration_px) <= 3.0 and max(abs(k - 1.0) for k in one.focal_factor) <= 0.005


def test_a_rolling_shutter_shows_each_row_from_its_own_pose() -> None:
    """Exact depth of a pan: the first and last rows are those of global shutters half a readout before and after."""
    dataset = with_hidden(SimulatedSensor(**SMALL))
    _, rolled, _ = dataset._render_rolling_shutter(dataset.camera, 0.5, 0.04)
    _, early, _ = dataset._render_rolling_shutter(dataset.camera, 0.5 - 0.02 * (1 - 8 / 120), 0.0)
    _, late, _ = dataset._render_rolling_shutter(dataset.camera, 0.5 + 0.02 * (1 - 8 / 120), 0.0)
    assert np.abs(rolled[:8] - early[:8]).max() < 1e-6 and np.abs(rolled[-8:] - late[-8:]).max() < 1e-6
    assert np.abs(rolled[:8] - late[:8]).max() > 0.01


def test_delay_and_misregistration_move_depth_against_colour() -> None:
    plain, late = (
        with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL), delay_ms=delay)._depth(0.5, np.random.default_rng(0)) for delay in (0, 30)
    )
    ahead = with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL))._depth(0.53, np.random.default_rng(0))
    assert np.array_equal(late, ahead) and not np.array_equal(plain, late)
    moved = with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL), misregistration_px=(8.0, 0.0))  # 2 px of 160
    assert moved.depth_camera.cx == moved.color_camera.cx + 2.0


def test_radial_and_inverse_errors_of_depth_are_as_stated() -> None:
    rng = [np.random.default_rng(0) for _ in range(3)]
    plain = with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL))._depth(0.0, rng[0])
    radial = with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL), radial_bias=0.02)._depth(0.0, rng[1])
    inverse = with_hidden(SimulatedSensor(sensor=Sensor.tof, **SMALL), inverse_depth_offset_per_m=0.004)._depth(0.0, rng[2])
    seen = plain > 0
    y, x = np.mgrid[:120, :160]
    radius2 = ((x - 79.5) ** 2 + (y - 59.5) ** 2) / (80**2 + 60**2)
    np.testing.assert_allclose((radial / np.maximum(plain, 1e-9))[seen], (1 + 0.02 * radius2)[seen], rtol=1e-5)
    np.testing.assert_allclose(1 / plain[seen] - 1 / inverse[seen], 0.004, rtol=0.01)


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_the_noise_of_stereo_grows_with_the_square_of_the_range(z: float) -> None:
    gray = np.random.default_rng(1).integers(0, 255, (240, 320)).astype(np.uint8)
    read = sensor_depth.stereo_depth(np.full((240, 320), z), gray, 300.0, 1.0, np.random.default_rng(0))
    seen = read > 0
    expected = sensor_depth.SUBPIXEL_PX * z**2 / (300.0 * sensor_depth.STEREO_BASELINE_M)
    assert seen.mean() > 0.9 and (read[seen] - z).std() == pytest.approx(expected, rel=0.1)


def test_stereo_has_holes_without_texture_and_fattens_what_is_near() -> None:
    rng = np.random.default_rng(0)
    blank, textured = np.full((240, 320), 128, np.uint8), rng.integers(0, 255, (240, 320)).astype(np.uint8)
    far = np.full((240, 320), 5.0)
    assert (sensor_depth.stereo_depth(far, blank, 300.0, 1.0, rng) == 0).mean() > 0.8
    assert (sensor_depth.stereo_depth(far, textured, 300.0, 1.0, rng) == 0).mean() < 0.1
    far[:, 150:200] = 1.0
    read = sensor_depth.stereo_depth(far, textured, 300.0, 1.0, rng)
    near = (read > 0) & (read < 2.0)
    assert near[:, 200].mean() > 0.9 and not near[:, 205:].any()


def test_time_of_flight_has_flying_pixels_and_loses_what_is_dark_and_far() -> None:
    depth, bright = np.full((120, 160), 4.0), np.full((120, 160), 200, np.uint8)
    depth[:, 60:100] = 1.5
    read = sensor_depth.tof_depth(depth, np.ones((120, 160), np.float32), bright, 1.0, np.random.default_rng(0))
    flying = (read > 1.6) & (read < 3.8)
    assert 0.3 < flying[:, [59, 60, 99, 100]].mean() < 0.8 and not np.delete(flying, [59, 60, 99, 100], axis=1).any()
    dark = sensor_depth.tof_depth(depth, np.ones((120, 160), np.float32), np.full((120, 160), 5, np.uint8), 1.0, np.random.default_rng(0))
    assert (dark[:, :55] == 0).all() and (dark[:, 65:95] > 0).all()


def test_the_motion_of_pixels_is_that_of_the_camera() -> None:
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    after = np.eye(4)
    after[0, 3] = 0.1
    flow = motion_px(np.full((120, 160), 2.0), camera, np.eye(4), after)
    np.testing.assert_allclose(flow[..., 0], -130.0 * 0.1 / 2.0, atol=1e-3)
    np.testing.assert_allclose(flow[..., 1], 0.0, atol=1e-3)


def test_exposure_brightens_what_is_dark_and_jpeg_leaves_its_traces() -> None:
    assert gain_for(55.0, 1.0) == 2.0 and gain_for(55.0, 0.0) == 1.0 and 0.5 <= gain_for(250.0, 1.0) < 1.0
    color = np.random.default_rng(0).integers(40, 90, (96, 128, 3)).astype(np.uint8)
    plain = expose_image(color, 2.0, 0, np.random.default_rng(0))
    packed = expose_image(color, 2.0, 60, np.random.default_rng(0))
    assert plain[40:56, 56:72].mean() == pytest.approx(2.0 * color[40:56, 56:72].mean(), rel=0.03)
    assert 1.0 < np.abs(plain.astype(int) - packed).mean() < 40.0
