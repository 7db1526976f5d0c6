"""`trihedron evaluate`: figures, bases of the share, and errors in one line."""

import json

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Camera, FrameReference, Trajectory
from trihedron.pipeline.record.trajectories import TRUTH, format_trajectory, write_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.metrics import evaluate_trajectory

PERIOD_NS = 33_333_333


def path(count: int = 60) -> Trajectory:
    """A gentle arc at 30 frames/s from stamp 100 s on."""
    poses = [exp_se3(np.array([0.0, 0.02 * i, 0.01 * i, 0.0, 0.002 * i, 0.0])) for i in range(count)]
    return Trajectory(100_000_000_000 + np.arange(count, dtype=np.int64) * PERIOD_NS, np.array(poses))


def noisy(trajectory: Trajectory) -> Trajectory:
    rng = np.random.default_rng(5)
    return Trajectory(trajectory.stamps_ns, np.array([pose @ exp_se3(rng.normal(0.0, 0.01, 6)) for pose in trajectory.poses]))


def part(trajectory: Trajectory, rows) -> Trajectory:
    return Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows])


@pytest.fixture
def files(tmp_path, monkeypatch):
    """estimate.txt, 40 noisy poses of the 60 of truth.txt."""
    monkeypatch.chdir(tmp_path)
    write_trajectory("estimate.txt", part(noisy(path()), np.arange(40)))
    write_trajectory("truth.txt", path())
    return tmp_path


def write_recording(file, stamps_ns, truth=None, fps=30.0):
    writer = RecordingWriter(file, {})
    if truth is not None:
        writer.attach(TRUTH, format_trajectory(truth))
    for index, stamp_ns in enumerate(stamps_ns):
        writer.write("frames", FrameReference(index, int(stamp_ns), Camera(640, 480, 525.0, 525.0, 320.0, 240.0, fps)))
    writer.close()


def figures(capsys, *words):
    assert main(["evaluate", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_json_holds_the_metrics(files, capsys):
    found = figures(capsys, "estimate.txt", "truth.txt")
    expected = evaluate_trajectory(part(noisy(path()), np.arange(40)), path()).to_dict()
    assert set(found) == set(expected)
    assert found["ate_rmse_m"] == pytest.approx(expected["ate_rmse_m"], abs=1e-8)
    assert found["rpe_second_rmse_deg"] == pytest.approx(expected["rpe_second_rmse_deg"], abs=1e-6)
    assert (found["rpe_second_frames"], found["rpe_second_pairs"], found["tracked_share"]) == (30, 10, 40 / 60)


def test_table(files, capsys):
    write_trajectory("estimate.txt", path())
    assert main(["evaluate", "estimate.txt", "truth.txt"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "                       rmse      mean    median       max  pairs",
        "ATE (m)            0.000000  0.000000  0.000000  0.000000     60",
        "RPE 1 frame (m)    0.000000            0.000000               59",
        "RPE 1 frame (°)    0.000000            0.000000               59",
        "RPE 30 frames (m)  0.000000            0.000000               30",
        "RPE 30 frames (°)  0.000000            0.000000               30",
        "tracked 60 of 60 frames of the whole ground truth (see --frames): 100.0%",
        "100.0% between the first pose and the last; 60 poses in all",
    ]


def test_frames_from_a_list(files, capsys):
    (files / "rgb.txt").write_text("# list\n" + "".join(f"{stamp / 1e9:.6f} rgb/{i}.png\n" for i, stamp in enumerate(path().stamps_ns[:50])))
    found = figures(capsys, "estimate.txt", "truth.txt", "--frames", "rgb.txt")
    assert (found["frames_with_truth"], found["tracked_share"], found["share_basis"]) == (50, 0.8, "frames")
    assert main(["evaluate", "estimate.txt", "truth.txt", "--frames", "rgb.txt"]) == 0
    assert "tracked 40 of 50 frames that have truth: 80.0%\n" in capsys.readouterr().out


def test_frames_and_frame_rate_from_the_recording_beside(files, capsys):
    write_recording(files / "run.mcap", path().stamps_ns[:45], fps=10.0)
    found = figures(capsys, "estimate.txt", "truth.txt")
    assert (found["frames_with_truth"], found["share_basis"], found["rpe_second_frames"]) == (45, "frames", 10)
    assert figures(capsys, "estimate.txt", "truth.txt", "--fps", "20")["rpe_second_frames"] == 20


def test_a_recording_of_another_run_beside_is_not_used(files, capsys):
    write_recording(files / "run.mcap", path().stamps_ns[:45] + 1_000_000)
    assert figures(capsys, "estimate.txt", "truth.txt")["share_basis"] == "ground truth"
    (files / "run.mcap").write_bytes(b"cut off")
    assert figures(capsys, "estimate.txt", "truth.txt")["share_basis"] == "ground truth"


def test_truth_with_y_up_is_noticed_and_mirrored(files, capsys):
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    # a turn about an axis across y: mirrored it goes the other way, 2 · |(0.02, 0, 0.01)| rad = 2.562° wrong
    turning = Trajectory(path().stamps_ns, np.array([exp_se3(np.array([0.02 * i, 0.01 * i, 0.0, 0.02 * i, 0.0, 0.01 * i])) for i in range(60)]))
    write_trajectory("turning.txt", turning)
    write_trajectory("up.txt", Trajectory(turning.stamps_ns, mirror @ turning.poses @ mirror))
    assert main(["evaluate", "turning.txt", "up.txt"]) == 0
    said = "up.txt: its turns fit better mirrored (0.000° instead of 2.562° between frames); is its y axis up? give --y-up"
    assert capsys.readouterr().err == f"trihedron: warning: {said}\n"
    assert figures(capsys, "turning.txt", "up.txt", "--y-up")["ate_max_m"] < 1e-6
    assert main(["evaluate", "turning.txt", "turning.txt"]) == 0
    assert capsys.readouterr().err == ""


def test_truth_out_of_a_recording(files, capsys):
    write_recording(files / "other.mcap", path().stamps_ns, truth=path())
    assert figures(capsys, "estimate.txt", "other.mcap") == figures(capsys, "estimate.txt", "truth.txt")


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["estimate.txt"], 2, "evaluate: the following arguments are required: TRUTH; see trihedron evaluate --help"),
        (["estimate.txt", "truth.txt", "--fps", "0"], 2, "evaluate: --fps 0 is not a frame rate; give a number above 0, for example --fps 30"),
        (["estimate.txt", "truth.txt", "--fps", "x"], 2, "evaluate: argument --fps: invalid float value: 'x'; see trihedron evaluate --help"),
        (
            ["estimate.txt", "truth.txt", "--max-difference-ms", "2000"], 2,
            "evaluate: --max-difference-ms 2000 is out of range; give a number above 0 and up to 1000",
        ),
        (["none.txt", "truth.txt"], 1, "none.txt: cannot be read (No such file or directory); check the path and its permissions"),
        (["bad.txt", "truth.txt"], 1, "bad.txt:1: the pose is not finite; each line holds 'stamp tx ty tz qx qy qz qw'; correct or remove this one"),
        (["estimate.txt", "late.txt"], 1, "estimate.txt: no overlap in time with late.txt: 100.000 to 101.300 s against 109.000 to 110.967 s; "
                                          "give files of the same clock"),
        (["two.txt", "truth.txt"], 1, "two.txt: has 2 poses; an evaluation needs at least 3"),
        (["estimate.txt", "plain.mcap"], 1, "plain.mcap: holds no ground truth; give the file of the ground truth"),
        (["estimate.txt", "truth.txt", "--frames", "words.txt"], 1,
         "words.txt: the time stamp 'first' is not a number of seconds; each line begins with the stamp of a frame"),
        (["estimate.txt", "truth.txt", "--frames", "few.txt"], 1,
         "few.txt: 39 of 40 poses have the stamp of no frame, the first is 100.033333 s; give the list of the frames that were tracked (rgb.txt)"),
    ],
)  # fmt: skip
def test_errors(files, capsys, words, code, line):
    (files / "bad.txt").write_text("100.0 0 0 nan 0 0 0 1\n")
    (files / "words.txt").write_text("first second\n")
    (files / "few.txt").write_text("100.0 rgb/0.png\n")
    write_trajectory("late.txt", Trajectory(path().stamps_ns + 9_000_000_000, path().poses))
    write_trajectory("two.txt", part(path(), [0, 1]))
    write_recording(files / "plain.mcap", path().stamps_ns)
    assert main(["evaluate", *words]) == code
    assert capsys.readouterr().err == f"trihedron: {line}\n"
