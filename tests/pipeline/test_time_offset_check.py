"""Depth of another time than its colour is noticed by the camera's motion; depth of the same time is not blamed."""

from dataclasses import replace

import numpy as np
import pytest

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.types import LOST, Pose
from trihedron.pipeline.run.time_offset_check import TimeOffsetCheck

LATE = (
    "depth was taken about 100 ms before colour: by the camera's motion its edges fit those of colour 1.5 times better then; pair "
    "colour with the depth of its own time: add -0.10 to depth_delay_s of camera.yaml, or what trihedron calibrate estimates"
)


def found(lag, status="ok", noise=True, frames=70, change=lambda depth: depth):
    """The warnings about the built-in room, whose true poses are given, with the depth of `lag` frames before."""
    dataset, check = Synthetic(length=frames + 10, noise=noise, width=320, height=240), TimeOffsetCheck()
    truth, messages = dataset.truth(), []
    for index in range(5, frames):
        frame = dataset(index)
        pose = Pose(index, frame.stamp_ns, truth.poses[index], np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, status, "")
        messages.append(check(replace(frame, depth_m=change(dataset(index - lag).depth_m)), pose))
    return [message for message in messages if message]


@pytest.mark.parametrize("noise", [False, True])
def test_depth_of_the_same_time_is_not_blamed(noise):
    assert found(0, noise=noise) == []


def test_late_depth_is_named_once():
    assert found(3) == [LATE]


def test_early_depth_is_named():
    (message,) = found(-3)
    assert message.startswith("depth was taken about 80 ms after colour: ") and "add 0.08 to depth_delay_s of camera.yaml" in message


def test_depth_that_lies_elsewhere_is_not_called_late():
    assert found(0, change=lambda depth: np.roll(depth, 3, axis=1)) == []


def test_nothing_is_told_by_lost_poses():
    assert found(3, status=LOST) == []


@pytest.mark.parametrize(("lag", "expected"), [(0, 0), (3, 1)])
def test_a_run_warns_of_late_depth(lag, expected, caplog):
    dataset = Synthetic(length=70, width=320, height=240)
    with th.Slam(dataset(0).camera, outputs=["trajectory"]) as slam:
        for index in range(lag, 64):
            frame = dataset(index)
            slam.track(frame.color, dataset(index - lag).depth_m, 1e-9 * frame.stamp_ns)
    assert sum(text.startswith("depth was taken about ") for text in caplog.messages) == expected
