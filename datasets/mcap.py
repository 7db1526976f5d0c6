"""Frames out of a recording of this program (`record.frames=true`, or `trihedron convert`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from trihedron.datasets.trajectories import attached_truth
from trihedron.pipeline.errors import DataError
from trihedron.pipeline.recording import FrameReader, Recording
from trihedron.pipeline.registry import register
from trihedron.pipeline.slots import frame_range
from trihedron.pipeline.types import Frame, Trajectory


@register("dataset", "mcap")
@dataclass(frozen=True)
class McapDataset:
    """Embedded frames of a recording, bit for bit, with the ground truth attached to it.

    Raises DataError when the file holds no frames, RecordingError when it is missing, damaged or not ours."""

    path: str = ""  # FILE.mcap
    frames: str = ""  # half-open range of frame numbers "A:B"

    def __post_init__(self) -> None:
        frame_range(self.frames)

    @cached_property
    def _recording(self) -> Recording:
        if not self.path:
            raise DataError("dataset.path", "is not set", "give dataset.path=FILE.mcap")
        recording = Recording(Path(self.path))
        if "dataset" not in recording.topics:
            raise DataError(self.path, "holds no frames", "record them with record.frames=true, or use trihedron convert")
        return recording

    @cached_property
    def _stamps(self) -> list[int]:
        """Stamps of the chosen frames; a frame's number is its place in the recording."""
        start, stop = frame_range(self.frames)
        stamps = [value.stamp_ns for value in self._recording.values("frames")][start:stop]
        if not stamps:
            raise DataError(self.path, f"has none of the frames '{self.frames}'", "give another dataset.frames")
        return stamps

    @cached_property
    def _reader(self) -> FrameReader:
        return FrameReader(self._recording, "dataset")

    def __len__(self) -> int:
        return len(self._stamps)

    def __call__(self, index: int) -> Frame | None:
        value = self._reader.at(self._stamps[index])
        return replace(value, index=frame_range(self.frames)[0] + index) if isinstance(value, Frame) else None

    def truth(self) -> Trajectory | None:
        """The attached ground truth."""
        return attached_truth(self._recording.attachments, self.path)
