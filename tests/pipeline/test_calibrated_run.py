"""`calibrate=true`: the sequence is tracked twice, and the second time with the camera that the first shows."""

import cv2
import numpy as np
import pytest
import yaml

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app import calibrated_run
from trihedron.pipeline.app.calibrated_run import Recommendation
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.record.trajectories import write_trajectory

TOO_LONG = 1.08  # stated focal lengths, relative to the true ones


def write_folder(folder, frames, focal=1.0):
    """A TUM folder of the built-in room, whose camera file states `focal` times the true focal lengths; returns these."""
    room = Synthetic(width=320, height=240, length=frames, fps=10.0)
    lists = {"rgb": [], "depth": []}
    for kind in lists:
        (folder / kind).mkdir(parents=True)
    for k in range(frames):
        frame = room(k)
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), np.rint(5000.0 * frame.depth_m).astype(np.uint16))
        for kind, lines in lists.items():
            lines.append(f"{frame.stamp_ns / 1e9:.9f} {kind}/{k}.png\n")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("".join(lines))
    write_trajectory(folder / "groundtruth.txt", room.truth())
    camera = room(0).camera
    stated = {"fx": focal * camera.fx, "fy": focal * camera.fy, "cx": camera.cx, "cy": camera.cy, "width": 320, "height": 240, "depth_scale": 5000}
    stated |= {"readout_s": 0, "depth_readout_s": 0}
    (folder / "camera.yaml").write_text(yaml.safe_dump({key: float(value) for key, value in stated.items()}))
    return camera.fx


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    """A folder whose camera file is wrong, the true focal length, and the run with calibrate=true."""
    folder = tmp_path_factory.mktemp("wrong")
    true = write_folder(folder / "room", 60, TOO_LONG)
    return folder / "room", true, th.run("dataset=tum", dataset__path=folder / "room", calibrate=True, out=folder / "run", quiet=True)


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """A short folder whose camera file is right."""
    folder = tmp_path_factory.mktemp("right") / "room"
    write_folder(folder, 12)
    return folder


def read(path):
    return yaml.safe_load(path.read_text())


def test_a_wrong_focal_length_is_found_and_the_run_is_better(wrong):
    _, true, run = wrong
    before = th.Recording(run.folder / "uncalibrated")
    found = read(run.folder / "camera.yaml")
    errors = [read(folder / "metrics.json")["final"]["ate_rmse_m"] for folder in (run.folder / "uncalibrated", run.folder)]
    print(f"fx {found['fx']} of {true}, stated {TOO_LONG * true}; ATE {errors[0]:.4f} m, then {errors[1]:.4f} m")
    assert abs(found["fx"] - true) < 0.01 * true and found["fx"] == found["fy"]
    assert errors[1] < 0.25 * errors[0]
    assert run.metrics["status"]["ok"] == 60 > read(run.folder / "uncalibrated" / "metrics.json")["status"]["ok"]
    assert before.frames == run.recording.frames == tuple(range(60))


def test_the_two_passes_can_be_compared_reported_and_replayed(wrong, tmp_path, capsys):
    _, _, run = wrong
    assert main(["compare", str(run.folder / "uncalibrated"), str(run.folder)]) == 0
    assert [line.split()[:2] for line in capsys.readouterr().out.splitlines()[1:3]] == [["-", "1"], ["calibrate=true", "1"]]
    assert main(["report", str(run.folder), "--out", str(tmp_path / "report.html")]) == 0
    assert main(["run", f"replay={run.folder / 'run.mcap'}", "only=[pose]", f"out={tmp_path / 'again'}"]) == 0
    assert "calibrate: the" not in capsys.readouterr().out and not (tmp_path / "again" / "uncalibrated").exists()
    assert (tmp_path / "again" / "trajectory.txt").read_bytes() == (run.folder / "trajectory.txt").read_bytes()
    config = read(tmp_path / "again" / ".hydra" / "config.yaml")
    assert config["dataset"]["camera"] == str(run.folder / "camera.yaml") and config["calibrate"] is False


def test_an_ablation_repeats_the_camera_and_not_the_calibration(wrong, tmp_path):
    _, _, run = wrong
    ablation = run.recording.ablate("manhattan.cone_deg=8", out=tmp_path / "ablation")
    for (folder,) in ablation.folders.values():
        words = read(folder / ".hydra" / "overrides.yaml")
        assert f"dataset.camera={run.folder / 'camera.yaml'}" in words and not any(word.startswith("calibrate") for word in words)


def test_a_right_camera_stays_and_the_result_is_that_of_a_plain_run(right, tmp_path, capsys):
    words = ["run", "dataset=tum", f"dataset.path={right}"]
    assert main([*words, f"out={tmp_path / 'plain'}"]) == 0
    capsys.readouterr()
    (tmp_path / "run" / "uncalibrated" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / "camera.yaml").write_text("of an earlier run with calibrate=true")
    assert main([*words, "calibrate=true", f"out={tmp_path / 'run'}"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("calibrate: ")]
    first = f"calibrate: the stated camera is tracked first, into {tmp_path / 'run' / 'uncalibrated'}"
    assert lines == [first, "calibrate: no change recommended, the run has the stated camera"]
    assert not (tmp_path / "run" / "camera.yaml").exists()
    assert main(["diff", str(tmp_path / "plain"), str(tmp_path / "run")]) == 0
    assert (tmp_path / "plain" / "trajectory.txt").read_bytes() == (tmp_path / "run" / "trajectory.txt").read_bytes()


def test_jobs_of_sweeps_calibrate(right, tmp_path, monkeypatch):
    text = (right / "camera.yaml").read_text()
    monkeypatch.setattr(calibrated_run, "recommendation", lambda folder: Recommendation(text, ["a change"]))
    words = ["dataset=tum", f"dataset.path={right}", "calibrate=true,false", f"out={tmp_path}", "hydra/launcher=basic"]
    assert main(["run", "-m", *words]) == 0
    assert (tmp_path / "0" / "uncalibrated" / "run.mcap").exists() and (tmp_path / "0" / "camera.yaml").read_text() == text
    assert "calibrate: a change\n" in (tmp_path / "0" / "log.txt").read_text()
    assert not (tmp_path / "1" / "uncalibrated").exists()
    table = th.compare(tmp_path)
    rows = table if isinstance(table, list) else table.to_dict("records")
    assert [row["change"] for row in rows] == ["calibrate=True", "calibrate=False"]


@pytest.mark.parametrize("words, line", [
    (["live=true"], "calibrate: the sequence is tracked twice, and a live one comes once (live); leave one of the two out"),
    (["real_time=true"], "calibrate: the sequence is tracked twice, and one in real time comes once (real_time); leave one of the two out"),
    (["load_map=map.mcap"],
     "calibrate: the loaded map was made with the stated camera (load_map); make the map with calibrate=true, and load it with its camera.yaml"),
    (["dataset=synthetic"],
     "calibrate: dataset=synthetic takes no camera file; leave it out; those that do: folder, icl_nuim, mcap, replica, seven_scenes, tamu, tum"),
    (["graph=plane_odometry"],
     "calibrate: needs matched key points, and this run has no stage map; leave it out, or choose graph=structural"),
    (["dataset.path=out"], "out: {out}/camera.yaml would be replaced, which dataset.path reads; give another out=FOLDER"),
    (["dataset.camera=out/camera.yaml"], "out: {out}/camera.yaml would be replaced, which dataset.camera reads; give another out=FOLDER"),
    (["dataset.camera=out"], "out: {out}/camera.yaml would be replaced, which dataset.camera reads; give another out=FOLDER"),
    (["save_map=nowhere/map.mcap"], "save_map: the folder {here}/nowhere does not exist; make it first"),
    (["seed=-1"], "seed: -1 is negative; give 0 or more"),
    ([], "out: {out}/camera.yaml would be replaced, which no run with calibrate=true wrote; give another out=FOLDER"),
])  # fmt: skip
def test_what_cannot_be_calibrated_is_refused_before_the_first_pass(right, tmp_path, monkeypatch, capsys, words, line):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "camera.yaml").write_text("by hand")
    data = [] if words == ["dataset=synthetic"] else ["dataset=tum", f"dataset.path={right}"]
    assert main(["run", *data, "out=out", "calibrate=true", *words]) == 1
    printed = capsys.readouterr()
    assert printed.err == f"trihedron: {line.format(here=tmp_path, out=tmp_path / 'out')}\n" and not printed.out
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "camera.yaml"]


def test_a_replay_is_not_calibrated(wrong, tmp_path, capsys):
    assert main(["run", f"replay={wrong[2].folder}", "calibrate=true", f"out={tmp_path / 'a'}"]) == 1
    cause = "calibrate: a replay has the camera of its run (replay); run the data set itself with calibrate=true"
    assert capsys.readouterr().err == f"trihedron: {cause}\n"


def test_pushed_frames_are_not_calibrated():
    with pytest.raises(th.TrihedronError) as error:
        th.Slam(Synthetic(width=64, height=48, length=1)(0).camera, calibrate=True)
    assert str(error.value) == "calibrate: is for runs over a data set; leave it out, or use trihedron.run"


def test_an_error_of_the_first_pass_is_that_of_the_run(right, tmp_path, capsys):
    assert main(["run", "dataset=tum", f"dataset.path={right}", "dataset.frames=0:2", "calibrate=true", f"out={tmp_path}"]) == 1
    cause = "has fewer than three posed frames; calibrate from a run that tracked its camera"
    assert capsys.readouterr().err == f"trihedron: {tmp_path / 'uncalibrated' / 'run.mcap'}: {cause}\n"


def test_a_recording_with_frames_is_calibrated(wrong, tmp_path):
    """The camera file describes its images, which have the camera of the folder's file."""
    folder, true, _ = wrong
    assert main(["convert", str(folder), str(tmp_path / "room.mcap")]) == 0
    run = th.run("dataset=mcap", dataset__path=tmp_path / "room.mcap", calibrate=True, out=tmp_path / "run", quiet=True)
    found = read(run.folder / "camera.yaml")
    assert abs(found["fx"] - true) < 0.01 * true and found["depth_scale"] == 1000.0
    assert run.metrics["status"]["ok"] == 60 > read(run.folder / "uncalibrated" / "metrics.json")["status"]["ok"]
