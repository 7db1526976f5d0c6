"""Estimates of `trihedron calibrate` for sensors whose errors are known."""

import dataclasses
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from trihedron.datasets.readers.images import read_depth
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.tools.calibrate import depth_delay_of, depth_offset_of, planes_of
from trihedron.tools.calibration import FrameRotation, RightAngle, estimate_depth_delay, estimate_depth_offset
from trihedron.tools.calibration_focal_length import MIN_POINTS, estimate_focal_lengths

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from landmark_world import CAMERA, World
from map_steps import EVERY, walk


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
    (folder / "camera.yaml").write_text(yaml.safe_dump(content))
    return content


def run(folder, out, *more):
    assert main(["run", "dataset=tum", f"dataset.path={folder}", f"out={out}", *more]) == 0
    return Recording(out / "run.mcap")


def test_an_offset_is_found_among_pairs_that_are_not_quite_right_angles():
    rng, pairs = np.random.default_rng(1), {}
    for k in range(30):
        built, levers = rng.normal(0.0, np.radians(0.5)), rng.uniform(0.5, 4.0, 40)
        pairs[k, 99] = [RightAngle(built - 0.01 * lever + rng.normal(0.0, 0.003), lever, 0.003**2) for lever in levers]
    pairs[31, 99] = [RightAngle(np.radians(6.0), 2.0, 0.003**2)] * 40  # no right angle at all
    found = estimate_depth_offset(pairs)
    assert found.pairs == 31 and abs(found.per_m - 0.01) < 3.0 * found.sigma_per_m and found.sigma_per_m < 0.001


def test_no_planes_say_nothing():
    found = estimate_depth_offset({})
    assert np.isnan(found.per_m) and found.sigma_per_m == np.inf and found.pairs == 0
    none = estimate_depth_delay([], 0.03)
    assert np.isnan(none.seconds) and none.sigma_s == np.inf and none.frames == 0


def test_a_delay_is_found_from_turns():
    rng, seconds, tau = np.random.default_rng(2), 1.0 / 30.0, 0.012

    def angle(t):
        return np.stack([0.3 * np.sin(3.0 * t), 0.2 * np.cos(4.0 * t), 0.1 * np.sin(5.0 * t)], axis=-1)

    t, sigma = np.arange(200) * seconds, np.radians(0.1)
    color, depth = (angle(t + seconds + shift) - angle(t + shift) for shift in (0.0, tau))
    turns = [FrameRotation(c, d + rng.normal(0.0, sigma, 3), sigma**2 * np.eye(3)) for c, d in zip(color, depth)]
    found = estimate_depth_delay(turns, seconds)
    assert abs(found.seconds - tau) < 3.0 * found.sigma_s and found.sigma_s < 0.002
    still = estimate_depth_delay([FrameRotation(np.zeros(3), rng.normal(0.0, sigma, 3), sigma**2 * np.eye(3)) for _ in range(50)], seconds)
    assert not still.sigma_s < 1.0  # a camera that does not turn cannot say


def test_the_camera_file_s_offset_is_added_to_inverse_depths(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[0, 5000, 20000]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", 5000.0, 0.05), [[0.0, 1.0 / 1.05, 1.0 / 0.30]], rtol=1e-6)


def test_a_recording_without_the_topics(tmp_path, capsys):
    assert main(["run", "dataset.frames=0:2", "graph=structural_no_refine", f"out={tmp_path}"]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(tmp_path / "run.mcap")]) == 1
    cure = "record a run of graph=structural, or one that has this stage"
    assert capsys.readouterr().err == f"trihedron: {tmp_path / 'run.mcap'}: holds no topic matches; {cure}\n"


def with_focal_lengths(map, x, y):
    """The map of keyframes whose camera file has fx and fy wrong by these factors."""
    intrinsics = np.tile([x * CAMERA.fx, y * CAMERA.fy, CAMERA.cx, CAMERA.cy], (len(map.keyframes), 1))
    return dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(len(intrinsics)), intrinsics=intrinsics))


@pytest.fixture(scope="module")
def turning():
    """Six keyframes of a camera that rotates about both axes."""
    return walk(World(1500), 6, EVERY, stride=8)


@pytest.mark.parametrize("x, y", [(1.0, 1.0), (0.8, 0.8), (1.2, 1.2), (1.05, 0.95)])
def test_wrong_focal_lengths_are_found_within_their_deviation(turning, x, y):
    found = estimate_focal_lengths(with_focal_lengths(turning, x, y))
    print(found)
    assert (np.abs(found.factors * [x, y] - 1.0) < 4.0 * found.sigmas).all() and (found.sigmas < 0.05).all() and found.pairs == 5


def test_the_deviations_of_focal_lengths_are_honest():
    """Over eight noises the errors are about one standard deviation."""
    found = [estimate_focal_lengths(walk(World(1500, seed=seed), 4, EVERY, stride=8)) for seed in range(8)]
    errors = np.array([np.log(one.factors) / one.sigmas for one in found])
    print(np.round(errors, 1))
    assert 0.4 < np.sqrt(np.mean(errors**2)) < 2.0


def test_keyframes_without_rotation_or_points_leave_the_focal_lengths_open(turning):
    still = estimate_focal_lengths(walk(World(1500), 3, EVERY, stride=0))
    print(still)
    assert still.pairs == 2 and (still.sigmas > 0.1).all()
    few = estimate_focal_lengths(walk(World(MIN_POINTS // 2), 3, EVERY, stride=8))
    assert few.pairs == 0 and np.isnan(few.factors).all() and (few.sigmas == np.inf).all()


def test_the_command_reports_focal_lengths_that_are_a_fifth_too_long(tmp_path, capsys):
    room = [f"+dataset.options.{name}={value}" for name, value in (("length", 40), ("width", 320), ("height", 240))]
    assert main(["run", "dataset=faults", *room, "dataset.focal_times=1.2", f"out={tmp_path}"]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(tmp_path / "run.mcap")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["figure", "depth_offset", "depth_delay_ms", "fx", "fy"]
    estimate, sigma = (float(word) for word in lines[3].split(")")[1].split()[:2])
    print(lines[3])
    assert lines[3].startswith("fx (px; 315 in use)") and abs(estimate / 262.5 - 1.0) < 0.05 and 10.0 * sigma < 315.0 - estimate


@pytest.mark.slow
def test_a_biased_sensor_is_found_out_and_put_right(tmp_path):
    """Inverse depths 0.012 / m too small (5 cm at 2 m): found to 3 σ; with the figure in camera.yaml the error is less than half."""
    room = Synthetic(frames="0:120")
    content = write_tum(tmp_path / "room", 120, room, room, offset=0.012)
    write_trajectory(tmp_path / "room" / "groundtruth.txt", room.truth())
    before = run(tmp_path / "room", tmp_path / "before")
    found = depth_offset_of(before, planes_of(before))
    print(f"offset 0.012 / m found as {found.per_m:.5f} ± {found.sigma_per_m:.5f}")
    assert abs(found.per_m - 0.012) < max(3.0 * found.sigma_per_m, 0.001) and found.sigma_per_m < 0.002
    (tmp_path / "room" / "camera.yaml").write_text(yaml.safe_dump(content | {"depth_offset": found.per_m}))
    after = run(tmp_path / "room", tmp_path / "after")
    assert abs(depth_offset_of(after, planes_of(after)).per_m) < 0.002
    errors = [json.loads((tmp_path / name / "metrics.json").read_text())["final"]["ate_rmse_m"] for name in ("before", "after")]
    print(f"ATE {1e3 * errors[0]:.2f} mm, with the offset {1e3 * errors[1]:.2f} mm")
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_late_depth_is_found_out(tmp_path):
    """Depth images 16.7 ms late, half a frame."""
    room = Synthetic(fps=60.0, length=260, motion="fast")
    write_tum(tmp_path / "late", 120, lambda k: room(2 * k), lambda k: room(2 * k + 1))
    recording = run(tmp_path / "late", tmp_path / "out")
    found = depth_delay_of(recording, planes_of(recording))
    print(f"16.7 ms found as {1e3 * found.seconds:.1f} ± {1e3 * found.sigma_s:.1f} ms")
    assert abs(found.seconds - 1.0 / 60.0) < 3.0 * found.sigma_s and found.sigma_s < 0.004
