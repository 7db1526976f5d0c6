"""Map files: the state of a run after its last frame, from which another run continues.

A map file is a recording (MCAP) with the metadata `kind: map`, `map_version`, `frame`, the last frame's number, and `source`, the data set. Its
topics are those that delayed wires read, each with the values that the next frame may still read; `map` is one of them. A run that continues with
the next frame of the same source takes them all and gives the values of one uninterrupted run. Any other run takes the map alone, with the
directions of its axes: its camera is lost until it is recognised.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.types import LOST, Map, Pose, Rotation, Value
from trihedron.pipeline.record.mcap_writer import new_recording
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.state import DelayLines, StateBuffer

MAP_VERSION = "1"
SAVE_ONE = "save one with: trihedron run save_map=FILE.mcap"


@dataclass(frozen=True)
class SavedMap:
    """The content of a map file: the last frame's number, the data set, and the values of each topic in frame order."""

    frame: int
    source: str
    values: Mapping[str, tuple[Value, ...]]

    @property
    def map(self) -> Map:
        """The map itself."""
        latest = self.values["map"][-1]
        assert isinstance(latest, Map)
        return latest

    def delay_lines(self, first: int, stride: int, source: str) -> DelayLines:
        """Return the values that a run starts from which begins with frame `first` of `source` and takes every `stride`-th."""
        if first == self.frame + stride and source == self.source:
            recent = {topic: {(value.index - first) // stride: value for value in values} for topic, values in self.values.items()}
            return DelayLines({topic: values[-1] for topic, values in self.values.items()}, recent)
        held: dict[str, Value] = {"map": self.map, "pose": lost_pose(first - 1)}
        for value in self.values.get("rotation", ())[-1:]:
            if isinstance(value, Rotation):
                held["rotation"] = replace(value, index=first - 1, covariance=np.pi**2 * np.eye(3), source="prediction")
        return DelayLines(held)


def lost_pose(index: int) -> Pose:
    """Make the pose of a camera that has recognised nothing of the map yet."""
    reason = "the map was loaded, and nothing of it was recognised yet"
    return Pose(index, 0, np.eye(4), np.pi**2 * np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, LOST, reason)


def save_map(path: Path, state: StateBuffer, metadata: Mapping[str, str], source: str) -> None:
    """Write the state of a run, whole or not at all. Raises RecordingError when there is no map or the file cannot be written."""
    if not state.values.get("map"):
        raise RecordingError(str(path), "cannot be saved: the run made no map", "choose a graph with a map")
    described = {"kind": "map", "map_version": MAP_VERSION, "frame": str(state.frame), "source": source}
    with new_recording(path, "give another save_map=FILE.mcap") as new:
        writer = RecordingWriter(new, {**metadata, **described})
        try:
            for topic in sorted(state.values):
                for value in state.values[topic].values():
                    writer.write(topic, value)
        finally:
            writer.close()


def load_map(path: str) -> SavedMap:
    """Read a map file, checked. Raises RecordingError when it is missing, damaged, of another version or not a map."""
    if not Path(path).is_file():
        raise RecordingError(path, "there is no such map", SAVE_ONE)
    recording = Recording(path)
    if recording.metadata.get("kind") != "map":
        raise RecordingError(path, "is a recording, not a saved map", SAVE_ONE)
    version = recording.metadata.get("map_version")
    if version != MAP_VERSION:
        raise RecordingError(path, f"is a map of version {version}, this program reads version {MAP_VERSION}", "make the map anew")
    values = {topic: tuple(recording.values(topic)) for topic in sorted(recording.topics)}
    try:
        saved = SavedMap(int(recording.metadata["frame"]), recording.metadata["source"], values)
        assert isinstance(saved.map, Map)
    except (KeyError, ValueError, IndexError, TypeError, AssertionError) as error:
        raise RecordingError(path, f"holds a map that does not fit together: {error}", "the file is damaged; make the map anew") from error
    return saved
