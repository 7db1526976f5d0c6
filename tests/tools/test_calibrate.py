"""What `trihedron calibrate` says of sensors whose errors are known."""

import json

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
from trihedron.tools.calibration import RightAngle, Turn, estimate_depth_delay, estimate_depth_offset


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
    turns = [Turn(c, d + rng.normal(0.0, sigma, 3), sigma**2 * np.eye(3)) for c, d in zip(color, depth)]
    found = estimate_depth_delay(turns, seconds)
    assert abs(found.seconds - tau) < 3.0 * found.sigma_s and found.sigma_s < 0.002
    still = estimate_depth_delay([Turn(np.zeros(3), rng.normal(0.0, sigma, 3), sigma**2 * np.eye(3)) for _ in range(50)], seconds)
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
