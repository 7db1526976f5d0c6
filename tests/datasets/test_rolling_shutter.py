"""Images of a rolling shutter, turned back row by row."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.camera import Camera
from trihedron.datasets.readers.cameras import PRESETS
from trihedron.datasets.readers.folder import Folder
from trihedron.datasets.readers.rolling_shutter import LONGEST_S, SteadyFrames, look_at, rotation_between, row_lines
from trihedron.datasets.readers.tum import Tum
from trihedron.datasets.simulation import simulated_sensor
from trihedron.datasets.simulation.simulated_sensor import SimulatedSensor
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.images import Frames
from trihedron.pipeline.core import types
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import Frame

CAMERA = Camera(320, 240, 262.5, 260.0, 158.0, 121.0)
READOUT_S = 0.03
FIRST, COUNT = 20, 6  # frames of a fast walk


def camera_keys(camera: types.Camera, readout_s: float) -> str:
    keys = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "fps")}
    keys |= {"depth_scale": 5000, "readout_s": readout_s, "depth_readout_s": readout_s}
    return "".join(f"{key}: {float(value) if key not in ('width', 'height') else value}\n" for key, value in keys.items())


def write_frame(folder: Path, number: int, frame: Frame) -> None:
    cv2.imwrite(str(folder / "rgb" / f"{number:04d}.png"), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(folder / "depth" / f"{number:04d}.png"), np.rint(5000.0 * frame.depth_m).astype(np.uint16))


@pytest.fixture(scope="module")
def seen() -> Callable[[float], list[Frame]]:
    """Frames of a fast walk by a sensor without another error than its readout time."""
    exact = {"depth_readout_ms": 0.0, "delay_ms": 0.0, "exposure_ms": 0.0, "jpeg_quality": 0, "radial_bias": 0.0, "inverse_depth_offset_per_m": 0.0}
    exact |= {"noise": 0.0, "gain_strength": 0.0, "focal_factor": (1.0, 1.0), "center_px": (0.0, 0.0), "depth_focal_factor": 1.0}
    drawn = simulated_sensor.drawn_parameters

    def frames(readout_s: float) -> list[Frame]:
        readouts = {"readout_ms": 1e3 * readout_s, "depth_readout_ms": 1e3 * readout_s, "misregistration_px": (0.0, 0.0)}
        sensor = SimulatedSensor(f"{FIRST}:{FIRST + COUNT}", simulated_sensor.Sensor.tof, width=320, height=240, motion=simulated_sensor.Motion.fast)
        vars(sensor)["hidden"] = replace(drawn(sensor.sensor, 0), **{**exact, **readouts})
        return [frame for k in range(COUNT) if (frame := sensor(k)) is not None]

    return frames


@pytest.fixture(scope="module")
def folder(seen: Callable[[float], list[Frame]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rolling")
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
    frames = seen(READOUT_S)
    for k, frame in enumerate(frames):
        write_frame(folder, k, frame)
    (folder / "camera.yaml").write_text(camera_keys(frames[0].camera, READOUT_S))
    (folder / "as_read.yaml").write_text(camera_keys(frames[0].camera, 0.0))
    return folder


def same(a: Frame | None, b: Frame | None) -> bool:
    return a is not None and b is not None and a.color.tobytes() == b.color.tobytes() and a.depth_m.tobytes() == b.depth_m.tobytes()


def test_a_row_is_where_the_camera_has_turned_to_when_it_is_read() -> None:
    rate = np.array([0.7, -0.9, 0.5])
    start, slope = row_lines(CAMERA, rate, READOUT_S)
    for v, u in ((0, 0), (10, 300), (120, 160), (239, 319), (230, 20)):
        ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        row, turned = float(v), ray
        for _ in range(20):
            turned = matmul(exp_so3(rate * READOUT_S * ((row + 0.5) / CAMERA.height - 0.5)), ray)
            row = CAMERA.fy * turned[1] / turned[2] + CAMERA.cy
        x = CAMERA.fx * turned[0] / turned[2] + CAMERA.cx
        found = start[v] + u * slope[v]
        assert found[:2] / found[2] == pytest.approx([x, row], abs=0.15)
        assert found[2] == pytest.approx(turned[2], abs=3e-4)


@pytest.mark.parametrize("vector", [(0.02, -0.03, 0.02), (0.0, 0.08, 0.0), (-0.05, 0.0, -0.03)])
def test_the_rotation_between_two_images_is_measured(vector: tuple[float, float, float]) -> None:
    room, turn = Synthetic("0:1"), np.array(vector)
    before = room.pose_at(0.0)
    after = matmul(before, pose_matrix(exp_so3(-turn), np.zeros(3)))
    first, second = (look_at(k, 0, room.seen_by(CAMERA, pose)[0]).small for k, pose in enumerate((before, after)))
    found = rotation_between(first, second, CAMERA, 0.0)
    assert found is not None and np.abs(found - turn).max() < 1e-3
    assert rotation_between(first, first, CAMERA, 0.0) is None  # a repeated image
    assert rotation_between(first, np.full_like(first, 128), CAMERA, 0.0) is None
    assert rotation_between(first, second[:-1], CAMERA, 0.0) is None


def test_frames_come_nearer_to_those_of_a_global_shutter(seen: Callable[[float], list[Frame]], folder: Path) -> None:
    truth, steady, read = seen(0.0), Folder(str(folder)), Folder(str(folder), camera=str(folder / "as_read.yaml"))
    for k in range(COUNT):
        errors = []
        for frame in (steady(k), read(k)):
            assert frame is not None
            z, true_z = frame.depth_m[20:-20, 20:-20], truth[k].depth_m[20:-20, 20:-20]
            both = (z > 0.0) & (true_z > 0.0)
            color = np.abs(frame.color[20:-20, 20:-20].astype(float) - truth[k].color[20:-20, 20:-20])
            errors.append((color.mean(), np.median(np.abs(z[both] - true_z[both]))))
        assert errors[0][0] < 0.5 * errors[1][0] and errors[0][1] < 0.75 * errors[1][1]


def test_a_frame_is_the_same_in_any_order_and_any_part(folder: Path) -> None:
    in_order = [Folder(str(folder))(k) for k in range(COUNT)]
    reader, part = Folder(str(folder)), Folder(str(folder), frames=f"1:{COUNT}:2")
    assert all(same(reader(k), in_order[k]) for k in (3, 0, 5, 2, 2, 4, 1))
    assert all(same(part(position), in_order[k]) for position, k in reversed(list(enumerate(range(1, COUNT, 2)))))


def test_an_image_that_repeats_the_last_one_stays_equal_to_it(folder: Path, tmp_path: Path) -> None:
    frames = [frame for k in range(COUNT) if (frame := Folder(str(folder), camera=str(folder / "as_read.yaml"))(k)) is not None]
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    (tmp_path / "camera.yaml").write_text((folder / "camera.yaml").read_text())
    for number, k in enumerate((0, 1, 2, 2, 2, 2, 2, 2, 3, 4)):
        write_frame(tmp_path, number, frames[k])
    reader = Folder(str(tmp_path))
    found = [reader(number) for number in range(10)]
    assert all(same(found[number], found[2]) for number in range(3, 8)) and not same(found[8], found[2])
    assert same(Folder(str(tmp_path))(7), found[7])


def test_where_the_rate_is_not_known_a_frame_is_as_it_was(seen: Callable[[float], list[Frame]]) -> None:
    frames = seen(READOUT_S)[:3]
    of = frames[0].camera, READOUT_S, READOUT_S
    looks = {k: look_at(k, frame.stamp_ns, frame.color) for k, frame in enumerate(frames)}
    assert not same(SteadyFrames(*of, looks.get)(2, frames[2]), frames[2])
    assert not same(SteadyFrames(*of, looks.get)(0, frames[0]), frames[0])  # by the second frame
    assert same(SteadyFrames(*of, {2: looks[2]}.get)(2, frames[2]), frames[2])
    late = {k: look._replace(stamp_ns=round(1.1 * k * LONGEST_S * 1e9)) for k, look in looks.items()}
    assert same(SteadyFrames(*of, late.get)(2, replace(frames[2], stamp_ns=late[2].stamp_ns)), frames[2])
    blank = {k: look._replace(small=np.zeros_like(look.small)) for k, look in looks.items()}
    black = replace(frames[1], color=np.zeros_like(frames[1].color))
    assert same(SteadyFrames(*of, blank.get)(1, black), black)


def test_a_camera_at_rest_has_the_images_as_they_were_read(tmp_path: Path) -> None:
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    room = Synthetic("0:3", width=320, height=240, motion=simulated_sensor.Motion.still)
    frames = [frame for k in range(3) if (frame := room(k)) is not None]
    for k, frame in enumerate(frames):
        write_frame(tmp_path, k, frame)
    (tmp_path / "camera.yaml").write_text(camera_keys(frames[0].camera, READOUT_S))
    reader = Folder(str(tmp_path))
    assert all((found := reader(k)) is not None and found.color.tobytes() == frames[k].color.tobytes() for k in range(3))


def test_an_image_before_that_cannot_be_read_is_not_reported_twice(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
        for file in sorted((folder / name).iterdir()):
            (tmp_path / name / file.name).write_bytes(b"" if (name, file.stem) == ("rgb", "0002") else file.read_bytes())
    (tmp_path / "camera.yaml").write_text((folder / "camera.yaml").read_text())
    reader, read = Folder(str(tmp_path)), Folder(str(folder), camera=str(folder / "as_read.yaml"))
    with caplog.at_level(logging.WARNING):
        found = [reader(k) for k in range(COUNT)]
    assert [frame is None for frame in found] == [False, False, True, False, False, False]
    assert len(caplog.messages) == 1 and not any(same(found[k], read(k)) for k in (3, 4))  # by the image after it, and before it


def test_pushed_images_become_the_frames_of_a_folder_from_the_second_one_on(folder: Path) -> None:
    camera = Camera.from_yaml(folder / "camera.yaml")
    assert (camera.readout_s, camera.depth_readout_s) == (READOUT_S, READOUT_S) and Camera.of(camera.calibration) == camera
    pushed, steady, read = Frames(camera), Folder(str(folder)), Folder(str(folder), camera=str(folder / "as_read.yaml"))
    for k in range(COUNT):
        image = read(k)
        assert image is not None and same(pushed(k, image.stamp_ns, image.color, image.depth_m), steady(k) if k else image)


def test_a_stream_that_freezes_stays_equal_however_long(seen: Callable[[float], list[Frame]]) -> None:
    """A camera that pushes frames cannot be asked for earlier ones."""
    frames = seen(READOUT_S)
    steady = SteadyFrames(frames[0].camera, READOUT_S, READOUT_S, lambda number: None)
    found = [steady(number, replace(frames[min(number, 2)], stamp_ns=round(number * 1e9 / 30.0))) for number in range(12)]
    assert all(same(frame, found[2]) for frame in found[3:]) and not same(found[2], frames[2])


@pytest.mark.parametrize("focal", [1e-3, 1.0, 1e6])
def test_an_absurd_focal_length_is_no_error(seen: Callable[[float], list[Frame]], focal: float) -> None:
    frames = seen(READOUT_S)[:3]
    camera = replace(frames[0].camera, fx=focal, fy=focal)
    looks = {k: look_at(k, frame.stamp_ns, frame.color) for k, frame in enumerate(frames)}
    found = SteadyFrames(camera, READOUT_S, READOUT_S, looks.get)(2, frames[2])
    assert np.isfinite(found.depth_m).all() and (found.depth_m >= 0.0).all()


def test_depth_with_stamps_of_its_own_is_turned_to_the_time_of_its_colour(seen: Callable[[float], list[Frame]], tmp_path: Path) -> None:
    """Colour of every second frame with the depth of the one after it, as the lists say: turned, depth is nearer to that of the colour's time."""
    frames, period_s, later_s = seen(0.0), 0.07, 0.033
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    for k in range(0, COUNT, 2):
        write_frame(tmp_path, k // 2, replace(frames[k], depth_m=frames[k + 1].depth_m))

    def images(stated_s: float, delay_s: float) -> list[Frame]:
        for name, offset_s in (("rgb", 0.0), ("depth", stated_s)):
            lines = [f"{100.0 + k * period_s + offset_s:.6f} {name}/{k:04d}.png\n" for k in range(COUNT // 2)]
            (tmp_path / f"{name}.txt").write_text("".join(lines))
        (tmp_path / "camera.yaml").write_text(camera_keys(frames[0].camera, 0.0) + f"depth_delay_s: {delay_s:.6f}\n")
        reader = Tum(str(tmp_path), max_difference_ms=40.0)
        return [frame for k in range(len(reader)) if (frame := reader(k)) is not None]

    errors = []
    for found in (images(0.0, 0.0), images(later_s, 0.0)):
        z, truth = (np.array([frame.depth_m for frame in those])[:, 20:-20, 20:-20] for those in (found, frames[::2]))
        errors.append(np.abs(z - truth)[(z > 0.0) & (truth > 0.0)].mean())
    assert errors[1] < 0.6 * errors[0]
    assert all(same(a, b) for a, b in zip(images(later_s, 0.0), images(later_s - 0.013, 0.013), strict=True))


def test_published_kinects_have_a_rolling_shutter() -> None:
    assert {name: preset.readout_s for name, preset in PRESETS.items()} == {
        "tum_fr1": 0.02, "tum_fr2": 0.02, "tum_fr3": 0.02, "seven_scenes": 0.02, "icl_nuim": 0.0,
    }  # fmt: skip
