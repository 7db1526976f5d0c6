"""Wrong focal lengths are told from the keyframes' own measurements."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.plugins.pose.focal_length import focal_check

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import CAMERA, World
from map_steps import EVERY, walk


@pytest.fixture(scope="module")
def map():
    return walk(World(1500), 6, EVERY, stride=8)


@pytest.mark.parametrize("wrong", [0.8, 0.9, 1.0, 1.1, 1.2])
def test_the_factor_is_found(map, wrong):
    """Keyframes told focal lengths that are wrong by a factor fit best under its inverse."""
    told = np.tile([wrong * CAMERA.fx, wrong * CAMERA.fy, CAMERA.cx, CAMERA.cy], (len(map.keyframes), 1))
    misled = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(len(told)), intrinsics=told))
    found = focal_check(misled)
    print(wrong, found)
    assert found.factor == pytest.approx(1.0 / wrong, rel=0.03) and found.worse >= 1.0
    assert ("focal lengths" in found.doubt(0.1, 0.2)) == (wrong in (0.8, 1.2))


def test_two_keyframes_are_too_few():
    assert focal_check(walk(World(1500), 2, EVERY, stride=8)) is None
