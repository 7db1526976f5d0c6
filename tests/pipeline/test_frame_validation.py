"""Frame validation: depth that is constant or frozen counts as missing, with one warning; what only looks like it does not."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Camera, Frame
from trihedron.pipeline.run.frame_validation import FrameValidation, constant_share

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


def frame(index, depth=None, color=None, period_ms=33):
    """A frame of random depth and colour, unless they are given."""
    rng = np.random.default_rng(index)
    depth = rng.uniform(1.0, 4.0, (120, 160)).astype(np.float32) if depth is None else depth
    color = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8) if color is None else color
    return Frame(index, index * period_ms * 1_000_000, color, depth, CAMERA)


def validated(frames, caplog):
    """The frames as stages get them, and the warnings."""
    validation = FrameValidation({}, len(frames))
    caplog.clear()
    return [validation(k, frames.__getitem__, lambda k=k: k) for k in range(len(frames))], caplog.messages


def test_frozen_depth_counts_as_missing_once_it_is_stale_and_colour_has_changed(caplog):
    still = frame(2).depth_m
    frames = [frame(k) if k < 2 else frame(k, still.copy()) for k in range(6)] + [frame(6)]
    found, warnings = validated(frames, caplog)
    assert [bool(f.depth_m.any()) for f in found] == [True] * 4 + [False] * 2 + [True]  # frame 3 repeats it for 33 ms, as a Kinect does
    assert warnings == [f"frame {k}: its depth is that of frame 2, bit for bit, while colour has changed; it counts as missing" for k in (4, 5)]
    assert all(np.array_equal(f.color, given.color) for f, given in zip(found, frames))


def test_frozen_colour_counts_as_missing_once_it_is_stale_and_depth_has_changed(caplog):
    still = frame(2).color
    frames = [frame(k) if k < 2 else frame(k, color=still.copy()) for k in range(6)] + [frame(6)]
    found, warnings = validated(frames, caplog)
    assert [bool(f.color.any()) for f in found] == [True] * 4 + [False] * 2 + [True]
    assert warnings == [f"frame {k}: its colour is that of frame 2, bit for bit, while depth has changed; it counts as missing" for k in (4, 5)]
    assert all(np.array_equal(f.depth_m, given.depth_m) for f, given in zip(found, frames))


def test_noise_of_depth_over_colour_without_noise_is_no_fault(caplog):
    """A rendered scene at rest: colour is exact, depth has the noise that the camera states."""
    z = np.full((120, 160), 3.0, np.float32)
    noisy = [z + CAMERA.depth_noise.sigma_m(z).astype(np.float32) * np.random.default_rng(k).standard_normal(z.shape, np.float32) for k in range(9)]
    found, warnings = validated([frame(k, noisy[k], frame(0).color) for k in range(9)], caplog)
    assert warnings == [] and all(f.color.any() for f in found)


def test_at_a_low_rate_the_first_repetition_is_stale(caplog):
    found, warnings = validated([frame(0, period_ms=200), frame(1, frame(0).depth_m, period_ms=200)], caplog)
    assert not found[1].depth_m.any() and len(warnings) == 1


def test_a_camera_at_rest_and_repeated_frames_are_no_fault(caplog):
    """Exact depth of a scene that stands still, with noise in colour alone; and whole frames that are repeated."""
    depth, color = frame(0).depth_m, np.full((120, 160, 3), 120, np.uint8)
    noise = [np.random.default_rng(k).normal(0, 4, color.shape) for k in range(9)]
    frames = [frame(k, depth, (color + noise[k]).astype(np.uint8)) for k in range(9)]
    frames += [replace(frames[-1], index=k, stamp_ns=k * 33_000_000) for k in range(9, 15)]
    found, warnings = validated(frames, caplog)
    assert warnings == [] and all(np.array_equal(f.depth_m, depth) for f in found)


def test_a_slow_change_adds_up(caplog):
    """Each frame is 3 grey levels brighter than the one before: below the limit, but not below it for long."""
    depth = frame(0).depth_m
    found, _ = validated([frame(k, depth, np.full((120, 160, 3), 60 + 3 * k, np.uint8)) for k in range(9)], caplog)
    assert [k for k, f in enumerate(found) if not f.depth_m.any()] == [6, 7, 8]


@pytest.mark.parametrize("value", [65.535, 1.0])
def test_constant_depth_counts_as_missing(caplog, value):
    depth = np.full((120, 160), value, np.float32)
    depth[:40] = 0.0
    found, warnings = validated([frame(0), frame(1, depth), frame(2)], caplog)
    assert [bool(f.depth_m.any()) for f in found] == [True, False, True]
    assert warnings == ["frame 1: 100 % of its depth readings are equal; they count as missing"]


def test_share_of_equal_readings():
    depth = np.zeros((80, 80), np.float32)
    assert constant_share(depth) == 0.0
    depth[0, 0] = 2.0
    assert constant_share(depth) == 0.0  # one reading is nothing to judge by
    depth[:40], depth[40:] = 2.0, 3.0
    assert constant_share(depth) == 0.5


def test_a_camera_that_cannot_be_recorded_is_refused_at_the_first_frame():
    frame = Frame(0, 0, np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32), replace(CAMERA, fps=1e7))
    with pytest.raises(DataError) as error:
        FrameValidation({}, 1)(0, lambda position: frame, lambda: 0)
    assert str(error.value) == "camera of frame 0: fps is not within 1e-06 … 1e+06; check the calibration of the data set"
