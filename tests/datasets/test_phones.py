"""The readers of recordings of phones, on small files of their apps' layouts."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from imagecodecs import lzfse_encode

from trihedron.datasets.readers.record3d import Record3D
from trihedron.datasets.readers.stray_scanner import StrayScanner
from trihedron.datasets.readers.video import Video
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import quaternion_from_rotation
from trihedron.pipeline.core.layouts import layout_of
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import F64, Frame

POSES = [exp_se3(np.array([0.1 * k, 0.2, -0.1, 0.0, 0.3 * k, 0.05])) for k in range(4)]
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y\n"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def write_stray_scanner(folder: Path, frames: list[Frame], poses: list[F64], scale: int) -> Path:
    """The app's layout: a film `scale` times as large as depth, whose pixels (mm) have the confidence 2, those of the first column 0."""
    c = frames[0].camera
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    film = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (scale * c.width, scale * c.height))
    lines = []
    for k, (frame, pose) in enumerate(zip(frames, poses)):
        film.write(cv2.resize(frame.color[..., ::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR))
        cv2.imwrite(str(folder / f"depth/{k:06}.png"), np.rint(1000 * frame.depth_m).astype(np.uint16))
        levels = np.full(frame.depth_m.shape, 2, np.uint8)
        levels[:, 0] = 0
        cv2.imwrite(str(folder / f"confidence/{k:06}.png"), levels)
        numbers = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        lines.append(f"{100 + frame.stamp_ns / 1e9:.9f}, {k:06d}, " + ", ".join(f"{x:.9f}" for x in numbers) + ", 1, 1, 1, 1, , \n")
    film.release()
    (folder / "odometry.csv").write_text(HEADER + "".join(lines))
    K = [[scale * c.fx, 0, (c.cx + 0.5) * scale - 0.5], [0, scale * c.fy, (c.cy + 0.5) * scale - 0.5], [0, 0, 1]]
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in K))
    return folder


def write_record3d(path: Path, frames: list[Frame], poses: list[F64], scale: int, **changes: Any) -> Path:
    """The app's layout: JPEG images `scale` times as large as depth, poses of ARKit's camera, the intrinsics column by column."""
    c = frames[0].camera
    K = [scale * c.fx, 0, 0, 0, scale * c.fy, 0, (c.cx + 0.5) * scale - 0.5, (c.cy + 0.5) * scale - 0.5, 1]
    arkit = [pose @ FLIP for pose in poses]
    metadata: dict[str, Any] = {
        "w": scale * c.width,
        "h": scale * c.height,
        "dw": c.width,
        "dh": c.height,
        "fps": 30,
        "K": K,
        "poses": [[*quaternion_from_rotation(T[:3, :3]), *T[:3, 3]] for T in arkit],
        "frameTimestamps": [0.5 + frame.stamp_ns / 1e9 for frame in frames],
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps({**metadata, **changes}))
        for k, frame in enumerate(frames):
            large = cv2.resize(frame.color[..., ::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
            levels = np.full(frame.depth_m.shape, 2, np.uint8)
            levels[:, 0] = 0
            depth_m = np.where(frame.depth_m > 0, frame.depth_m, np.float32(np.nan))
            archive.writestr(f"rgbd/{k}.jpg", cv2.imencode(".jpg", large)[1].tobytes())
            archive.writestr(f"rgbd/{k}.depth", lzfse_encode(depth_m.tobytes()))
            archive.writestr(f"rgbd/{k}.conf", lzfse_encode(levels.tobytes()))
    return path


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    room = Synthetic(length=4, width=64, height=48)
    return [frame for k in range(4) if (frame := room(k)) is not None]


def agree(read: Frame | None, frame: Frame, tolerance_m: float) -> None:
    """A frame that was read is the one that was written, but for the loss of the film and the depth of low confidence."""
    assert read is not None and read.color.shape == frame.color.shape
    assert np.abs(read.color.astype(float) - frame.color).mean() < 12
    c, expected = read.camera, frame.camera
    np.testing.assert_allclose([c.fx, c.fy, c.cx, c.cy], [expected.fx, expected.fy, expected.cx, expected.cy], rtol=1e-9)
    assert (c.width, c.height, round(c.fps)) == (64, 48, 30)
    np.testing.assert_allclose(read.depth_m[:, 1:], frame.depth_m[:, 1:], atol=tolerance_m)


def test_stray_scanner(tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture) -> None:
    folder = write_stray_scanner(tmp_path / "71de12f9", frames, POSES, 4)
    (folder / "depth/000001.png").unlink()
    dataset = StrayScanner(str(folder))
    assert len(dataset) == 3 and "1 of the 4 colour images have no depth image; they are skipped" in caplog.text
    for position, number in ((2, 3), (0, 0), (1, 2)):  # backwards too
        frame = dataset(position)
        agree(frame, frames[number], 0.001)
        assert frame is not None and frame.stamp_ns == 100_000_000_000 + frames[number].stamp_ns
        assert (frame.depth_m[:, 0] == 0).all()
    every = StrayScanner(str(folder), confidence=0, frames="1:")(0)
    assert every is not None and (every.index, every.depth_m[10, 0] > 0) == (1, True)
    truth = dataset.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.poses, POSES, atol=1e-7)
    assert layout_of(folder) == "stray_scanner"


def test_stray_scanner_says_what_is_wrong(tmp_path: Path, frames: list[Frame]) -> None:
    folder = write_stray_scanner(tmp_path / "scan", frames, POSES, 2)
    odometry, matrix, film = (folder / name for name in ("odometry.csv", "camera_matrix.csv", "rgb.mp4"))
    whole = odometry.read_text(), matrix.read_text(), film.read_bytes()

    def message() -> str:
        with pytest.raises(DataError) as caught:
            len(StrayScanner(str(folder)))
        odometry.write_text(whole[0])
        matrix.write_text(whole[1])
        film.write_bytes(whole[2])
        return str(caught.value)

    columns = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    odometry.write_text("x, y, z\n")
    assert message() == f"{odometry}: is missing or has other columns; its first line must begin with '{columns}'"
    odometry.write_text(HEADER + "1.0, 0, 0, 0\n")
    assert message() == f"{odometry}:2: is no line of odometry; each line holds '{columns}'; correct or remove this one"
    odometry.write_text(HEADER + "1.0, 0, 0, 0, nan, 0, 0, 0, 1\n")
    assert message().startswith(f"{odometry}:2: the pose is not finite")
    matrix.write_text("1, 2")
    assert message().startswith(f"{matrix}: is not a matrix of 3 × 3 numbers; give a folder of Stray Scanner")
    matrix.write_text("-1 0 0 0 1 0 0 0 1")
    assert message() == f"{matrix}: does not describe a camera; width, height, focal lengths and rate must be positive"
    film.write_bytes(b"#EXTM3U\nfile:///etc/passwd\n")
    assert message() == f"{film}: is not an MP4 film; give the folder as the phone exported it"
    film.write_bytes(whole[2][:40])
    assert message() == f"{film}: cannot be decoded; is the film damaged? export it again"
    film.unlink()
    assert message() == f"{film}: cannot be opened (No such file or directory); give the folder as the phone exported it"
    small = np.zeros((3, 4), np.uint8)
    cv2.imwrite(str(folder / "confidence/000000.png"), small)
    with pytest.raises(DataError, match=r"confidence/000000.png: is 4×3 while its depth is 64×48; give dataset.confidence=0 to do without"):
        StrayScanner(str(folder))(0)


def test_a_film_that_ends_early_skips_frames(tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture) -> None:
    folder = write_stray_scanner(tmp_path / "scan", frames, POSES, 2)
    short = write_stray_scanner(tmp_path / "short", frames[:2], POSES[:2], 2)
    (folder / "rgb.mp4").write_bytes((short / "rgb.mp4").read_bytes())
    dataset = StrayScanner(str(folder))
    assert [dataset(k) is None for k in (0, 3, 1, 2)] == [False, True, False, True]
    assert f"{folder}/rgb.mp4/3: is not in the film, or damaged; frame 3 is skipped" in caplog.text
    assert (Video(folder / "rgb.mp4").width, Video(folder / "rgb.mp4").height) == (128, 96)


def test_record3d(tmp_path: Path, frames: list[Frame]) -> None:
    file = write_record3d(tmp_path / "room.r3d", frames, POSES, 3)
    dataset = Record3D(str(file), frames="1:")
    frame = dataset(1)
    agree(frame, frames[2], 1e-6)
    assert frame is not None and (frame.index, frame.stamp_ns) == (2, 500_000_000 + frames[2].stamp_ns)
    assert (frame.depth_m[:, 0] == 0).all()
    every = Record3D(str(file), confidence=0)(0)
    assert every is not None and every.depth_m[10, 0] > 0
    truth = dataset.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.poses, POSES, atol=1e-9)
    assert layout_of(file) == "record3d"


def test_record3d_says_what_is_wrong(tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture) -> None:
    cure = "export the recording as .r3d once more"

    def message(**changes: Any) -> str:
        file = write_record3d(tmp_path / "room.r3d", frames, POSES, 1, **changes)
        with pytest.raises(DataError) as caught:
            len(Record3D(str(file)))
        return str(caught.value).removeprefix(str(file))

    assert message(K=[1, 2]) == f"/metadata: does not describe a camera; {cure}"
    assert message(w=0) == "/metadata: does not describe a camera; width, height, focal lengths and rate must be positive"
    assert message(dw=100_000, dh=100_000) == "/metadata: claims depth of 100000×100000 pixels; record it again"
    no_archive = tmp_path / "none.r3d"
    no_archive.write_bytes(b"PK")
    with pytest.raises(DataError) as caught:
        len(Record3D(str(no_archive)))
    assert str(caught.value) == f"{no_archive}: is not a file of Record3D (File is not a zip file); {cure}"
    with pytest.raises(DataError) as caught:
        len(Record3D(str(tmp_path)))
    assert str(caught.value) == f"{tmp_path}: is not a file; give the .r3d file of Record3D as dataset.path"
    other_size = write_record3d(tmp_path / "other.r3d", frames, POSES, 1, dw=32)
    assert Record3D(str(other_size))(0) is None
    assert f"{other_size}/rgbd/0.depth: does not hold 6144 bytes; frame 0 is skipped" in caplog.text
    untimed = Record3D(str(write_record3d(tmp_path / "untimed.r3d", frames, POSES, 1, frameTimestamps=[3, 2, 1, 0])))
    frame = untimed(3)
    assert frame is not None and frame.stamp_ns == 100_000_000
    still = Record3D(str(write_record3d(tmp_path / "still.r3d", frames, [], 1)))
    assert len(still) == 4 and still.truth() is None


@pytest.mark.slow
@pytest.mark.parametrize("app", ["stray_scanner", "record3d"])
def test_a_room_is_tracked(app: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Twelve frames of the built-in room with depth of 256 × 192 are tracked to 5 mm; the data set is found by its files."""
    room = Synthetic(length=120, frames="0:12", width=256, height=192)
    truth, frames = room.truth(), [frame for k in range(12) if (frame := room(k)) is not None]
    assert truth is not None
    poses, path = list(truth.poses[:12]), tmp_path / "room.r3d"
    source = write_record3d(path, frames, poses, 3) if app == "record3d" else write_stray_scanner(tmp_path / "scan", frames, poses, 3)
    assert main(["run", str(source), f"out={tmp_path / 'run'}"]) == 0, capsys.readouterr().err
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    print(f"{app}: {metrics['status']}, ATE {1e3 * metrics['final']['ate_rmse_m']:.2f} mm")
    assert metrics["status"]["ok"] == 12 and metrics["final"]["ate_rmse_m"] < 0.005
