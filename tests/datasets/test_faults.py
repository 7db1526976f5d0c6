"""A data set with its camera covered: what is blinded, what is not, and what is refused."""

import numpy as np
import pytest

from trihedron.datasets.faults.faults import Covered, Faults
from trihedron.datasets.simulation.motion import Motion
from trihedron.datasets.simulation.synthetic import Synthetic

SMALL = {"width": 64, "height": 48, "motion": "pan"}


@pytest.mark.parametrize("covered", list(Covered))
def test_covered_frames_are_blind_and_the_others_untouched(covered):
    plain, faults = Synthetic(width=64, height=48, motion=Motion.pan, frames="2:9"), Faults("2:9", "synthetic", SMALL, "4:6", covered)
    assert len(faults) == len(plain) == 7 and len(faults.truth()) == len(plain.truth())
    for position in range(7):
        seen, true = faults(position), plain(position)
        blind = seen.index in (4, 5)
        assert (seen.index, seen.stamp_ns, seen.camera) == (true.index, true.stamp_ns, true.camera)
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
