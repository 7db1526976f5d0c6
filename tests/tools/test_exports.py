"""What other programs read of a run: trajectories, tables, COLMAP models, rerun."""

import csv
import subprocess
import sys
from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app.recorded_values import last_map
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.record import rerun_view, rerun_viewer
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.tools import export_rerun

FRAMES = 24


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run over the built-in room, whose frames are rendered again where they are asked for."""
    out = tmp_path_factory.mktemp("export") / "run"
    words = ["dataset=synthetic", f"dataset.length={FRAMES}", "dataset.width=320", "dataset.height=240", f"out={out}"]
    assert main(["run", *words]) == 0
    return out


def test_trajectories(run, capsys):
    for name in ("tum", "kitti"):
        assert main(["export", str(run), "--to", name]) == 0
    assert (run / "trajectory_final.txt").read_bytes() == (run / "trajectory.txt").read_bytes()
    assert f"{FRAMES} poses" in capsys.readouterr().out
    rows = np.loadtxt(run / "trajectory_kitti.txt")
    assert rows.shape == (FRAMES, 12)
    assert rows.reshape(-1, 3, 4) == pytest.approx(read_trajectory(run / "trajectory.txt").poses[:, :3], abs=1e-8)


def test_a_row_for_each_frame(run):
    assert main(["export", str(run), "--to", "csv"]) == 0
    with open(run / "frames.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    poses = list(Recording(run / "run.mcap").values("pose"))
    assert len(rows) == FRAMES and [int(row["index"]) for row in rows] == [pose.index for pose in poses]
    for row, pose in zip(rows, poses):
        assert [float(row[f"t{axis}"]) for axis in "xyz"] == pytest.approx(pose.T_world_camera[:3, 3], abs=1e-9)
        assert float(row["var_rz"]) == pytest.approx(pose.covariance[5, 5], rel=1e-5) and row["status"] == pose.status
        assert float(row["ms_pose"]) >= 0.0
    found = {value.index: len(value.pixels) for value in Recording(run / "run.mcap").values("keypoints")}
    assert [int(row["keypoints"]) for row in rows] == [found[pose.index] for pose in poses]


def test_colmap_models_read_back(run, capsys):
    import pycolmap

    assert main(["export", str(run), "--to", "colmap"]) == 0
    map, folder = last_map(Recording(run / "run.mcap")), run / "colmap" / "sparse" / "0"
    keyframes = {f"{i:06d}.png": T for i, T in zip(map.keyframes.column("index"), map.keyframes.column("T_world_camera"))}
    binary, text = pycolmap.Reconstruction(), pycolmap.Reconstruction()
    binary.read_binary(str(folder))
    text.read_text(str(folder))
    positions = map.points.column("position_m")
    for model in (binary, text):
        assert model.num_images() == len(keyframes) > 1 and model.num_points3D() > 100
        for image in model.images.values():
            assert image.cam_from_world().matrix() == pytest.approx(invert(keyframes[image.name])[:3], abs=1e-6)
            picture = cv2.imread(str(run / "colmap" / "images" / image.name))
            assert picture.shape == (240, 320, 3)
        for point in model.points3D.values():
            assert np.abs(positions - point.xyz).sum(axis=1).min() < 1e-6 and point.track.length() >= 2
        camera = model.cameras[1]
        assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (320, 240)
        model.update_point_3d_errors()
        assert 0.0 < model.compute_mean_reprojection_error() < 1.5
    grey = [point.color for point in binary.points3D.values()]
    assert np.std(grey, axis=0).min() > 5.0  # of the images
    assert "images," in capsys.readouterr().out


def test_what_cannot_be_exported_is_one_line(run, tmp_path, monkeypatch, capsys):
    assert main(["export", str(run), "--to", "colmpa"]) == 2
    assert capsys.readouterr().err == "trihedron: export: there is no format 'colmpa'; did you mean 'colmap'?\n"
    for name in ("ifc", "svg", "dxf"):
        assert main(["export", str(run), "--to", name]) == 2
        assert capsys.readouterr().err == f"trihedron: export: there is no format '{name}'; trihedron building {run} writes it\n"
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for command in (["view", str(run)], ["export", str(run), "--to", "rerun", "--out", str(tmp_path / "a.rrd")]):
        assert main(command) == 1
        assert capsys.readouterr().err == "trihedron: rerun-sdk: is not installed; install it with: pip install 'trihedron[view]'\n"
    assert main(["export", str(run), "--to", "colmap", "--out", str(tmp_path / "colmap")]) == 1
    assert capsys.readouterr().err == "trihedron: pycolmap: is not installed; install it with: pip install pycolmap\n"


def test_formats_are_known_by_the_endings_of_their_files(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["export", str(run), "--to", "rrd"]) == 1
    assert capsys.readouterr().err.startswith("trihedron: rerun-sdk: is not installed")
    errors = []
    for name in ("glb", "gltf"):
        assert main(["export", str(run), "--to", name, "--out", str(tmp_path / "a.glb")]) == 1
        errors.append(capsys.readouterr().err)
    assert errors[0] == errors[1] and "surface" in errors[0]  # this run has none


class ClosedWindow:
    """A stream to a window that was closed: it takes everything, and cannot hand it over."""

    def flush(self):
        raise RuntimeError("gRPC has been unable to connect for 7s")


def test_a_window_that_closes_is_one_line(run, monkeypatch, capsys):
    monkeypatch.setattr(rerun_view, "require_rerun", lambda: None)
    monkeypatch.setattr(rerun_viewer, "lacks_display", lambda: False)
    monkeypatch.setattr(rerun_viewer, "opened_rerun", lambda host, port, web_port: nullcontext(rerun_viewer.RerunViewer(ClosedWindow())))
    monkeypatch.setattr(export_rerun, "show", lambda recording, stream: 9)
    assert main(["view", str(run)]) == 2
    line = f"does not take the run: gRPC has been unable to connect for 7s; write a file instead: trihedron export {run} --to rerun"
    assert capsys.readouterr().err == f"trihedron: rerun: {line}\n"


def test_without_a_display_view_names_the_browser(run, monkeypatch, capsys):
    monkeypatch.setattr(rerun_view, "require_rerun", lambda: None)
    monkeypatch.setattr(rerun_viewer, "lacks_display", lambda: True)
    assert main(["view", str(run)]) == 2
    line = f"trihedron: view: there is no display for rerun's window; serve it to a browser: trihedron view {run} --web\n"
    assert capsys.readouterr() == ("", line)


@pytest.mark.slow
def test_a_file_for_rerun_is_whole_and_holds_everything(run):
    assert main(["export", str(run), "--to", "rerun"]) == 0
    command = [sys.executable, "-m", "rerun", "rrd"]
    done = subprocess.run([*command, "verify", str(run / "run.rrd")], capture_output=True, text=True)
    assert done.returncode == 0 and "1 file verified without error" in done.stdout + done.stderr
    done = subprocess.run([*command, "print", str(run / "run.rrd")], capture_output=True, text=True)
    said = done.stdout + done.stderr
    parts = ["image", "keypoints", "lines", "planes", "axes"]
    for path in [*(f"/world/camera/{part}" for part in parts), "/world/map/points", "/world/path", "/world/truth", "/error/position_m", "/status"]:
        assert path in said, path
