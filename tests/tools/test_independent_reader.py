"""Recordings as an MCAP reader of other people's sees them: @mcap/core (TypeScript), and the layout for Foxglove that belongs to them."""

import json
import os
import re
import shutil
import ssl
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.types import Frame, FrameReference, ManhattanFrame, Planes, Pose, Segments, Trajectory
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.pipeline.record.rescue import recover
from trihedron.pipeline.record.writer import RecordingWriter

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))
from toys import ToyDataset, ToyKeypoints

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).with_name("read_mcap.mjs")
PACKAGES = ["@mcap/core@2.2.2", "@mcap/nodejs@1.0.2", "@mcap/support@1.1.0", "protobufjs@8.8.1"]
RUN = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"


@pytest.fixture(scope="module")
def reader():
    """Reads a file and returns what it found; the packages are installed once, into a folder for temporary files."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("node and npm are not there")
    folder = Path(tempfile.gettempdir()) / "trihedron_mcap_reader"
    if not (folder / "installed").exists():
        folder.mkdir(exist_ok=True)
        authorities = ssl.get_default_verify_paths().cafile  # of the system; npm knows its own alone
        environment = {**({"NODE_EXTRA_CA_CERTS": authorities} if authorities else {}), **os.environ}
        try:
            words = ["npm", "install", "--no-audit", "--no-fund", "--silent", "--fetch-retries=0", "--prefix", str(folder), *PACKAGES]
            subprocess.run(words, check=True, capture_output=True, timeout=120, env=environment)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            pytest.skip("npm cannot install @mcap/core: its registry is not reached")
        (folder / "installed").touch()
    script = folder / SCRIPT.name
    shutil.copy(SCRIPT, script)

    def read(path):
        done = subprocess.run(["node", str(script), str(path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return read


def values(index):
    """A frame, and what the stages might have found in it."""
    frame, n = ToyDataset(40)(index), 3
    stamp = 50_000_000 * index
    pixels, points = np.ones((n, 2, 2), np.float32), np.ones((n, 2, 3), np.float32)
    square = np.array([[[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]]], np.float32)
    pose = np.eye(4)
    pose[0, 3] = 0.01 * index
    yield "frames", FrameReference(index, stamp, frame.camera)
    yield "dataset", Frame(index, stamp, frame.color, frame.depth_m, frame.camera)
    keypoints = ToyKeypoints()(ToyDataset(40)(40), np.random.default_rng(0))
    yield "keypoints", type(keypoints)(**{**vars(keypoints), "index": index, "stamp_ns": stamp})
    yield "segments", Segments(index, stamp, pixels, points, np.ones((n, 2, 3, 3), np.float32), np.zeros((n, 0), np.uint8))
    plane, labels = np.array([[0, 0, -1.0, 2.0]]), np.zeros((2, 2), np.uint8)
    yield "planes", Planes(index, stamp, plane, np.zeros((1, 3, 3)), np.zeros((1, 4, 4)), np.ones(1, np.int32), square, labels, 2)
    ids, spread = np.zeros(1, np.int32), np.zeros((1, 3))
    yield "manhattan", ManhattanFrame(index, stamp, np.eye(3)[None], ids, np.zeros((1, 3, 3)), np.ones((1, 3), np.int32), spread, True)
    yield "pose", Pose(index, stamp, pose, np.eye(6), pose, -1, np.zeros(3, np.int32), 0, "lost" if index == 7 else "ok", "")


def recorded(path, count=12):
    poses = np.tile(np.eye(4), (count, 1, 1))
    writer, view = RecordingWriter(path, {"overrides": "[]"}), TopicView(Trajectory(50_000_000 * np.arange(count), poses))
    writer.attach("groundtruth.txt", "# none")
    for i in range(count):
        for topic, value in values(i):
            writer.write(topic, value)
            writer.show(view, value, value.stamp_ns)
        writer.write_timing(i, 50_000_000 * i, 1.5, {"keypoints": 1.25}, 250.0)
    writer.close()
    return path


def check(found):
    assert found["problems"] == [] and found["chunks"] > 0 and found["compressions"] == ["zstd"]
    assert found["streamed"] == found["statistics"] == sum(topic["messages"] for topic in found["topics"].values()) > 0


def test_a_recording_is_read_by_others(reader, tmp_path):
    found = reader(recorded(tmp_path / "a.mcap"))
    check(found)
    schemas = {name: topic["schema"] for name, topic in found["topics"].items()}
    assert schemas["/pose"] == "trihedron.Pose" and schemas["/tf"] == "foxglove.FrameTransform" and schemas["/error"] == "trihedron.Error"
    assert schemas["/view/features"] == "foxglove.ImageAnnotations" and schemas["/view/axes"] == "foxglove.SceneUpdate"
    assert found["topics"]["/pose"]["messages"] == 12 and found["topics"]["/error"]["messages"] == 11  # one frame is lost
    assert found["topics"]["/view/image"]["formats"] == ["jpeg"] * 3  # 5 Hz of 20


def test_a_recording_that_was_cut_off_is_read_by_others_once_recovered(reader, tmp_path):
    data = recorded(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: data.rindex(b"trihedron.Pose") - 50])  # in the index
    recover(tmp_path / "a.mcap", tmp_path / "a.mcap")
    found = reader(tmp_path / "a.mcap")
    check(found)
    assert found["topics"]["/pose"]["messages"] == 12


def shown(layout):
    """The topics a layout names; of plots the part before the first dot."""
    names = set(re.findall(r'"(/[a-z_/]+)[."]', json.dumps(layout)))
    assert "/view/image" in names and "/timing" in names
    return names


def test_the_layout_is_one(tmp_path):
    layout = json.loads((ROOT / "docs" / "foxglove_layout.json").read_text())
    panels = set(re.findall(r'"([A-Za-z0-9]+![a-z]+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"]) and {panel.split("!")[0] for panel in panels} == {"3D", "Image", "Plot", "Log"}


@pytest.mark.slow
def test_a_run_is_read_by_others_and_holds_what_the_layout_shows(reader, tmp_path):
    words = ["dataset=faults", "dataset.of=synthetic", "dataset.frames=0:60", "dataset.cover=30:40", "outputs=[trajectory,surface,building]"]
    words += [f"out={tmp_path}/run"]
    done = subprocess.run([sys.executable, "-c", RUN, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = reader(tmp_path / "run" / "run.mcap")
    check(found)
    assert shown(json.loads((ROOT / "docs" / "foxglove_layout.json").read_text())) <= set(found["topics"])
    assert len(found["topics"]["/view/image"]["formats"]) == 10 and found["topics"]["/view/log"]["messages"] >= 2
