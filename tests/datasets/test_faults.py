"""A data set with its camera covered: what is blinded, what is not, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from trihedron.datasets.faults.faults import Cover, Covered, Faults
from trihedron.datasets.simulation.motion import Motion
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.types import CalibrationSigmas

SMALL = {"width": 64, "height": 48, "motion": "pan"}


@cache
def still_frames(first, last):
    """The frames without faults, rendered once."""
    data = Synthetic(width=64, height=48, motion=Motion.pan, frames=f"{first}:{last}")
    return [data(position) for position in range(len(data))], data.truth()


@pytest.mark.parametrize("covered", list(Covered))
def test_covered_frames_are_blind_and_the_others_untouched(covered):
    (plain, truth), faults = still_frames(2, 9), Faults("2:9", "synthetic", SMALL, "4:6", covered)
    assert len(faults) == len(plain) == 7 and len(faults.truth()) == len(truth)
    for position in range(7):
        seen, true = faults(position), plain[position]
        blind = seen.index in (4, 5)
        assert (seen.index, seen.stamp_ns) == (true.index, true.stamp_ns)
        assert seen.camera == replace(true.camera, sigmas=CalibrationSigmas())  # nobody calibrated it
        assert np.array_equal(seen.color, true.color if covered is Covered.depth or not blind else np.zeros_like(true.color))
        assert np.array_equal(seen.depth_m, true.depth_m if covered is Covered.color or not blind else np.zeros_like(true.depth_m))


@pytest.mark.parametrize(
    "options, cause",
    [
        ({"cover": "9:3"}, "not a range"),
        ({"of": "faults"}, "another data set"),
        ({"options": {"frames": "0:3"}}, "dataset.frames"),
        ({"options": {"motion": "fly"}}, "'fly' is not one of walk, fast, still, pan"),
        ({"options": {"length": -1}}, "length: -1 is not at least 0"),
    ],
)
def test_what_cannot_be_read_is_refused(options, cause):
    with pytest.raises(ValueError, match=cause):
        Faults(**options)


@pytest.mark.parametrize("frozen", list(Covered))
def test_one_image_freezes_and_the_other_goes_on(frozen):
    (plain, _), faults = still_frames(0, 6), Faults("0:6", "synthetic", SMALL, freeze="2:5", frozen=frozen)
    for position in range(6):
        seen, still = faults(position), 2 if position in (3, 4) else position
        assert seen.stamp_ns == plain[position].stamp_ns
        assert np.array_equal(seen.color, plain[position if frozen is Covered.depth else still].color)
        assert np.array_equal(seen.depth_m, plain[position if frozen is Covered.color else still].depth_m)


@pytest.mark.parametrize("frozen", list(Covered))
def test_a_part_of_an_image_freezes(frozen):
    """The left quarter, 16 columns."""
    (plain, _), faults = still_frames(0, 6), Faults("0:6", "synthetic", SMALL, freeze="2:5", frozen=frozen, frozen_share=0.25)
    seen, now, then = faults(4), plain[4], plain[2]
    for name, froze in (("color", frozen is not Covered.depth), ("depth_m", frozen is not Covered.color)):
        image, new, old = (getattr(frame, name) for frame in (seen, now, then))
        assert np.array_equal(image[:, 16:], new[:, 16:]) and np.array_equal(image[:, :16], (old if froze else new)[:, :16])


def test_colour_that_is_frozen_has_new_noise():
    (plain, _), faults = still_frames(0, 6), Faults("0:6", "synthetic", SMALL, freeze="2:5", frozen=Covered.color, color_noise=2.0)
    third, fourth = faults(3).color.astype(int), faults(4).color.astype(int)
    inner = (plain[2].color > 20) & (plain[2].color < 235)
    for image in (third, fourth):
        assert 1.9 < (image - plain[2].color)[inner].std() < 2.2  # with that of rounding
    assert 2.6 < (third - fourth)[inner].std() < 3.1
    assert np.array_equal(faults(4).color, fourth)


def test_a_stride_is_of_the_frames_as_they_arrive_and_a_cover_of_those_underneath():
    (plain, _), faults = still_frames(0, 12), Faults("1::4", "synthetic", {**SMALL, "length": 12}, cover="0:12:3", drop="2:3")
    seen = [faults(position) for position in range(len(faults))]
    assert [frame.index for frame in seen] == [1, 5, 9]  # which are 1, 6 and 10 underneath
    assert [frame.stamp_ns for frame in seen] == [plain[k].stamp_ns for k in (1, 6, 10)]
    assert [bool(frame.color.any()) for frame in seen] == [True, False, True]


def test_one_image_is_slower_than_the_other():
    (plain, _), slow_depth, slow_color = (
        still_frames(0, 6),
        Faults("0:6", "synthetic", SMALL, depth_every=3),
        Faults("0:6", "synthetic", SMALL, color_every=2),
    )
    for position, depth, color in zip(range(6), (0, 0, 0, 3, 3, 3), (0, 0, 2, 2, 4, 4)):
        assert np.array_equal(slow_depth(position).color, plain[position].color)
        assert np.array_equal(slow_depth(position).depth_m, plain[depth].depth_m)
        assert np.array_equal(slow_color(position).color, plain[color].color)
        assert np.array_equal(slow_color(position).depth_m, plain[position].depth_m)


def test_color_is_mirrored_shuffled_or_random_and_depth_is_not():
    options = {**SMALL, "length": 12}
    plain = [Synthetic(width=64, height=48, motion=Motion.pan, length=12)(i) for i in range(12)]
    mirrored, shuffled = Faults("", "synthetic", options, mirror=True, during="3:5"), Faults("", "synthetic", options, shuffle=True)
    noise = Faults("", "synthetic", options, "3:5", Covered.color, Cover.random)
    assert np.array_equal(mirrored(3).color, plain[3].color[:, ::-1]) and np.array_equal(mirrored(5).color, plain[5].color)
    images = [shuffled(i).color for i in range(12)]
    shown = [next(k for k in range(12) if np.array_equal(image, plain[k].color)) for image in images]
    assert shown != list(range(12)) and len(set(shown)) > 4
    assert noise(3).color.std() > 60.0 and not np.array_equal(noise(3).color, noise(4).color)
    for i in (3, 4, 7):
        assert all(np.array_equal(faults(i).depth_m, plain[i].depth_m) for faults in (mirrored, shuffled, noise))


def test_two_recordings_are_joined_in_time_but_not_in_space():
    joined = Faults("", "synthetic", {**SMALL, "length": 5}, join=3, joined={"seed": 1})
    first, second = (Synthetic(width=64, height=48, motion=Motion.pan, length=5, seed=seed) for seed in (0, 1))
    assert len(joined) == 8
    frames = [joined(i) for i in range(8)]
    assert [frame.index for frame in frames] == list(range(8))
    steps = np.diff([frame.stamp_ns for frame in frames])
    assert np.all(np.abs(steps - 1e9 / 30.0) < 2.0)
    assert np.array_equal(frames[2].color, first(2).color) and np.array_equal(frames[3].color, second(0).color)
    truth = joined.truth()
    assert truth.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]
    assert truth.poses[3, 0, 3] - truth.poses[2, 0, 3] > 900.0
    with pytest.raises(ValueError, match="join: the first data set has 5 frames only"):
        Faults("", "synthetic", {**SMALL, "length": 5}, join=6)(0)
