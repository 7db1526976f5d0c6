"""`trihedron benchmark --peers` with a stand-in for the package `pyorbslam3`, which has its interface and tracks by the ground truth."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.tools.benchmark import dataset_of
from trihedron.tools.peers import side_by_side as peers

TINY = ["dataset.width=80", "dataset.height=60", "dataset.length=5"]
OWN = {
    "ms": {"p50": 20.0, "p95": 30.0}, "arrival_ms": {"p50": 25.0, "p95": 35.0}, "cpu_ms": 40.0, "threads": 2, "peak_memory_mb": 300.0,
    "first_pose_s": 2.5, "tracked_share": 1.0, "ate_rmse_m": 0.0012, "causal_ate_rmse_m": 0.00234,
}  # fmt: skip
PEER = {**OWN, "ms": {"p50": 15.0, "p95": 16.0}, "tracked_share": 0.75, "ate_rmse_m": None, "load_s": 4.0, "version": "0.1.1", "threads": 5}
STAND_IN = """
import enum, os, signal, time
import numpy as np

Sensor = enum.Enum("Sensor", "MONOCULAR RGBD")
fault = os.environ.get("STAND_IN", "")


def vocabulary_path(download=True):
    assert not download
    if not os.path.isfile(os.environ["PYORBSLAM3_VOCAB"]):
        raise FileNotFoundError("none")
    return os.environ["PYORBSLAM3_VOCAB"]


class Result:
    def __init__(self, ok, pose):
        self.ok, self.pose_valid, self.pose_wc = ok, True, pose


class Slam:
    def __init__(self, vocab_file, settings_file, sensor, use_viewer=False):
        assert sensor is Sensor.RGBD and not use_viewer and os.path.isfile(vocab_file)
        assert "Camera.width: 80" in open(settings_file).read()
        print("ORB-SLAM3 prints much")
        self.poses, self.lines = np.load(os.environ["STAND_IN_POSES"]), []
        if fault == "leaves":
            raise SystemExit("no such\\x1b[31m vocabulary")

    def track_rgbd(self, image, depth, timestamp):
        assert image.shape == (60, 80, 3) and image.dtype == np.uint8 and depth.dtype == np.float32 and depth.shape == (60, 80)
        number = len(self.lines)
        pose = self.poses[number].copy()
        self.lines.append(f"{timestamp:.6f} {pose[0, 3]} {pose[1, 3]} {pose[2, 3]} 0 0 0 1\\n")
        if fault == "crashes" and number == 3:
            os.kill(os.getpid(), signal.SIGSEGV)
        if fault == "hangs" and number == 3:
            time.sleep(60)
        if fault == "turns":
            pose[:3, :3] *= 2
        pose[0, 3] += 0.01 * (number == 2)
        return Result(number > 0 and fault != "never", pose)

    def shutdown(self):
        pass

    def save_trajectory_tum(self, filename):
        open(filename, "w").writelines([*self.lines, self.lines[-1]])
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that has frames and ground truth in its recording, and no poses."""
    folder = tmp_path_factory.mktemp("runs") / "ours"
    assert main(["run", *TINY, "outputs=[normals]", f"out={folder}"]) == 0
    return folder


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A vocabulary for the stand-in, which is on the path of Python from now on."""
    (tmp_path / "pyorbslam3.py").write_text(STAND_IN)
    (tmp_path / "ORBvoc.txt").write_text("10 6 0 0\n")
    np.save(tmp_path / "poses.npy", dataset_of(TINY).truth().poses)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("STAND_IN_POSES", str(tmp_path / "poses.npy"))
    monkeypatch.setenv("PYORBSLAM3_VOCAB", str(tmp_path / "none.txt"))
    return tmp_path / "ORBvoc.txt"


def figures_of(run: Path, vocabulary: Path) -> dict[str, Any]:
    peer = peers.find_peer(sys.executable, vocabulary)
    return peers.peer_figures(peer, peers.write_job(dataset_of(TINY), peer, vocabulary.parent / "job"), run)


def test_both_trajectories_of_the_peer_are_judged_by_our_ground_truth(run: Path, stand_in: Path) -> None:
    """It is lost at the first frame, errs by 1 cm at another until the end, and repeats the last pose in its file."""
    found = figures_of(run, stand_in)
    assert "failed" not in found, found
    assert found["tracked_share"] == 0.8 and found["version"] == "of unknown version"
    assert found["ate_rmse_m"] == pytest.approx(0.0, abs=1e-5) and 0.002 < found["causal_ate_rmse_m"] < 0.005
    assert 0.0 < found["ms"]["p50"] <= found["ms"]["p95"] and found["ms"]["p50"] <= found["arrival_ms"]["p50"]
    assert found["threads"] >= 1 and found["peak_memory_mb"] > 10.0 and found["first_pose_s"] > found["load_s"] >= 0.0


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("crashes", "was ended by SIGSEGV, after 3 of 5 frames"),
        ("hangs", "did not end within 3 s, after 3 of 5 frames"),
        ("leaves", "ended with exit code 1 (no such?[31m vocabulary), after 0 of 5 frames"),
        ("turns", "left no results that can be read (a pose is none)"),
    ],
)
def test_a_peer_that_fails_is_a_line_under_the_table(fault: str, said: str, run: Path, stand_in: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STAND_IN", fault)
    if fault == "hangs":
        monkeypatch.setattr(peers, "LIMIT_S", 3.0)
        monkeypatch.setattr(peers, "LIMIT_FRAME_S", 0.0)
    found = figures_of(run, stand_in)
    assert found == {"failed": said}
    printed = peers.side_by_side(OWN, found, 10.0).splitlines()
    assert printed[1].split() == ["frame", "in", "memory", "to", "pose,", "p50", "ms", "20.0", "-", "10.0"]
    assert printed[-1] == f"ORB-SLAM3: {said}"


def test_a_peer_that_never_tracks_has_times_and_no_error(run: Path, stand_in: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STAND_IN", "never")
    found = figures_of(run, stand_in)
    assert (found["tracked_share"], found["ate_rmse_m"], found["first_pose_s"]) == (0.0, None, None)
    assert peers.side_by_side(OWN, found, 10.0).splitlines()[11].split() == ["start", "to", "first", "pose,", "s", "2.5", "-", "-"]


def test_the_table_has_both_systems_and_the_reference() -> None:
    assert peers.side_by_side(OWN, PEER, 10.0).splitlines() == [
        "                                         Trihedron  ORB-SLAM3  reference",
        "frame in memory to pose, p50 ms               20.0       15.0       10.0",
        "frame in memory to pose, p95 ms               30.0       16.0          -",
        "that p50 as x reference                       2.00       1.50       1.00",
        "frame due to pose, with reading, p50 ms       25.0       25.0          -",
        "frame due to pose, with reading, p95 ms       35.0       35.0          -",
        "CPU, ms a frame                               40.0       40.0          -",
        "peak memory, MB                                300        300          -",
        "ATE of the final trajectory, mm               1.20          -          -",
        "ATE of the poses as tracked, mm               2.34       2.34          -",
        "tracked, %                                   100.0       75.0          -",
        "start to first pose, s                         2.5        2.5          -",
        "ORB-SLAM3: pyorbslam3 0.1.1, 5 threads, 4.0 s to load the vocabulary",
        "at the camera's rate, but for the first rows of Trihedron; its CPU and memory are with reading and recording, those of ORB-SLAM3 without",
    ]


def test_the_command_prints_the_table_and_writes_it(tmp_path: Path, stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["benchmark", *TINY, "outputs=[normals]", "record.topics=[]", "--peers", "--vocabulary", str(stand_in)]
    assert main([*words, "--json", str(tmp_path / "figures.json")]) == 0
    figures = json.loads((tmp_path / "figures.json").read_text())
    own, other = figures["peers"]["trihedron"], figures["peers"]["orbslam3"]
    assert peers.side_by_side(own, other, figures["reference_ms"]) in capsys.readouterr().out
    assert own["ms"]["p50"] == figures["frame_ms"]["p50"] and own["arrival_ms"]["p50"] == figures["paced"]["p50"]
    assert set(own) <= set(other) and other["tracked_share"] == 0.8 and len(figures["reference_each_ms"]) == 4


@pytest.mark.slow
def test_errors_and_share_tracked_of_our_run_stand_in_the_table(tmp_path: Path, stand_in: Path) -> None:
    assert main(["benchmark", *TINY, "--peers", "--vocabulary", str(stand_in), "--json", str(tmp_path / "figures.json")]) == 0
    figures = json.loads((tmp_path / "figures.json").read_text())
    own, metrics = figures["peers"]["trihedron"], figures["metrics"]
    assert own["tracked_share"] == 1.0 - metrics["status"]["lost"] / 5
    assert (own["ate_rmse_m"], own["causal_ate_rmse_m"]) == (metrics["final"]["ate_rmse_m"], metrics["causal"]["ate_rmse_m"])
    assert own["first_pose_s"] > 0.1 and 0.0 < own["cpu_ms"] < 1e3 * figures["cpu_s"] / 5


MISSING_PACKAGE = (
    f"trihedron: benchmark --peers: pyorbslam3 is not installed in {sys.executable}; pip install pyorbslam3 (GPL-3; Linux, Python 3.9 to 3.13) "
    "in an environment of its own, and give --peer-python ITS_PYTHON"
)
MISSING_VOCABULARY = (
    "trihedron: benchmark --peers: {cause}; unpack Vocabulary/ORBvoc.txt.tar.gz of https://github.com/UZ-SLAMLab/ORB_SLAM3, "
    "and give --vocabulary ORBvoc.txt"
)


def mistake(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["benchmark", *TINY, *words]) == 2
    return capsys.readouterr().err.strip()


def test_a_missing_package_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert mistake(["--peers"], capsys) == MISSING_PACKAGE


def test_a_package_that_does_not_load_says_why(stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stand_in.with_name("pyorbslam3.py").write_text('raise ImportError("libGLX.so.0: cannot open")')
    assert "pyorbslam3 does not load (libGLX.so.0: cannot open) in " in mistake(["--peers"], capsys)


def test_a_missing_vocabulary_is_one_line(stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mistake(["--peers"], capsys) == MISSING_VOCABULARY.format(cause="ORB-SLAM3 needs a vocabulary, and its cache has none")
    said = mistake(["--peers", "--vocabulary", "/nowhere.txt"], capsys)
    assert said == MISSING_VOCABULARY.format(cause="there is no vocabulary at /nowhere.txt")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--vocabulary", "x"], "trihedron: benchmark: --vocabulary is of --peers; give --peers too"),
        (
            ["--peers", "--peer-python", "/nowhere"],
            "trihedron: --peer-python: /nowhere cannot be started (No such file or directory); give the path of a Python interpreter",
        ),
        (
            ["--peers", "--peer-python", "/bin/true"],
            "trihedron: --peer-python: /bin/true does not say what it has; give the path of a Python interpreter, 3.9 or newer",
        ),
    ],
)
def test_other_mistakes_are_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mistake(words, capsys) == said


def test_frames_that_cannot_be_written_are_one_line(stand_in: Path) -> None:
    peer = peers.find_peer(sys.executable, stand_in)
    with pytest.raises(DataError) as caught:
        peers.write_job(dataset_of(TINY), peer, stand_in / "below a file")
    assert str(caught.value) == (
        f"{stand_in / 'below a file'}: frames cannot be written (Not a directory); "
        "make room there (2 MB a frame), set TMPDIR, or take fewer frames: dataset.frames=0:150"
    )
