"""The readers of 7-Scenes, TAMU, Replica and ScanNet, on small folders of their layouts."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.readers.replica import Replica
from trihedron.datasets.readers.scannet import ScanNet
from trihedron.datasets.readers.seven_scenes import SevenScenes
from trihedron.datasets.readers.tamu import Tamu
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import EXACT_DEPTH, F64, DepthNoise
from trihedron.tools.convert import layout_of

POSES = [exp_se3(np.array([0.1 * k, 0.2, -0.1, 0.0, 0.3 * k, 0.05])) for k in range(4)]


def written(pose: F64) -> str:
    return "\n".join(" ".join(f"{x:.7e}" for x in row) for row in pose) + "\n"


@pytest.fixture
def seven_scenes(tmp_path: Path) -> Path:
    """Four frames, 640 × 480, of which number 2 has no pose."""
    folder = tmp_path / "chess" / "seq-01"
    folder.mkdir(parents=True)
    for k in range(4):
        depth = np.full((480, 640), 1500 + k, np.uint16)
        depth[:, :100] = 65535
        depth[:, 100:200] = 0
        cv2.imwrite(str(folder / f"frame-{k:06}.color.png"), np.full((480, 640, 3), (10, 100, 200), np.uint8))
        cv2.imwrite(str(folder / f"frame-{k:06}.depth.png"), depth)
        if k != 2:
            (folder / f"frame-{k:06}.pose.txt").write_text(written(POSES[k]))
    return folder


def test_seven_scenes(seven_scenes: Path) -> None:
    dataset = SevenScenes(str(seven_scenes), frames="1:")
    frame = dataset(0)
    assert len(dataset) == 3 and frame is not None and (frame.index, frame.stamp_ns) == (1, 33_333_333)
    assert (frame.color == [200, 100, 10]).all()
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (525.0, 525.0, 320.0, 240.0)
    left, right = (round(320.0 + 525.0 * ((x - 320.0) / 585.0 - 0.025 / 1.501)) for x in (200, 640))  # of what depth shows, seen by colour
    assert (frame.depth_m[:, : left - 1] == 0).all() and (frame.depth_m[:, right + 1 :] == 0).all()
    assert np.allclose(frame.depth_m[30:-30, left + 1 : right - 1], 1.501)
    truth = dataset.truth()
    assert truth is not None and truth.stamps_ns.tolist() == [0, 33_333_333, 100_000_000]
    T_depth_color = pose_matrix(np.eye(3), np.array([0.025, 0.0, 0.0]))
    np.testing.assert_allclose(truth.poses, [POSES[k] @ T_depth_color for k in (0, 1, 3)], atol=1e-6)
    assert layout_of(seven_scenes) == "seven_scenes"


def test_seven_scenes_says_what_is_missing(seven_scenes: Path) -> None:
    with pytest.raises(DataError) as caught:
        len(SevenScenes(str(seven_scenes.parent)))
    assert str(caught.value) == f"{seven_scenes.parent}: holds no frames of 7-Scenes; choose one of seq-01"
    pose = seven_scenes / "frame-000001.pose.txt"
    pose.write_text("1 0 0")
    with pytest.raises(DataError, match=r"frame-000001.pose.txt: is not a matrix of 4 × 4 numbers"):
        len(SevenScenes(str(seven_scenes)))
    pose.write_text(written(np.diag([1.0, 1.0, -1.0, 1.0])))
    with pytest.raises(DataError, match=r"frame-000001.pose.txt: is not the pose of a camera"):
        len(SevenScenes(str(seven_scenes)))
    pose.write_text(written(np.full((4, 4), np.nan)))
    truth = SevenScenes(str(seven_scenes)).truth()
    assert truth is not None and len(truth.stamps_ns) == 2


def test_tamu_is_tum_without_truth(tum_folder: Path) -> None:
    dataset = Tamu(str(tum_folder), frames="1:4")
    frame = dataset(2)
    assert len(dataset) == 3 and frame is not None and (frame.index, frame.stamp_ns) == (3, 10_300_000_000)
    assert (frame.depth_m == 2.0).all() and dataset.truth() is None
    (tum_folder / "depth.txt").unlink()
    with pytest.raises(DataError, match=r"depth.txt: is missing; it lists the depth images"):
        len(Tamu(str(tum_folder)))
    (tum_folder / "camera.yaml").unlink()
    with pytest.raises(DataError, match=r"has no camera.yaml, and its name is not that of a data set whose camera is known"):
        len(Tamu(str(tum_folder)))


@pytest.fixture
def replica(tmp_path: Path) -> Path:
    folder = tmp_path / "Replica" / "room0"
    (folder / "results").mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(folder / f"results/frame{k:06}.jpg"), np.full((68, 120, 3), (10, 100, 200), np.uint8))
        cv2.imwrite(str(folder / f"results/depth{k:06}.png"), np.full((68, 120), 6554 * (k + 1), np.uint16))
    (folder / "traj.txt").write_text("\n".join(" ".join(written(pose).split()) for pose in POSES))
    camera = {"w": 120, "h": 68, "fx": 60.0, "fy": 60.0, "cx": 59.5, "cy": 33.5, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def test_replica(replica: Path) -> None:
    dataset = Replica(str(replica), frames="2:")
    frame = dataset(1)
    assert len(dataset) == 2 and frame is not None and (frame.index, frame.stamp_ns) == (3, 100_000_000)
    assert np.abs(frame.color.astype(int) - [200, 100, 10]).max() <= 2
    assert np.allclose(frame.depth_m, 4 * 6554 / 6553.5, rtol=1e-6)
    assert frame.camera.cx == 59.5 and frame.camera.depth_noise == EXACT_DEPTH
    assert dataset.calibration() == Calibration(frame.camera, 6553.5)
    noisy = Replica(str(replica), exact_depth=False)(0)
    assert noisy is not None and noisy.camera.depth_noise == DepthNoise()
    truth = dataset.truth()
    assert truth is not None and truth.stamps_ns[3] == 100_000_000
    np.testing.assert_allclose(truth.poses, POSES, atol=1e-6)
    assert layout_of(replica) == "replica"


def test_replica_says_what_is_missing(replica: Path) -> None:
    parameters = replica.parent / "cam_params.json"
    for text in (
        "{",
        "[]",
        '{"camera": {"w": 120}}',
        parameters.read_text().replace("60.0", "-1", 1),
        parameters.read_text().replace("120", "1e300"),
    ):
        damaged = replica / "cam_params.json"
        damaged.write_text(text)
        with pytest.raises(DataError, match=r"room0/cam_params.json: does not describe a camera"):
            len(Replica(str(replica)))
        damaged.unlink()
    with (replica / "traj.txt").open("a") as file:
        file.write("\n1 2 3\n")
    with pytest.raises(DataError, match=r"traj.txt:5: is not a matrix of 4 × 4 numbers"):
        len(Replica(str(replica)))
    parameters.unlink()
    with pytest.raises(DataError, match=r"has no camera.yaml"):
        len(Replica(str(replica)))
    with pytest.raises(DataError, match=r"holds no frames of Replica; give the folder that holds results"):
        len(Replica(str(replica / "results")))


@pytest.fixture
def scannet(tmp_path: Path) -> Path:
    """Colour 130 × 98, depth 64 × 48, both of the same view; frame 1 was lost."""
    folder = tmp_path / "scene0000_00"
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    y, x = np.mgrid[:98, :130]
    disc = np.where((x - 80) ** 2 + (y - 50) ** 2 < 15**2, 255, 0).astype(np.uint8)
    for k in (0, 1, 2, 10):
        cv2.imwrite(str(folder / f"color/{k}.jpg"), np.repeat(disc[..., None], 3, axis=2))
        cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((48, 64), 1000 + k, np.uint16))
        lost = np.full((4, 4), -np.inf)
        (folder / f"pose/{k}.txt").write_text(written(lost) if k == 1 else written(POSES[k % 4]))
    for kind, K in (("color", (117.0, 117.0, 64.8, 48.6)), ("depth", (57.8, 57.8, 29.5, 25.5))):
        matrix = np.eye(4)
        matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = K
        (folder / f"intrinsic/intrinsic_{kind}.txt").write_text(written(matrix))
    return folder


def test_scannet_shows_colour_as_the_depth_camera_sees_it(scannet: Path) -> None:
    dataset = ScanNet(str(scannet))
    frame = dataset(3)
    assert len(dataset) == 4 and frame is not None and (frame.index, frame.stamp_ns) == (3, 333_333_333)  # the number 10
    assert frame.color.shape == (48, 64, 3) and np.allclose(frame.depth_m, 1.010)
    y, x = np.nonzero(frame.gray > 127)  # the disc about (80, 50) of colour
    assert x.mean() == pytest.approx((80 - 64.8) / 117.0 * 57.8 + 29.5, abs=0.15)
    assert y.mean() == pytest.approx((50 - 48.6) / 117.0 * 57.8 + 25.5, abs=0.15)
    assert np.sqrt(len(x) / np.pi) == pytest.approx(15 * 57.8 / 117.0, abs=0.2)
    truth = dataset.truth()
    assert truth is not None and truth.stamps_ns.tolist() == [0, 66_666_667, 333_333_333]
    np.testing.assert_allclose(truth.poses, [POSES[0], POSES[2], POSES[2]], atol=1e-6)
    assert layout_of(scannet) == "scannet"


def test_scannet_says_what_is_missing(scannet: Path) -> None:
    (scannet / "intrinsic/intrinsic_color.txt").unlink()
    with pytest.raises(DataError, match=r"intrinsic_color.txt: is missing; give the folder of a scan exported with color/0.jpg"):
        len(ScanNet(str(scannet)))
    for file in (scannet / "depth").iterdir():
        file.unlink()
    with pytest.raises(DataError, match="holds no frames of ScanNet"):
        len(ScanNet(str(scannet)))


@pytest.mark.slow
def test_a_room_in_each_layout_is_tracked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Eight frames of the built-in room, written in the three layouts, are tracked to a centimetre by the layout's own truth."""
    room = Synthetic(length=120, frames="0:8")
    truth = room.truth()
    first = room(0)
    assert truth is not None and first is not None
    camera, folders = first.camera, {name: tmp_path / name for name in ("seven_scenes", "replica", "scannet")}
    for part in ("replica/results", "seven_scenes", "scannet/color", "scannet/depth", "scannet/pose", "scannet/intrinsic"):
        (tmp_path / part).mkdir(parents=True)
    K = np.eye(4)
    K[:3, :3] = camera.K
    numbers = {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (folders["seven_scenes"] / "camera.yaml").write_text("".join(f"{key}: {value}\n" for key, value in {**numbers, "depth_scale": 1000}.items()))
    short = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "scale": 1000.0}
    (folders["replica"] / "cam_params.json").write_text(json.dumps({"camera": short}))
    for kind in ("color", "depth"):
        (folders["scannet"] / f"intrinsic/intrinsic_{kind}.txt").write_text(written(K))
    lines = []
    for k in range(8):
        frame = room(k)
        assert frame is not None
        pose = truth.poses[int(np.argmin(np.abs(truth.stamps_ns - frame.stamp_ns)))]
        color, depth = frame.color[..., ::-1], np.rint(frame.depth_m * 1000).astype(np.uint16)
        for image, names in (
            (color, (f"seven_scenes/frame-{k:06}.color.png", f"replica/results/frame{k:06}.png", f"scannet/color/{k}.png")),
            (depth, (f"seven_scenes/frame-{k:06}.depth.png", f"replica/results/depth{k:06}.png", f"scannet/depth/{k}.png")),
        ):
            for name in names:
                cv2.imwrite(str(tmp_path / name), image)
        (folders["seven_scenes"] / f"frame-{k:06}.pose.txt").write_text(written(pose))
        (folders["scannet"] / f"pose/{k}.txt").write_text(written(pose))
        lines.append(" ".join(written(pose).split()))
    (folders["replica"] / "traj.txt").write_text("\n".join(lines))
    for name, folder in folders.items():
        out = tmp_path / f"run_{name}"
        assert main(["run", f"dataset={name}", f"dataset.path={folder}", f"out={out}"]) == 0, capsys.readouterr().err
        metrics = json.loads((out / "metrics.json").read_text())
        print(f"{name}: {metrics['status']}, ATE {1e3 * metrics['final']['ate_rmse_m']:.2f} mm")
        assert metrics["status"]["ok"] == 8 and metrics["final"]["ate_rmse_m"] < 0.01
