"""`trihedron calibrate`: what it prints and writes, and that a run with its recommendation is better."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from trihedron.datasets.readers.cameras import NOISES, Calibration, read_camera_file
from trihedron.datasets.readers.registration import DepthCamera
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import EXACT_DEPTH, Camera, DepthNoise
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.tools.calibrate import Estimates, _as_yaml, keys_of, with_estimates

CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)


def write_tum(folder, frames, color_at, depth_at, offset=0.0):
    """A TUM folder whose depth images are of other moments than their stamps say, and whose inverse depths lack `offset`."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lists = {"rgb": [], "depth": []}
    for k in range(frames):
        color, depth = color_at(k), depth_at(k)
        z = np.where(depth.depth_m > 0, depth.depth_m / np.maximum(1.0 - offset * depth.depth_m, 0.1), 0.0)
        cv2.imwrite(str(folder / "rgb" / f"{k:04d}.png"), cv2.cvtColor(color.color, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / "depth" / f"{k:04d}.png"), np.rint(5000.0 * z).clip(0, 65535).astype(np.uint16))
        for kind in lists:
            lists[kind].append(f"{k / 30.0:.6f} {kind}/{k:04d}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    camera = color_at(0).camera
    content = {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy")} | {"width": 640, "height": 480, "depth_scale": 5000}
    content |= {"readout_s": 0.0, "depth_readout_s": 0.0}
    (folder / "camera.yaml").write_text(yaml.safe_dump(content))
    return content


def run(folder, out, *more):
    assert main(["run", "dataset=tum", f"dataset.path={folder}", f"out={out}", *more]) == 0
    return Recording(out / "run.mcap")


def with_parameters(used, edges=(0.0,) * 6, pairs=(0.0,) * 6):
    nothing = np.zeros(6), np.zeros(6)
    return with_estimates(used, Estimates(np.array(edges), np.array(pairs), nothing, nothing, {}))


def test_no_recommendation_changes_nothing():
    used = Calibration(CAMERA, 1000.0, depth_camera=DepthCamera(600.0, 600.0, 321.0, 239.0))
    assert with_parameters(used) == used


def test_a_recommended_camera_projects_depth_where_the_edges_are():
    """A reading of the depth camera, moved by T_color_depth and projected, is at the pixel that the estimates give, under any focal length."""
    edges, factor = np.array([-0.1, 5.0, -4.0, -0.04, 0.006, 0.0]), 0.9
    pixel, z = np.array([100.0, 400.0]), 2.0
    center = np.array([320.0, 240.0])
    expected = np.exp(edges[0]) * (pixel - center) + edges[1:3] + 585.0 * edges[3:5] / z + center
    for focal in (1.0, factor):
        found = with_parameters(Calibration(CAMERA, 1000.0), edges, (np.log(focal), 0.01, 0.0, 0.03, 0.0, 0.02))
        depth, color = found.depth_camera, found.camera
        ray = (pixel - [depth.cx, depth.cy]) / [depth.fx, depth.fy]
        point = np.append(ray * z, z) + depth.translation_m
        assert np.allclose(color.project(point[None])[0], expected, atol=1e-9)
        assert np.isclose(color.fx, 585.0 * focal) and found.depth_offset == 0.01 and (found.readout_s, found.depth_readout_s) == (0.03, 0.02)
    again = with_parameters(found, (0.05, 1.0, 2.0, 0.01, 0.0, 0.0), (0.0, 0.0, 0.0, -0.004, 0.0, 0.0))
    assert np.isclose(again.readout_s, 0.026)
    registered = color.project(point[None])[0]
    expected = np.exp(0.05) * (registered - center) + [1.0, 2.0] + color.fx * np.array([0.01, 0.0]) / z + center
    point = np.append((pixel - [again.depth_camera.cx, again.depth_camera.cy]) / again.depth_camera.fx * z, z) + again.depth_camera.translation_m
    assert np.allclose(color.project(point[None])[0], expected, atol=1e-6)


@pytest.mark.parametrize("noise", [DepthNoise(), EXACT_DEPTH, NOISES["stereo"], DepthNoise(0.001, 0.002, 0.003, 0.004)])
def test_the_file_that_is_written_is_read_back(tmp_path, noise):
    depth = DepthCamera(589.137, 589.137, 314.246, 244.402, (-0.04075, 0.00441, 0.0), (0.1, 0.0, -0.2))
    given = Calibration(replace(CAMERA, depth_noise=noise), 1000.0, (0.1, 0.0, 0.0, 0.0, 0.0), 0.012, -0.01, depth, 0.0304, -0.015, 0.0123)
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(keys_of(given)))
    assert read_camera_file(tmp_path / "camera.yaml") == given


def test_keys_are_a_line_each_and_the_folder_of_the_file_is_asked_for_first(tmp_path, capsys):
    assert _as_yaml({"fx": 523.9, "fy": 523.9, "distortion": [0.1, 0.0]}) == "fx: 523.9\nfy: 523.9\ndistortion: [0.1, 0.0]\n"
    assert main(["calibrate", "nowhere.mcap", "--out", str(tmp_path / "nowhere" / "camera.yaml")]) == 2
    assert capsys.readouterr().err == f"trihedron: --out: the folder {tmp_path / 'nowhere'} does not exist; make it first\n"


@pytest.mark.slow
def test_a_biased_sensor_is_found_out_and_put_right(tmp_path, capsys):
    """Inverse depths 0.03 / m too small (12 cm at 2 m): recommended, and with the file that is written the error is less than half."""
    room = Synthetic(frames="0:120")
    write_tum(tmp_path / "room", 120, room, room, offset=0.03)
    write_trajectory(tmp_path / "room" / "groundtruth.txt", room.truth())
    run(tmp_path / "room", tmp_path / "before")
    assert main(["calibrate", str(tmp_path / "before"), "--out", str(tmp_path / "camera.yaml")]) == 0
    print(capsys.readouterr().out)
    assert "depth_offset" in (tmp_path / "camera.yaml").read_text()
    run(tmp_path / "room", tmp_path / "after", f"dataset.camera={tmp_path / 'camera.yaml'}")
    errors = [json.loads((tmp_path / name / "metrics.json").read_text())["final"]["ate_rmse_m"] for name in ("before", "after")]
    print(f"ATE {1e3 * errors[0]:.2f} mm, with the recommendation {1e3 * errors[1]:.2f} mm")
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_a_camera_that_is_right_is_left_alone(tmp_path, capsys):
    options = [f"dataset.{name}={value}" for name, value in (("length", 60), ("width", 320), ("height", 240))]
    assert main(["run", *options, "outputs=[trajectory]", f"out={tmp_path}"]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    print(printed)
    assert printed.endswith("no change recommended\n") and " yes" not in printed
    assert main(["calibrate", str(tmp_path), "--out", str(tmp_path / "camera.yaml")]) == 1
    cause = "is not of a data set with a camera file; copy the lines that are printed"
    assert capsys.readouterr().err == f"trihedron: {tmp_path / 'run.mcap'}: {cause}\n"


@pytest.mark.slow
def test_late_depth_is_recommended_for_the_data_set(tmp_path, capsys):
    """Depth of three frames before: the run warns, the delay is recommended, and with it colour has the depth of its own time."""
    room = Synthetic(frames="0:120")
    write_tum(tmp_path / "room", 110, lambda k: room(k + 3), room)
    run(tmp_path / "room", tmp_path / "before", "outputs=[trajectory]")
    assert "depth was taken about 100 ms before colour: " in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path / "before"), "--out", str(tmp_path / "camera.yaml")]) == 0
    printed = capsys.readouterr().out
    print(printed)
    delay = re.search(r"^depth_delay_s: (-\d+\.\d+)$", printed, re.M)
    assert delay is not None and abs(float(delay[1]) + 0.1) < 0.015 and "no change recommended" not in printed
    run(tmp_path / "room", tmp_path / "after", "outputs=[trajectory]", f"dataset.camera={tmp_path / 'camera.yaml'}")
    assert "depth was taken" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_recording_without_the_topics_is_refused(tmp_path, capsys):
    options = ["dataset.length=3", "dataset.width=64", "dataset.height=48", "graph=plane_odometry", "outputs=[trajectory]"]
    assert main(["run", *options, f"out={tmp_path}"]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(tmp_path / "run.mcap")]) == 1
    cure = "record a run of graph=structural, or one that has this stage"
    assert capsys.readouterr().err == f"trihedron: {tmp_path / 'run.mcap'}: holds no topic matches; {cure}\n"
