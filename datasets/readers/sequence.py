"""Sequences of colour and depth files, and the base of readers of folders."""

from __future__ import annotations

import logging
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.readers.images import check_camera, check_size, read_color, read_depth
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.rolling_shutter import Look, SteadyFrames, look_at
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import one_line_errors
from trihedron.pipeline.core.options import Frames, frame_range
from trihedron.pipeline.core.types import F32, U8, Frame, Trajectory

log = logging.getLogger("trihedron")
CURE = "check the files of the data set"
_FRAMES = "as rgb/00000.png and 16-bit depth/00000.png with a camera.yaml"
_NO_DEPTH = f"a film has no metric depth; save the camera's frames {_FRAMES}"
VIDEOS = {  # ending -> what gets the frames out
    ".mkv": f"write its frames with Open3D's azure_kinect_mkv_reader {_FRAMES}",
    ".svo": f"write its frames with the ZED SDK's export sample {_FRAMES}",
    ".svo2": f"write its frames with the ZED SDK's export sample {_FRAMES}",
    ".oni": f"write its frames with OpenNI {_FRAMES}",
    **dict.fromkeys((".mp4", ".mov", ".avi", ".webm", ".m4v"), _NO_DEPTH),
}
DepthReader = Callable[[Path], F32]


@dataclass(frozen=True)
class ImageSequence:
    """Pairs of files with their stamps, read as frames. `numbers` are those of the pairs in the whole data set, which is `whole` where these are a
    part of it, and has `depth_later_ns`, by how much the stamp of each depth image is later than that of colour; `depth_reader` replaces the reading
    of 16-bit images, `color_reader` that of colour. Frames are not cached: memory does not grow with the sequence."""

    stamps_ns: NDArray[np.int64]
    color_files: Sequence[Path]
    depth_files: Sequence[Path]
    calibration: Calibration
    truth: Trajectory | None = None
    numbers: range = range(sys.maxsize)
    depth_reader: DepthReader | None = None
    color_reader: Callable[[Path], U8] = read_color
    whole: ImageSequence | None = None
    depth_later_ns: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frame(self, position: int) -> Frame | None:
        """Read pair `position`, undistorted, without the skew of a rolling shutter whose readout time is stated; None, after one warning, when a file
        cannot be read. Raises DataError for images of a wrong kind."""
        try:
            color = self._read(self.color_files[position], self.color_reader)
            depth = self._read(self.depth_files[position], self.depth_reader or self._read_depth)
        except UnreadableImage as error:
            log.warning("%s; frame %d is skipped", error, self.numbers[position])
            return None
        self._check_sizes(position, color, depth)
        color, depth = self.calibration.rectification.color(color), self.calibration.rectification.depth(depth)
        frame = Frame(self.numbers[position], int(self.stamps_ns[position]), color, depth, self.calibration.camera)
        return self._steady(frame.index, frame) if self._steady is not None else frame

    @cached_property
    def _steady(self) -> SteadyFrames | None:
        whole = self.whole or self
        return self.calibration.steady_frames(whole._look, whole.depth_later_ns)

    def _look(self, position: int) -> Look | None:
        """The look of a frame of the whole data set; None where there is none, or none that can be read."""
        if position >= len(self):
            return None
        try:
            color = self._read(self.color_files[position], self.color_reader)
        except UnreadableImage:
            return None
        fits = color.shape[:2] == (self.calibration.camera.height, self.calibration.camera.width)
        return look_at(position, int(self.stamps_ns[position]), self.calibration.rectification.color(color)) if fits else None

    def _read(self, path: Path, reader: Callable[[Path], Any]) -> Any:
        try:
            return reader(path)
        except UnreadableImage as error:
            raise UnreadableImage(f"{path}: {error}") from error

    def _read_depth(self, path: Path) -> F32:
        return read_depth(path, self.calibration.depth_scale)

    def _check_sizes(self, position: int, color: U8, depth: F32) -> None:
        path = self.color_files[position]
        height, width = color.shape[:2]
        check_size(self.depth_files[position], depth, width, height, f"its colour image {path.name}", "register depth to colour first")
        check_camera(path, color, self.calibration.camera)


@dataclass(frozen=True)
class SequenceReader(ABC):
    """A folder that is an ImageSequence: what its readers share. Frames are numbered as in the whole data set."""

    path: str = ""  # folder of the sequence
    frames: Frames = ""  # part to read, half open: A:B, A:, :B, every S-th A:B:S; empty = all

    @abstractmethod
    def _open(self, folder: Path) -> ImageSequence:
        """List the whole sequence. Raises DataError when the folder cannot be used."""

    def _place(self) -> Path:
        """The folder. Raises DataError when it cannot be one."""
        return open_folder(self.path)

    @cached_property
    def _sequence(self) -> ImageSequence:
        folder = self._place()
        with one_line_errors(str(folder), CURE):
            return select_frames(self._open(folder), self.frames, str(folder))

    def __len__(self) -> int:
        return len(self._sequence)

    def __call__(self, index: int) -> Frame | None:
        """Read frame `index` of the selection, or None when one of its files cannot be read. Raises DataError for images of a wrong kind."""
        with one_line_errors(str(self._sequence.color_files[index]), CURE):
            return self._sequence.frame(index)

    def calibration(self) -> Calibration:
        """Return what the images are converted with."""
        return self._sequence.calibration

    def truth(self) -> Trajectory | None:
        """Return the ground truth that lies with the images, as published but with y down."""
        return self._sequence.truth


def refuse_video(path: Path) -> None:
    """Raise DataError, with the cure, for a video file: its depth is lost, or in a stream of the camera's maker."""
    cure = VIDEOS.get(path.suffix.lower())
    if cure is not None:
        raise DataError(str(path), "is a video file, which is not read", f"{cure}, then use dataset=folder")


def open_folder(path: str) -> Path:
    """The data set's folder. Raises DataError when the path is not set, missing, a file or empty."""
    if not path:
        raise DataError("dataset.path", "is not set", "give dataset.path=FOLDER")
    folder = Path(path).expanduser()
    if not folder.exists():
        raise DataError(str(folder), "does not exist", "give an existing folder as dataset.path")
    refuse_video(folder)
    if not folder.is_dir():
        raise DataError(str(folder), "is not a folder", "give the folder that holds the images as dataset.path")
    with one_line_errors(str(folder), "check the folder's permissions"):
        empty = not any(folder.iterdir())
    if empty:
        raise DataError(str(folder), "is empty", "give the folder that holds the images as dataset.path")
    return folder


def first_size(files: list[Path], depth_scale: float) -> tuple[int, int]:
    """Height and width of the first depth image that can be read. Raises DataError when none can."""
    for file in files:
        try:
            shape = read_depth(file, depth_scale).shape
            return shape[0], shape[1]
        except UnreadableImage:
            continue
    raise DataError(str(files[0].parent), "holds no depth image that can be read", "export the scan again")


def select_frames(sequence: ImageSequence, frames: str, place: str) -> ImageSequence:
    """The half-open part `frames` ("A:B" or "A:B:S") of a whole sequence; B beyond the end means the end. Raises DataError when A is beyond it."""
    numbers = clip_range(frames, len(sequence), place)
    part = slice(numbers.start, numbers.stop, numbers.step)
    return replace(
        sequence,
        stamps_ns=sequence.stamps_ns[part],
        color_files=sequence.color_files[part],
        depth_files=sequence.depth_files[part],
        numbers=numbers,
        whole=sequence,
    )


def clip_range(frames: str, count: int, place: str) -> range:
    """The numbers of the frames that the field `frames` chooses of a data set of `count`. Raises DataError when none is left."""
    chosen = frame_range(frames)
    if chosen.start >= count:
        raise DataError("dataset.frames", f"'{frames}' begins beyond the {count} frames of {place}", f"give a range within 0:{count}")
    if count < chosen.stop < sys.maxsize:
        log.warning("dataset.frames: '%s' ends beyond the %d frames of %s", frames, count, place)
    return range(chosen.start, min(count, chosen.stop), chosen.step)
