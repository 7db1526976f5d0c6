"""Every plugin alone in the default graph: a pose that is never measured is never `ok`."""

import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.registry import load_plugins, plugins_of
from trihedron.pipeline.core.slots import FOLDS, SLOTS
from trihedron.pipeline.core.types import OK
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth

sys.path.insert(0, str(Path(__file__).parent / "plugins"))
from small_networks import network_words

load_plugins()
EVERY = [
    pytest.param(slot, name, id=f"{slot}={name}")
    for slot in SLOTS
    if slot != "dataset" and slot not in FOLDS  # no pose depends on a fold
    for name, kind in plugins_of(slot).items()
    if kind.__module__.startswith("trihedron.")
]
WITH = {("pose", "icp"): ["model=tsdf"], ("model", "tsdf"): ["pose=icp"], ("model", "surfels"): ["pose=icp"]}
ROOM = ["dataset.length=15", "dataset.width=320", "dataset.height=240"]
LEAST_M = 0.02  # of the true way from the first frame, from which on it must be seen
LEAST_SHARE = 0.5  # of it that an `ok` pose must have gone


@pytest.mark.slow
@pytest.mark.parametrize(("slot", "name"), EVERY)
def test_a_pose_that_is_ok_has_moved_with_the_camera(slot, name, tmp_path):
    networks = network_words(slot, tmp_path) if name.startswith("onnx") else []
    words = [f"{slot}={name}", *networks, *WITH.get((slot, name), []), *ROOM]
    assert main(["run", *words, f"out={tmp_path}/run"]) == 0
    recording = Recording(tmp_path / "run" / "run.mcap")
    truth = attached_truth(recording.attachments, "run.mcap")
    way = dict(zip(truth.stamps_ns.tolist(), np.linalg.norm((invert(truth.poses[0]) @ truth.poses)[:, :3, 3], axis=1)))
    poses = list(recording.values("pose"))
    assert len(poses) == 15 and max(way.values()) > 3.0 * LEAST_M
    held = [
        pose.index
        for pose in poses
        if pose.status == OK and way[pose.stamp_ns] > LEAST_M and np.linalg.norm(pose.T_world_camera[:3, 3]) < LEAST_SHARE * way[pose.stamp_ns]
    ]
    assert held == []
