"""Depth that is not registered to colour is noticed; registered depth is not blamed."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.seven_scenes import SevenScenes
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.run.frame_validation import FrameValidation
from trihedron.pipeline.run.registration_check import EVERY, FRAMES, RegistrationCheck, depth_edges


def judged(dataset, change=lambda frame: frame):
    check = RegistrationCheck()
    found = [check(change(dataset(index))) for index in range(0, EVERY * FRAMES, EVERY)]
    assert found[:-1] == [None] * (FRAMES - 1)
    return found[-1]


def moved(scale, shift_px):
    """Depth as a camera with another focal length beside that of colour sees it."""

    def change(frame):
        camera = frame.camera
        move = np.array([[1 / scale, 0, camera.cx * (1 - 1 / scale) - shift_px / scale], [0, 1 / scale, camera.cy * (1 - 1 / scale)]])
        return replace(frame, depth_m=cv2.warpAffine(frame.depth_m, move, (camera.width, camera.height), flags=cv2.INTER_NEAREST))

    return change


@pytest.mark.parametrize("noise", [False, True])
def test_registered_depth_is_not_blamed(noise):
    assert judged(Synthetic(length=100, noise=noise)) is None


def test_depth_of_another_camera_is_named_once():
    message = judged(Synthetic(length=100), moved(0.9, -12))
    assert message is not None and message.startswith("scaled by 0.90 and shifted by -12, 0 px, its edges fit those of colour ")
    check = RegistrationCheck()
    dataset = Synthetic(length=100)
    assert sum(check(moved(0.9, -12)(dataset(index))) is not None for index in range(0, 80, EVERY)) == 1


ONE_CAMERA = "{width: 640, height: 480, fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0, depth_scale: 1000.0}"


def test_the_kitchen_of_7_scenes(caplog, tmp_path):
    """As if both cameras were one, its depth is not registered; with the data set's two it is."""
    folder = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "seven_scenes_kitchen"
    if not folder.is_dir():
        pytest.skip(f"{folder.name} is not beside this checkout")
    (tmp_path / "camera.yaml").write_text(ONE_CAMERA)
    dataset = SevenScenes(str(folder), camera=str(tmp_path / "camera.yaml"))
    first = dataset(0)
    assert len(dataset) == 160 and (first.index, first.stamp_ns) == (0, 13_333_333_333) and dataset.truth() is not None
    assert first.camera.fx == 585.0 and first.depth_m.max() < 65.0
    validation = FrameValidation({}, len(dataset))
    for index in range(0, EVERY * FRAMES, EVERY):
        validation(index, dataset, lambda: 0)
    warnings = [text for text in caplog.messages if text.startswith("depth is not registered to colour: scaled by 0.9")]
    assert len(warnings) == 1 and warnings[0].endswith("; register it, or calibrate the two cameras")
    assert judged(SevenScenes(str(folder))) is None


def test_depth_edges_are_on_the_near_side_across_shadows():
    depth = np.full((40, 60), 4.0, np.float32)
    depth[:, 20:30] = 2.0
    depth[:, 15:20] = 0.0  # the shadow beside it
    found = depth_edges(depth)
    assert set(found[:, 0]) == {20, 29} and set(found[:, 1]) == set(range(0, 40, 2))
    assert len(depth_edges(np.full((40, 60), 3.0, np.float32))) == len(depth_edges(np.zeros((40, 60), np.float32))) == 0


def test_edges_of_depth_are_on_the_near_side_of_a_jump_within_a_line():
    depth = np.zeros((3, 32), np.float32)
    depth[0, :16], depth[0, 16:] = 2.0, 3.0  # a step
    depth[2, 4], depth[2, 16] = 2.0, 1.0  # across a shadow, at its widest
    depth[2, 29] = 3.0  # beyond the widest
    assert depth_edges(depth).tolist() == [[15, 0], [16, 2], [16, 2]]  # along rows, then columns
    depth[0, 16:], depth[2, 16] = np.inf, np.nan  # no readings
    assert depth_edges(depth).tolist() == []
