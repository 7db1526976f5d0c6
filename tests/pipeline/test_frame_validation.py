"""Frame validation: depth that is constant or frozen counts as missing, with one warning; what only looks like it does not."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Camera, Frame
from trihedron.pipeline.run.frame_validation import FrameValidation, constant_share

REPEATED = "its colour is that of frame 2, bit for bit, while depth has changed"
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


def test_frozen_depth_counts_as_missing_once_colour_has_changed_and_is_said_when_stale(caplog):
    still = frame(2).depth_m
    frames = [frame(k) if k < 2 else frame(k, still.copy()) for k in range(6)] + [frame(6)]
    found, warnings = validated(frames, caplog)
    assert has_depth(found) == "xxx...x"  # frame 3 repeats it for 33 ms, as a Kinect does: no fault, and nothing that its colour was taken with
    assert warnings == [f"frame {k}: its depth is that of frame 2, bit for bit, while colour has changed; it counts as missing" for k in (4, 5)]
    assert all(np.array_equal(f.color, given.color) for f, given in zip(found, frames))


def test_frozen_colour_counts_as_missing_once_it_is_stale_and_depth_has_changed(caplog):
    still = frame(2).color
    frames = [frame(k) if k < 2 else frame(k, color=still.copy()) for k in range(6)] + [frame(6)]
    found, warnings = validated(frames, caplog)
    assert ["-" if f is None else ".x"[bool(f.color.any())] for f in found] == [*"xxx-..x"]  # frame 3 repeats it for 33 ms, as a Kinect does
    said = f"frame 3: {REPEATED}; the frame is skipped", *(f"frame {k}: {REPEATED}; it counts as missing" for k in (4, 5))
    assert warnings == [*said]
    assert all(np.array_equal(f.depth_m, given.depth_m) for f, given in zip(found, frames) if f is not None)


def test_noise_of_depth_over_colour_without_noise_is_no_fault(caplog):
    """A rendered scene at rest: colour is exact, depth has the noise that the camera states."""
    z = np.full((120, 160), 3.0, np.float32)
    noisy = [z + CAMERA.depth_noise.sigma_m(z).astype(np.float32) * np.random.default_rng(k).standard_normal(z.shape, np.float32) for k in range(9)]
    found, warnings = validated([frame(k, noisy[k], frame(0).color) for k in range(9)], caplog)
    assert warnings == [] and all(f.color.any() for f in found)


def test_at_a_low_rate_the_first_repetition_is_stale(caplog):
    found, warnings = validated([frame(0, period_ms=200), frame(1, frame(0).depth_m, period_ms=200)], caplog)
    assert not found[1].depth_m.any() and len(warnings) == 1


def slower(fresh, period_ms=33):
    """Frames whose colour is always new and whose depth is that of the frame of this number, and the validated ones with a camera of that rate."""
    camera = replace(CAMERA, fps=1000 / period_ms)
    return [replace(frame(k, frame(number).depth_m, period_ms=period_ms), camera=camera) for k, number in enumerate(fresh)]


def has_depth(found):
    return "".join(".x"[bool(f.depth_m.any())] for f in found)


@pytest.mark.parametrize(
    "period, period_ms, start, message",
    [
        (2, 33.0, "x.x.x.x.x.", "about 15.2 Hz instead of 30.3: only every second depth image is new"),
        (2, 66.0, "x.x.x.x.x.", "about 7.58 Hz instead of 15.2: only every second depth image is new"),
        (3, 33.0, "x..x..x..x..x..", "about 10.1 Hz instead of 30.3: only every third depth image is new"),
        (4, 33.0, "x...x...x...x...x...", "about 7.58 Hz instead of 30.3: only every 4th depth image is new"),
    ],
)
def test_depth_slower_than_colour_is_named_once_and_an_old_image_counts_as_missing(caplog, period, period_ms, start, message):
    found, warnings = validated(slower([k - k % period for k in range(8 * period)], int(period_ms)), caplog)
    assert has_depth(found) == start + 3 * ("x" + (period - 1) * ".")
    assert warnings == [
        f"depth is slower than colour, {message}, a repeated one counts as missing; "
        f"record depth at the rate of colour, or take the frames with new depth alone: dataset.frames=0::{period}"
    ]


@pytest.mark.parametrize("period, period_ms, start", [(2, 33, "x-" * 5), (3, 33, "x-." * 5), (2, 66, "x." * 5)])
def test_frames_that_repeat_slower_colour_are_left_out(caplog, period, period_ms, start):
    """Until the rate is known, colour older than 50 ms counts as missing; it is said only once that this is the rate."""
    camera = replace(CAMERA, fps=1000 / period_ms)
    frames = [replace(frame(k, color=frame(k - k % period).color, period_ms=period_ms), camera=camera) for k in range(8 * period)]
    found, warnings = validated(frames, caplog)
    assert "".join("-" if f is None else ".x"[bool(f.color.any())] for f in found) == start + 3 * ("x" + (period - 1) * "-")
    which, seen = {2: "second", 3: "third"}[period], f"about {1000 / period_ms / period:.3g} Hz instead of {1000 / period_ms:.3g}"
    assert warnings == [
        f"colour is slower than depth, {seen}: only every {which} colour image is new, frames that repeat one are skipped; "
        "give more light, with which most cameras are faster, or record depth at the rate of colour"
    ]


def test_a_camera_at_rest_has_slower_colour_too(caplog):
    """Depth changes by noise alone: nothing moves, and colour is still repeated."""
    given = [frame(k, frame(0).depth_m + np.float32(1e-4 * k), frame(k - k % 2).color) for k in range(16)]
    found, warnings = validated(given, caplog)
    assert [k for k, f in enumerate(found) if f is None] == [11, 13, 15] and len(warnings) == 1


def test_a_frame_with_plain_colour_is_not_left_out(caplog):
    """A wall without texture looks the same from everywhere, and has no key points to lose."""
    found, warnings = validated([frame(k, color=np.full((120, 160, 3), 128, np.uint8)) for k in range(6)], caplog)
    assert [bool(f.color.any()) for f in found] == [True, True, *4 * [False]] and len(warnings) == 4


def test_slow_depth_that_freezes_is_named(caplog):
    """One image that was missed is none of it."""
    found, warnings = validated(slower([k - k % 2 for k in range(12)] + [10, 10, 14, 14, *[16] * 6]), caplog)
    assert has_depth(found) == "x.x.x.x.x." + "x...x.x....."
    assert warnings[1:] == [
        f"frame {k}: its depth is that of frame 16, bit for bit, while colour has changed; it counts as missing" for k in (20, 21)
    ]


def test_depth_that_repeats_irregularly_is_frozen_each_time(caplog):
    """Each image stays for two, three, two, ... frames of 15 Hz: no rate; what was held back at first is said as soon as that shows."""
    found, warnings = validated(slower([0, 0, 2, 2, 4, 4, 4, 7, 7, 9], 66), caplog)
    assert has_depth(found) == "x.x.x..x.x"
    frozen = [(1, 0), (3, 2), (5, 4), (6, 4), (8, 7)]
    assert warnings == [f"frame {a}: its depth is that of frame {b}, bit for bit, while colour has changed; it counts as missing" for a, b in frozen]


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


@pytest.mark.parametrize("missing", ["depth", "colour"])
def test_a_run_begins_with_the_first_frame_that_shows_something(caplog, missing):
    """Three frames without depth, or black ones, at the beginning are skipped; one in mid-run is not."""
    without = {"depth": {"depth": np.zeros((120, 160), np.float32)}, "colour": {"color": np.zeros((120, 160, 3), np.uint8)}}[missing]
    found, warnings = validated([frame(k, **without) if k in (0, 1, 2, 5) else frame(k) for k in range(7)], caplog)
    assert [k for k, f in enumerate(found) if f is not None] == [3, 4, 5, 6]
    assert warnings == [f"frame {k}: it has no {missing}, nor has any before it; it is skipped" for k in range(3)]


def test_a_dark_room_begins_after_a_second(caplog):
    found, warnings = validated([frame(k, color=np.zeros((120, 160, 3), np.uint8), period_ms=250) for k in range(6)], caplog)
    assert [k for k, f in enumerate(found) if f is not None] == [4, 5] and len(warnings) == 4


def test_a_recorded_frame_without_depth_is_replayed():
    """The frames before it, which had depth, are not those of the replay."""
    given = frame(7, np.zeros((120, 160), np.float32))
    assert FrameValidation({7: given.stamp_ns}, 1)(0, lambda position: given, lambda: 7) is given


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


def test_millimetres_taken_for_metres_are_named_at_once(caplog):
    rng = np.random.default_rng(0)
    given = [frame(k, rng.uniform(499.6, 500.4, (120, 160)).astype(np.float32)) for k in range(12)]
    cure = "give a depth_scale 1000 times as large, or divide float depth by 1000"
    assert validated(given, caplog)[1] == [f"the depth of frames is about 500 m, which are millimetres taken for metres; {cure}"]


def test_depth_of_kilometres_counts_as_missing(caplog):
    depth = np.random.default_rng(0).uniform(900.0, 1000.0, (120, 160)).astype(np.float32)
    depth[:2], depth[2, 0], depth[2, 1] = 16262.0, np.nan, 3e38
    [found], warnings = validated([frame(0, depth)], caplog)
    assert not found.depth_m[:2].any() and not found.depth_m[2, :2].any() and (found.depth_m[3:] == depth[3:]).all()
    assert warnings[1:] == [
        "frame 0: 1 depth readings are negative or not finite; they count as missing",
        "frame 0: 321 depth readings are beyond 1000 m and count as missing; is the depth_scale of the camera right?",
    ]


@pytest.mark.parametrize(
    "period_ms, said",
    [
        (1e11 / 3, "1e+09 periods of the camera apart: their time stamps are nanoseconds taken for seconds"),
        (1e8 / 3, "1e+06 periods of the camera apart: their time stamps are microseconds taken for seconds"),
        (1e5 / 3, "1e+03 periods of the camera apart: their time stamps are milliseconds taken for seconds"),
        (1e-6, "3e-08 periods of the camera apart: their time stamps are seconds taken for nanoseconds"),
        (33, None),
        (2000, None),  # one frame every two seconds
    ],
)
def test_time_stamps_in_another_unit_are_named(period_ms, said, caplog):
    frames = [replace(frame(k), stamp_ns=round(k * period_ms * 1e6)) for k in range(9)]
    frames[4:] = [replace(f, stamp_ns=f.stamp_ns + 10**11) for f in frames[4:]] if said is None else frames[4:]  # a pause
    assert validated(frames, caplog)[1] == ([f"frames are {said}; convert them"] if said else [])


@pytest.mark.parametrize(
    "cx, cy, centre_of", [(159.5, 119.5, "320×240"), (39.5, 29.5, "80×60"), (79.5, 29.5, "160×60"), (79.5, 59.5, None), (90.0, 50.0, None)]
)
def test_intrinsics_of_another_resolution_are_named(cx, cy, centre_of, caplog):
    camera = replace(CAMERA, cx=cx, cy=cy)
    found = validated([replace(frame(k), camera=camera) for k in range(3)], caplog)[1]
    cure = "give the intrinsics of these images, or ignore this where they are cropped"
    place = f"the principal point cx {cx:.4g}, cy {cy:.4g} is far from the centre of images of 160×120"
    assert found == ([f"{place}: it is the centre of {centre_of}; {cure}"] if centre_of else [])
