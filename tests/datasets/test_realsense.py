"""dataset=realsense with a module in the place of the maker's."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trihedron.datasets.readers.realsense import RealSense
from trihedron.pipeline.core.errors import DataError, LibraryError
from trihedron.pipeline.core.types import DepthNoise
from trihedron.pipeline.run.live import is_camera

SPACE_S = 0.01


class Image:
    def __init__(self, data: np.ndarray, stamp_ms: float) -> None:
        self._data, self._stamp_ms = data, stamp_ms

    def get_data(self) -> np.ndarray:
        return self._data

    def get_timestamp(self) -> float:
        return self._stamp_ms


class Pipeline:
    """Frame k, all of colour k, comes every 10 ms; after `ends` frames the plug is pulled."""

    ends, coeffs, starts, calls, stereo = 1000, [0.0] * 5, 0, 0, True
    asked: list[Any] = []  # noqa: RUF012  what the configuration enabled

    def start(self, config: Any) -> Any:
        if Pipeline.ends < 0:
            raise RuntimeError("No device connected")
        Pipeline.starts += 1
        Pipeline.asked = config
        self._count = Pipeline.calls = 0
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025, supports=lambda option: Pipeline.stereo, get_option={"stereo_baseline": 50.0}.get)
        lens = SimpleNamespace(width=8, height=6, fx=5.0, fy=6.0, ppx=3.5, ppy=2.5, coeffs=Pipeline.coeffs, model="distortion.inverse_brown_conrady")
        video = SimpleNamespace(get_intrinsics=lambda: lens)
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: video),
        )

    def wait_for_frames(self, timeout_ms: int) -> Any:
        Pipeline.calls += 1
        time.sleep(SPACE_S)
        k, self._count = self._count, self._count + 1
        if k >= Pipeline.ends:
            raise RuntimeError("Frame didn't arrive within 5000")
        color, depth = np.full((6, 8, 3), k % 256, np.uint8), np.full((6, 8), 4000 + k, np.uint16)
        return SimpleNamespace(get_color_frame=lambda: Image(color, 1e12 + 10.0 * k), get_depth_frame=lambda: Image(depth, 1e12 + 10.0 * k))

    def stop(self) -> None:
        Pipeline.ends = 0


def wait_until_taken(number: int) -> None:
    """Wait until the reader has taken this frame: it asks for the one after it. pytest-timeout ends a wait in vain."""
    while Pipeline.calls < number + 2:
        time.sleep(SPACE_S / 10)


class Config(list[Any]):
    def enable_stream(self, *words: Any) -> None:
        self.append(words)

    def enable_device(self, serial: str) -> None:
        self.append(serial)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(
        pipeline=Pipeline, config=Config, align=lambda stream: SimpleNamespace(process=lambda pair: pair),
        stream=SimpleNamespace(color="color", depth="depth"), format=SimpleNamespace(rgb8="rgb8", z16="z16"),
        option=SimpleNamespace(stereo_baseline="stereo_baseline"),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    Pipeline.ends, Pipeline.coeffs = 1000, [0.0] * 5


def test_the_newest_frame_is_given_and_the_others_dropped(library: None) -> None:
    camera = RealSense(serial="42", width=8, height=6)
    assert is_camera(camera) and camera.truth() is None
    camera.start()
    assert Pipeline.asked == ["42", ("color", 8, 6, "rgb8", 30), ("depth", 8, 6, "z16", 30)]
    first = camera.wait(-1)
    assert first is not None
    wait_until_taken(first.number + 3)
    late = camera.wait(first.number)
    assert late is not None and late.number >= first.number + 3 and late.at_s > first.at_s
    frame = camera(late.number)
    assert frame is not None and frame.index == late.number and (frame.color == late.number % 256).all()
    assert frame.stamp_ns == round((1e12 + 10.0 * late.number) * 1e6)
    assert np.allclose(frame.depth_m, (4000 + late.number) * 0.00025) and (frame.camera.fx, frame.camera.cy) == (5.0, 2.5)
    assert camera(first.number) is None  # gone
    camera.stop()


@pytest.mark.parametrize("stereo", [True, False])
def test_depth_is_as_noisy_as_that_of_the_camera(library: None, monkeypatch: pytest.MonkeyPatch, stereo: bool) -> None:
    """A stereo camera states its baseline, here 50 mm with a focal length of 5 px; one with a laser scanner does not."""
    monkeypatch.setattr(Pipeline, "stereo", stereo)
    camera = RealSense()
    camera.start()
    arrival = camera.wait(-1)
    frame = camera(arrival.number) if arrival is not None else None
    assert frame is not None
    assert frame.camera.depth_noise == (DepthNoise(0.0, 0.0, 0.1 / (5.0 * 0.05), 0.001) if stereo else DepthNoise())
    camera.stop()


def test_the_run_ends_with_enough_frames_or_the_plug(library: None) -> None:
    camera = RealSense(frames="0:3")
    camera.start()
    numbers = []
    while (arrival := camera.wait(numbers[-1] if numbers else -1)) is not None:
        numbers.append(arrival.number)
    assert numbers and numbers[-1] <= 2
    camera.stop()
    Pipeline.ends = 2
    gone = RealSense()
    gone.start()
    wait_until_taken(1)
    last = gone.wait(-1)
    assert last is not None and last.number == 1 and gone.wait(1) is None
    gone.stop()


def test_refusals(library: None, monkeypatch: pytest.MonkeyPatch) -> None:
    Pipeline.ends = -1
    with pytest.raises(DataError, match="dataset=realsense: the camera does not start: No device connected; plug it in"):
        RealSense().start()
    Pipeline.ends, Pipeline.coeffs = 1000, [0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(DataError, match=r"the distortion model 'distortion.inverse_brown_conrady' is not known"):
        RealSense().start()
    with pytest.raises(ValueError, match="frames: a camera begins with frame 0"):
        RealSense(frames="3:")
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(LibraryError) as caught:
        RealSense().start()
    assert str(caught.value) == "pyrealsense2: is not installed; install it with: pip install 'trihedron[realsense]'"
