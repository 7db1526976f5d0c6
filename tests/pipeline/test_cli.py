"""The command line: every mistake is one line with place, cause and cure, and the exit code is 1, or 2 for usage."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import EntryPoint, version
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app import execute
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app.trajectory_plot import trajectory_figure
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.tools.benchmark import PROGRAM

SMALL = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=12"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def refused(capsys, *words, code=1):
    """The one line that `trihedron run SMALL words` prints."""
    assert main(["run", *SMALL, *words]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


PATHS = "give a folder, a .mcap, .bag or .r3d file, or key=value (quote lists: 'only=[pose]')"
SEE = "see trihedron plugins"
MISTAKES = [
    (["threads=abc"], 1, "trihedron: threads: 'abc' is not a whole number (default 2); see trihedron run --help"),
    (["threads=0"], 1, "trihedron: threads: 0 is not a number of threads; give 1 to 256"),
    (["threds=1"], 1, "trihedron: threds: there is no such key; did you mean 'threads'?"),
    (["keypoints=orbs"], 1, "trihedron: keypoints: there is no plugin 'orbs' for the slot 'keypoints'; did you mean 'orb'?"),
    (["keypoints.featurs=3"], 1, "trihedron: keypoints.featurs: the chosen plugin has no option 'featurs'; did you mean 'features'?"),
    (["graph=structurel"], 1, "trihedron: graph: there is no graph 'structurel'; did you mean 'structural'?"),
    (["graph.planes.normals=normal"], 1, "trihedron: graph.planes.normals: no stage writes topic 'normal'; did you mean 'normals'?"),
    (
        ["graph.planes.normals=planes@prev"], 1,
        "trihedron: graph.planes.normals: topic 'planes' is Planes, the input takes Normals; wire it to normals",
    ),
    (
        ["~graph.planes.normals"], 1,
        "trihedron: graph.planes.normals: the input is not wired, and ConnectedComponents takes it; give graph.planes.normals=TOPIC",
    ),
    (
        ["graph.planes.normals=normals@prev"], 1,
        "trihedron: graph.planes.normals: 'normals@prev' is None at first, and the input cannot be None; "
        "wire it to 'normals', or take the input as optional",
    ),
    (
        ["graph.pose.previous=pose"], 1,
        "trihedron: graph: pose -> pose need each other within one frame; put @prev on one of these wires",
    ),
    (["+graph.planes.foo=dataset"], 1, "trihedron: graph.planes.foo: the slot 'planes' has no input 'foo'; known: frame, normals"),
    (["outputs=[trajektory]"], 1, "trihedron: outputs: no stage writes 'trajektory'; did you mean 'trajectory'?"),
    (["outputs=[]"], 1, "trihedron: outputs: is empty, so nothing would run; give 'outputs=[trajectory]'"),
    (["dataset.frames=9:3"], 1, f"trihedron: dataset.frames: '9:3' is not a range of frames A:B[:S] with A < B, S > 0; {SEE} dataset synthetic"),
    (["dataset=tums"], 1, "trihedron: dataset: there is no plugin 'tums' for the slot 'dataset'; did you mean 'tum'?"),
    (["only=[pose]"], 1, "trihedron: only: chooses stages of a replay, and there is none; give replay=FILE.mcap too"),
    (["replay=no.mcap"], 1, "trihedron: no.mcap: cannot be read: No such file or directory; give the path of an MCAP file"),
    (["record.topics=[normal]"], 1, "trihedron: record.topics: no stage writes 'normal'; did you mean 'normals'?"),
    (["feedback=old"], 1, "trihedron: feedback: 'old' is not one of new, recorded (default new); see trihedron run --help"),
    (["out=/proc/no"], 1, "trihedron: out: the folder cannot be made: No such file or directory: /proc/no; give another out=FOLDER"),
    (["/no/pose"], 2, f"trihedron: /no/pose: is not key=value, and there is no such path; {PATHS}"),
    (["-x"], 2, "trihedron: -x: is not an option of run; known: -m, --multirun, --dry-run; everything else is key=value"),
]  # fmt: skip


@pytest.mark.parametrize("words, code, line", MISTAKES, ids=lambda value: "_".join(value) if isinstance(value, list) else "")
def test_mistakes(capsys, words, code, line):
    assert refused(capsys, *words, code=code) == line


@pytest.mark.parametrize("words, line", [
    (["dataset=tum"], "trihedron: dataset.path: is not set; give dataset.path=FOLDER"),
    (["dataset=tum", "dataset.path=no"], "trihedron: no: does not exist; give an existing folder as dataset.path"),
    (["dataset=mcap"], "trihedron: dataset.path: is not set; give dataset.path=FILE.mcap, FILE.bag or the folder of a rosbag2"),
])  # fmt: skip
def test_missing_data(capsys, words, line):
    assert main(["run", *words]) == 1
    assert capsys.readouterr().err.strip() == line


def test_unknown_command_and_help(capsys):
    assert main(["rum"]) == 2
    assert capsys.readouterr().err.strip() == "trihedron: rum: there is no such command; did you mean 'run'?"
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for command in ("run", "evaluate", "plugins", "topics", "convert", "benchmark"):
        assert f"\n  {command} " in text
    assert text.count("Example: trihedron ") >= 6
    assert main(["run", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    graphs = {file.stem for file in (Path(__file__).parents[2] / "conf" / "graph").glob("*.yaml")}
    listed = text.partition("graph=NAME ")[2].partition(" without=")[0].replace(" (default)", "").split(", ")
    assert set(listed) == graphs and "synthetic (default), " in text and ", tum " in text and "replay=FILE.mcap 'only=[STAGE]'" in text
    for group, word in (("without", "without=PART"), ("experiment", "experiment=NAME (with -m)")):
        names = sorted(file.stem for file in (Path(__file__).parents[2] / "conf" / group).glob("*.yaml"))
        assert f"{word} {', '.join(names)} " in text
    assert main(["--version"]) == 0 and capsys.readouterr().out.strip() == f"trihedron {version('trihedron')}"


def test_a_command_that_cannot_be_loaded_does_not_take_the_help_with_it(capsys, monkeypatch):
    broken = EntryPoint("weave", "no_such_package.weave:main", "trihedron.commands")
    monkeypatch.setattr("trihedron.pipeline.app.cli.entry_points", lambda group: [broken])
    assert main(["--help"]) == 0
    assert "  weave        cannot be loaded: No module named 'no_such_package'" in capsys.readouterr().out


def test_a_folder_alone_is_a_data_set(capsys, tmp_path):
    """Known by its files; what is neither a path nor key=value stays a mistake."""
    (tmp_path / "desk").mkdir()
    for name in ("rgb.txt", "depth.txt"):
        (tmp_path / "desk" / name).write_text("# none\n")
    assert main(["run", str(tmp_path / "desk")]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[0] == f"dataset=tum dataset.path={tmp_path}/desk" and said[1].startswith(f"trihedron: {tmp_path}/desk")
    assert not (tmp_path / "runs").exists()


def test_a_replay_says_what_it_computed_and_is_not_the_latest_run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", *SMALL, "out=runs/first"]) == 0
    capsys.readouterr()
    assert main(["run", "replay=runs/first/run.mcap", "only=[manhattan]", "out=runs/second"]) == 0
    count = len(list(Recording(tmp_path / "runs" / "second" / "run.mcap").values("frames")))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "not in runs/first/run.mcap, computed again: dataset, normals"
    assert lines[1].startswith("computed: dataset (") and lines[1].endswith(f"manhattan ({count} calls); the rest is read from runs/first/run.mcap")
    assert (tmp_path / "runs" / "latest").resolve() == tmp_path / "runs" / "first"
    for word in ("planes=cape", "planes.angle_deg=3", "graph.planes.normals=normals"):
        assert main(["run", "replay=runs/first/run.mcap", "only=[manhattan]", word, "out=runs/third"]) == 1
        key, cure = word.partition("=")[0], "add it to the stages: 'only=[manhattan,planes]'"
        assert capsys.readouterr().err == f"trihedron: {key}: planes is read from the recording, so this changes nothing; {cure}\n"
    assert not (tmp_path / "runs" / "third").exists()


@pytest.mark.parametrize("word", ["manhattan.cone_deg=99", "threads=0", "record.topics=[normal]", "dataset=tum"])
def test_a_refused_option_leaves_no_folder(capsys, tmp_path, word):
    assert main(["run", *SMALL, word, f"out={tmp_path}/new/run"]) == 1
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback():
    with pytest.raises(Exception, match="there is no such key"):
        main(["run", *SMALL, "threds=1", "--debug"])


def test_a_run_folder_is_complete(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(execute, "trajectory_figure", trajectory_figure)
    assert main(["run", *SMALL]) == 0
    printed = capsys.readouterr().out
    out = (tmp_path / "runs" / "latest").resolve()
    expected = {"trajectory.txt", "trajectory_causal.txt", "run.mcap", "timing.json", "metrics.json", "trajectory.png", ".hydra"}
    assert {p.name for p in out.iterdir()} == expected and cv2.imread(str(out / "trajectory.png")).std() > 10.0
    assert all(str(out / name) in printed for name in expected - {".hydra"})
    timing, metrics = json.loads((out / "timing.json").read_text()), json.loads((out / "metrics.json").read_text())
    assert timing["frames"] == 12 == metrics["frames"] and timing["threads"] == 2
    assert set(timing) == {"frames", "threads", "wall_s", "startup_s", "cpu_s", "fps", "frame_ms", "peak_memory_mb", "own_memory_mb", "stages"}
    assert metrics["final"]["tracked_share"] == 1.0 and len(read_trajectory(out / "trajectory.txt")) == 12
    recording = Recording(out / "run.mcap")
    assert recording.metadata["version"] == version("trihedron") and set(SMALL) <= set(recording.overrides())
    assert {"/view/pose", "/view/camera", "/view/image", "/view/planes", "/view/lines", "/view/map_points", "/tf"} <= set(recording.channels)
    assert recording.channels["/view/pose"].message_encoding == "protobuf"


def test_one_pose_has_no_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(execute, "trajectory_figure", trajectory_figure)
    assert main(["run", "dataset.length=1", "dataset.width=160", "dataset.height=120", f"out={tmp_path}"]) == 0
    assert (tmp_path / "trajectory.txt").exists() and not (tmp_path / "trajectory.png").exists()


@pytest.mark.slow
def test_a_replay_finds_the_data_from_another_folder(tmp_path, monkeypatch):
    assert main(["run", *SMALL, "record.frames=true", "out=embedded"]) == 0
    assert main(["run", "dataset=mcap", "dataset.path=embedded/run.mcap", "out=again"]) == 0
    assert (tmp_path / "again" / "trajectory.txt").read_bytes() == (tmp_path / "embedded" / "trajectory.txt").read_bytes()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["run", "replay=../again/run.mcap", "only=[keypoints]", "out=replayed"]) == 0
    expected = list(Recording("../again/run.mcap").messages("/keypoints"))
    assert list(Recording("replayed/run.mcap").messages("/keypoints")) == expected


@pytest.mark.parametrize("value", ["true", "foxglove"])
def test_frames_are_embedded_in_foxgloves_schemas(value, tmp_path):
    words = ["dataset.length=2", "dataset.width=160", "dataset.height=120", f"record.frames={value}", f"out={tmp_path}"]
    assert main(["run", *words]) == 0
    with (tmp_path / "run.mcap").open("rb") as file:
        schemas = {channel.topic: schema.name for schema, channel, _ in make_reader(file).iter_messages()}
    assert {schemas[topic] for topic in schemas if topic.startswith("/dataset")} == {"foxglove.CompressedImage", "foxglove.RawImage"}
    assert (tmp_path / ".hydra/config.yaml").read_text().count("frames: true") == 1


def test_unreadable_frames_are_skipped_and_summarised(capsys, tmp_path):
    def sequence(folder, damaged):
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)
        (folder / "camera.yaml").write_text("{width: 160, height: 120, fx: 130, fy: 130, cx: 79.5, cy: 59.5, depth_scale: 5000}")
        frames = Synthetic(width=160, height=120, length=24)
        for i in range(24):
            frame = frames(i)
            cv2.imwrite(str(folder / "rgb" / f"{i}.png"), frame.color[..., ::-1])
            cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.rint(frame.depth_m * 5000).astype(np.uint16))
        for i in damaged:
            path = folder / "depth" / f"{i}.png"
            path.write_bytes(path.read_bytes()[:500])
        return [f"dataset.path={folder}", f"out={folder}/run"]

    assert main(["run", "dataset=folder", *sequence(tmp_path / "a", (7, 12))]) == 0
    first = f"{tmp_path}/a/depth/7.png: is truncated; frame 7 is skipped"
    said = [line for line in capsys.readouterr().err.splitlines() if first in line]  # other lines are about kernels that are compiled
    assert said == [f"trihedron: warning: {first}", f"trihedron: 2 such warnings, the first: {first}"]
    metrics = json.loads((tmp_path / "a" / "run" / "timing.json").read_text())
    assert metrics["frames"] == 22 and len(read_trajectory(tmp_path / "a" / "run" / "trajectory.txt")) == 22
    assert main(["run", "dataset=folder", *sequence(tmp_path / "b", (7, 12, 15))]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        "trihedron: dataset: 3 of 24 frames cannot be read; see the warnings above for the first file; the data set is damaged"
    )


@pytest.mark.slow
def test_a_sweep_goes_on_after_a_job_that_fails(capsys, tmp_path):
    words = ["run", "-m", *SMALL, "dataset.frames=0:3,9:3,0:4", "out=sweep"]
    assert main(words) == 1
    assert "trihedron: job 1: dataset.frames: '9:3' is not a range" in capsys.readouterr().err
    lengths = [json.loads((tmp_path / "sweep" / job / "timing.json").read_text())["frames"] for job in ("0", "2")]
    assert lengths == [3, 4]


def started(folder, *words, environment=None):
    """A run in a process of its own that listens to Ctrl-C (a shell's background jobs are born deaf to it)."""
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{listen}; import sys; from trihedron.pipeline.app.cli import main; sys.exit(main({['run', *words]!r}))"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], cwd=folder, env={**os.environ, **(environment or {})}, **pipes)


def wait_for(recording, size=500_000):
    for _ in range(1200):
        if recording.exists() and recording.stat().st_size > size:
            return
        time.sleep(0.1)


LONG = ["dataset=synthetic", "dataset.length=2000", "dataset.width=160", "dataset.height=120"]


@pytest.mark.parametrize(
    "number, code", [(signal.SIGINT, 130), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((signal.SIGTERM, 143), (signal.SIGHUP, 129)))]
)
def test_a_signal_leaves_a_recording_and_a_trajectory(tmp_path, number, code):
    before = signal.signal(number, signal.SIG_DFL)  # a child ignores what its parent ignores, as under nohup
    process = started(tmp_path, *LONG, "out=cut")
    signal.signal(number, before)
    recording = tmp_path / "cut" / "run.mcap"
    wait_for(recording, 2_500_000)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    poses = list(Recording(recording).values("pose"))
    line = f"trihedron: interrupted; frames done: {len(poses)}, kept in {tmp_path}/cut"
    assert process.returncode == code and errors.strip().splitlines()[-1] == line
    written = len(read_trajectory(tmp_path / "cut" / "trajectory.txt"))
    assert 30 <= len(poses) < 2000 and written == len(poses)
    assert (tmp_path / "cut" / "timing.json").exists()
    assert json.loads((tmp_path / "cut" / "metrics.json").read_text())["frames"] == len(poses)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@pytest.mark.parametrize("is_new", [True, False])
def test_a_signal_before_the_first_frame_leaves_no_empty_folder(tmp_path, capsys, monkeypatch, number, code, is_new):
    """The signal comes while the recording is being opened. A folder that was there before is kept as it was."""
    attach, out = RecordingWriter.attach, tmp_path / "early"
    if not is_new:
        out.mkdir()

    def interrupted(writer, name, text):
        attach(writer, name, text)
        signal.raise_signal(number)

    before = signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    monkeypatch.setattr(RecordingWriter, "attach", interrupted)
    try:
        assert main(["run", *SMALL, "out=early"]) == code
    finally:
        signal.signal(number, before)
    left = f"nothing was computed, and {out} is removed" if is_new else f"nothing was computed; {out} was there before and is kept"
    assert capsys.readouterr().err.splitlines()[-1] == f"trihedron: interrupted; {left}"
    assert out.exists() != is_new
    if not is_new:
        assert not list(out.iterdir())


@pytest.mark.parametrize("mistake", ["library", "first image"])
def test_a_data_set_that_cannot_be_opened_leaves_nothing(tmp_path, capsys, monkeypatch, mistake):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)  # not installed
    words, place = ["dataset=realsense"], "pyrealsense2: is not installed"
    if mistake == "first image":
        words, place = [str(tmp_path / "images")], "the data set is damaged"
        for folder in ("rgb", "depth"):
            (tmp_path / "images" / folder).mkdir(parents=True)
            (tmp_path / "images" / folder / "0.png").write_text("no image")
        (tmp_path / "images" / "camera.yaml").write_text("{width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, depth_scale: 1000}")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    for out in ("runs/walk", "old"):
        assert main(["run", *words, f"out={out}"]) == 1
        assert place in capsys.readouterr().err.splitlines()[-1]
        assert sorted(tmp_path.rglob("*")) == before


def test_a_signal_while_kernels_are_compiled_says_that_nothing_was_computed(tmp_path, capsys, monkeypatch):
    def interrupted(stages, frames):
        raise KeyboardInterrupt

    monkeypatch.setattr("trihedron.pipeline.app.execute.compile_once", interrupted)
    assert main(["run", *SMALL, "out=early"]) == 130
    assert capsys.readouterr().err == f"trihedron: interrupted; nothing was computed, and {tmp_path}/early is removed\n"
    assert not (tmp_path / "early").exists()


@pytest.mark.parametrize("before", ["", "runs", "another run"])
def test_a_signal_before_the_first_frame_removes_what_the_run_made_and_nothing_else(tmp_path, monkeypatch, before):
    """Without `out` the folder is runs/<date>/<time>."""

    def interrupted(stages, frames):
        [folder] = (tmp_path / "runs").glob("*/*")
        if before == "another run":  # of the same day, begun in the meantime
            (folder.parent / "other").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("trihedron.pipeline.app.execute.compile_once", interrupted)
    if before == "runs":
        (tmp_path / "runs").mkdir()
    assert main(["run", *SMALL]) == 130
    left = [path.name for path in sorted(tmp_path.rglob("*"))]
    assert left[:1] == (["runs"] if before else []) and left[2:] == (["other"] if before == "another run" else [])
    assert len(left) == {"": 0, "runs": 1, "another run": 3}[before]


@pytest.mark.slow
def test_a_folder_in_use_is_left_as_it_is(tmp_path, capsys):
    process = started(tmp_path, *LONG, "out=used")
    wait_for(tmp_path / "used" / "run.mcap")
    before = (tmp_path / "used" / ".hydra" / "config.yaml").read_bytes()
    line = refused(capsys, "out=used", "dataset.seed=9")
    assert line == f"trihedron: {tmp_path}/used: is being written by another process; wait until that has ended, or give another out=FOLDER"
    assert (tmp_path / "used" / ".hydra" / "config.yaml").read_bytes() == before
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    assert main(["run", *SMALL, "dataset.frames=0:2", "outputs=[keypoints]", "out=used"]) == 0  # the lock ends with the process


def test_a_full_device_is_no_traceback(tmp_path):
    words = [*PROGRAM, "run", *SMALL, "dataset.frames=0:2", "outputs=[keypoints]", "out=full"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    line = "trihedron: standard output: cannot be used: No space left on device; make room, or give another place\n"
    assert (done.returncode, done.stderr) == (1, line)


def test_a_place_where_no_file_can_be_has_its_cure(tmp_path, capsys):
    assert main(["run", *SMALL, "dataset.frames=0:2", "out=made"]) == 0
    capsys.readouterr()
    assert main(["report", "made", "--out", "nowhere/page.html"]) == 1
    missing = "cannot be used: No such file or directory; make its folder first, or give another place"
    assert capsys.readouterr().err == f"trihedron: nowhere/page.html: {missing}\n"
    assert main(["compare", "made", "--json", "made"]) == 1
    assert capsys.readouterr().err == "trihedron: made: cannot be used: Is a directory; give the name of a file in it\n"


@pytest.mark.slow
def test_an_ascii_terminal_is_no_traceback():
    for words in (["plugins"], ["run", "--help"], ["run", "dataset.width=-5"]):
        done = subprocess.run([*PROGRAM, *words], capture_output=True, text=True, env={**os.environ, "PYTHONIOENCODING": "ascii"})
        assert "Traceback" not in done.stderr and done.returncode == (1 if words[-1].startswith("dataset") else 0)


@pytest.mark.slow
def test_closed_streams_are_no_traceback(tmp_path):
    """As a service manager may start it; a file of the run that took the number of standard error would hold what libraries print."""
    close = "import os, sys; [os.close(number) for number in (0, 1, 2)]; sys.stdin = sys.stdout = sys.stderr = None"
    code = f"{close}; from trihedron.pipeline.app.cli import main; os._exit(main({['run', *SMALL, 'dataset.frames=0:2', 'out=closed']!r}))"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0
    assert len(list(Recording(tmp_path / "closed" / "run.mcap").values("keypoints"))) == 2


@pytest.mark.parametrize("megabytes", [200, 1000])
def test_too_little_address_space_is_refused_before_any_library_is_imported(megabytes):
    """OpenCV's library ends in a segmentation fault where its memory runs out while it is loaded."""
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({megabytes} << 20,) * 2)\n"
        f"import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', 'dataset.length=3', 'out=little']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    cause = f"{megabytes} MB of address space are too few: the libraries alone take 1024 MB"
    assert (done.returncode, done.stderr) == (1, f"trihedron: memory: {cause}; raise the limit: ulimit -v 2097152, or none\n")


@pytest.mark.slow
@pytest.mark.parametrize("megabytes", [1100, 1500])
def test_memory_that_runs_out_is_one_line(tmp_path, megabytes):
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({megabytes} << 20,) * 2)\n"
        f"import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', 'dataset.length=3', 'out=little']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    assert "Traceback" not in done.stderr, done.stderr[-1000:]
    if done.returncode and "LLVM ERROR" not in done.stderr:  # the compiler ends the process itself
        assert done.stderr.strip().splitlines()[-1].startswith("trihedron: "), done.stderr[-1000:]


NAMES = ["with blanks", "it's", 'a "quoted" name', "[brackets] (and) {braces}", "a,b", "a=b", "#1", "größe", "日本", "${HOME}"]
NAMES += ["back\\slash", "a: b", "null"]


ALL_AT_ONCE = 'it\'s "quoted" [brackets] (and) {braces}, a=b #1 größe 日本 ${HOME} back\\slash a: b'


@pytest.mark.parametrize("name", [ALL_AT_ONCE, *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES)])
def test_any_path_works(tmp_path, name):
    """Of a data set, a recording, a map and a run folder."""
    folder = tmp_path / name
    folder.mkdir()
    small = ["dataset.width=64", "dataset.height=48", "dataset.length=4"]
    assert main(["run", *small, "record.frames=true", f"out={name}/run", f"save_map={name}/map.mcap"]) == 0
    assert main(["run", f"replay={name}/run/run.mcap", "only=[keypoints]", f"out={name}/again"]) == 0
    again = ["dataset=mcap", f"dataset.path={name}/run/run.mcap", f"load_map={folder}/map.mcap", f"out={name}/on", "outputs=[pose]"]
    assert main(["run", *again]) == 0
    (tmp_path / "elsewhere").mkdir()
    os.chdir(tmp_path / "elsewhere")
    assert main(["run", f"replay={folder}/on/run.mcap", "only=[keypoints]", "out=x"]) == 0  # its own paths were relative
    metadata = yaml.safe_load(Recording("x/run.mcap").metadata["config"])
    assert (metadata["dataset"]["path"], metadata["load_map"]) == (str(folder / "run" / "run.mcap"), str(folder / "map.mcap"))


def readme_block(language, file):
    """The fenced block of the tutorial whose title names its file."""
    text = (Path(__file__).parents[2] / "docs" / "tutorial" / "write-a-plugin.md").read_text()
    return text.split(f'```{language} title="corners/{file}"\n')[1].split("```")[0]


@pytest.mark.slow
def test_the_plugin_package_of_the_readme_is_one_word_away(tmp_path):
    package = tmp_path / "corners"
    package.mkdir()
    (package / "trihedron_corners.py").write_text(readme_block("python", "trihedron_corners.py"))
    (package / "pyproject.toml").write_text(readme_block("toml", "pyproject.toml"))
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(site), str(package)]
    subprocess.run(install, check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}

    def trihedron(*words):
        return subprocess.run([*PROGRAM, *words], env=environment, capture_output=True, text=True)

    done = trihedron("run", *SMALL, "keypoints=shi_tomasi", "keypoints.features=200", "out=corners_run")
    assert done.returncode == 0, done.stderr
    values = list(Recording("corners_run/run.mcap").values("keypoints"))
    assert len(values) == 12 and 20 < max(len(v.pixels) for v in values) <= 200
    (site / "trihedron_corners.py").write_text("import not_there")
    done = trihedron("run", *SMALL, "keypoints=shi_tomasi")
    error = "ModuleNotFoundError: No module named 'not_there'"
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(f"it may be in trihedron-corners (trihedron_corners), which does not load: {error}")


@pytest.mark.parametrize(
    "module",
    ["import not_there", "from trihedron import register\n\n\n@register('planes', 'mine')\nclass Mine: ..."],
    ids=["lacks a library", "is no plugin"],
)
def test_a_broken_plugin_package_disables_only_itself(tmp_path, module):
    """It breaks its slot's contract, or lacks a library: it is listed with its error, choosing it says why, and all else runs."""
    (tmp_path / "mine.py").write_text(module)
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[trihedron.plugins]\nmine = mine\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    if module == "import not_there":
        why = "ModuleNotFoundError: No module named 'not_there'"
    else:
        why = f"plugin planes=mine ({tmp_path / 'mine.py'}): is not a frozen dataclass; put @dataclass(frozen=True) under @register"

    def called(*command):
        return subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)

    done = called(*PROGRAM, "plugins")
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, f"broken: mine (mine) does not load: {why}")
    warning = f"trihedron: warning: plugin package mine (mine): does not load: {why}; it is left out until you mend or uninstall it"
    assert done.stderr.splitlines() == [warning]
    done = called(sys.executable, "-c", "import trihedron as th; print(th.planes.cape().name); th.planes.mine()")
    assert done.stdout == "cape\n"
    assert done.stderr.splitlines()[-1].endswith(f"it may be in mine (mine), which does not load: {why}")
    done = called(*PROGRAM, "run", *SMALL, "planes=mine")
    assert done.returncode == 1 and done.stderr.splitlines()[-1].endswith(f"it may be in mine (mine), which does not load: {why}")
    done = called(*PROGRAM, "plugins", "planes", "mine")
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith(f"it may be in mine (mine), which does not load: {why}")


@pytest.mark.parametrize(
    ("word", "code", "out", "error"),
    [
        ("--version", 0, f"trihedron {version('trihedron')}\n", ""),
        ("rnu", 2, "", "trihedron: rnu: there is no such command; did you mean 'run'?\n"),
    ],
)
def test_the_command_is_a_module_too(word, code, out, error):
    """For a shell that does not find the command on its path."""
    done = subprocess.run([*PROGRAM, word], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, out, error)
