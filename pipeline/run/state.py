"""What a run remembers: the values its delayed wires hold. Saved after the last frame, another run goes on from there.

A map file is a recording (MCAP) with the metadata `kind: map`, `map_version`, `frame`, the last frame's number, and `source`, what was tracked. Its
topics are those that delayed wires read, each with the values that the next frame may still ask for; `map` is one of them. A run that
goes on with the next frame of the same source takes them all and gives what one run would have given. Any other run takes the map alone, with the
directions of its axes: its camera is lost until it is recognised.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.graph import Stage
from trihedron.pipeline.core.types import LOST, Map, Pose, Rotation, Table, Value
from trihedron.pipeline.core.wires import PREVIOUS
from trihedron.pipeline.record.recording import FRAMES_TOPIC, Recording, RecordingWriter, TopicReader

MAP_VERSION = "1"
SAVE_ONE = "save one with: trihedron run save_map=FILE.mcap"


@dataclass(frozen=True)
class Memory:
    """`held`: topic -> the latest value before the first frame, for `@prev`; `recent`: topic -> frame number -> value, for `@k`."""

    held: Mapping[str, Value] = field(default_factory=dict)
    recent: Mapping[str, Mapping[int, Value]] = field(default_factory=dict)

    def updated(self, other: Memory, prefix: str) -> Memory:
        """This with the topics of another, and all of them once more under names with a prefix."""
        held, recent = {**self.held, **other.held}, {**self.recent, **other.recent}
        more = {prefix + topic: value for topic, value in held.items()}
        return Memory({**held, **more}, {**recent, **{prefix + topic: values for topic, values in recent.items()}})


@dataclass(frozen=True)
class SavedMap:
    """A map file's content: the last frame's number, what was tracked, and the values of each topic in frame order."""

    frame: int
    source: str
    values: Mapping[str, tuple[Value, ...]]

    @property
    def map(self) -> Map:
        """The map itself."""
        latest = self.values["map"][-1]
        assert isinstance(latest, Map)
        return latest

    def memory(self, first: int, source: str) -> Memory:
        """What a run that begins with frame `first` of `source` remembers of it."""
        if first == self.frame + 1 and source == self.source:
            recent = {topic: {value.index: value for value in values} for topic, values in self.values.items()}
            return Memory({topic: values[-1] for topic, values in self.values.items()}, recent)
        held: dict[str, Value] = {"map": self.map, "pose": _nowhere(first - 1)}
        for value in self.values.get("rotation", ())[-1:]:
            if isinstance(value, Rotation):
                held["rotation"] = replace(value, index=first - 1, covariance=np.pi**2 * np.eye(3), source="prediction")
        return Memory(held)


def _nowhere(index: int) -> Pose:
    """The pose of a camera that has seen nothing of the map yet."""
    reason = "the map was loaded, and nothing of it was recognised yet"
    return Pose(index, 0, np.eye(4), np.pi**2 * np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, LOST, reason)


def reaches(stages: Iterable[Stage]) -> dict[str, int]:
    """Topic -> how many frames back delayed wires read it; 1 where only `@prev` does."""
    found: dict[str, int] = {}
    for stage in stages:
        for wire in stage.inputs.values():
            if wire.delay:
                found[wire.topic] = max(found.get(wire.topic, 1), 1 if wire.delay == PREVIOUS else wire.delay)
    return found


class Keeper:
    """Collects, frame by frame, what a map file will hold."""

    def __init__(self, reach: Mapping[str, int], before: Memory, first: int) -> None:
        self._reach = reach
        self._values: dict[str, dict[int, Value]] = {topic: dict(before.recent.get(topic, {})) for topic in reach}
        for topic in reach:
            if (held := before.held.get(topic)) is not None:
                self._values[topic][min(held.index, first - 1)] = held  # of another sequence, its number says nothing here
            self._values[topic] = dict(sorted(self._values[topic].items()))
        self.frame = first - 1

    def see(self, index: int, values: Mapping[str, Any]) -> None:
        """The values of the next frame."""
        self.frame = index
        for topic, reach in self._reach.items():
            kept = self._values[topic]
            if isinstance(value := values.get(topic), Value):
                kept[index] = value
            while len(kept) > 1 and (oldest := next(iter(kept))) <= index - reach:
                del kept[oldest]

    def save(self, path: Path, metadata: Mapping[str, str], source: str) -> None:
        """Write the file, whole or not at all. Raises RecordingError when there is no map or the file cannot be written."""
        if not self._values.get("map"):
            raise RecordingError(str(path), "cannot be saved: the run made no map", "choose a graph with a map")
        partial = path.with_name(path.name + ".part")
        described = {"kind": "map", "map_version": MAP_VERSION, "frame": str(self.frame), "source": source}
        try:
            writer = RecordingWriter(partial, {**metadata, **described})
            try:
                for topic in sorted(self._values):
                    for value in self._values[topic].values():
                        writer.write(topic, value)
            finally:
                writer.close()
        except RecordingError as error:
            partial.unlink(missing_ok=True)
            raise RecordingError(str(path), error.cause, "give another save_map=FILE.mcap") from error
        os.replace(partial, path)


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
        _check(saved.map)
    except (KeyError, ValueError, IndexError, TypeError, AssertionError) as error:
        raise RecordingError(path, f"holds a map that does not fit together: {error}", "the file is damaged; make the map anew") from error
    return saved


def _check(map: Map) -> None:
    """Raise ValueError or KeyError where a row names another that is not there: a file is not to be trusted."""
    sizes = {"keyframe": len(map.keyframes), "point": len(map.points), "line": len(map.lines), "plane": len(map.planes)}
    for kind in ("point", "line", "plane"):
        seen, landmarks = getattr(map, f"{kind}_observations"), getattr(map, f"{kind}s")
        _inside(seen, "keyframe", 0, sizes["keyframe"])
        _inside(seen, kind, 0, sizes[kind])
        _inside(landmarks, "observers", -1, sizes["keyframe"])
        _inside(landmarks, "first", 0, sizes["keyframe"])
        _inside(map.keyframes, f"{kind}s", 0, len(seen) + 1)
        landmarks.column("alive")
    if not np.isfinite(map.keyframes.column("T_world_camera")).all():
        raise ValueError("a keyframe's pose is not finite")


def _inside(table: Table, column: str, low: int, stop: int) -> None:
    values = table.column(column)
    if values.size and (values.min() < low or values.max() >= stop):
        raise ValueError(f"column '{column}' names rows that are not there")


def recorded_memory(recording: Recording, reach: Mapping[str, int], first: int) -> Memory:
    """What the wires of a run that begins with frame `first` would hold of the topics of a recording, had it run from the start."""
    held: dict[str, Value] = {}
    recent: dict[str, dict[int, Value]] = {}
    frames = sorted({value.index for value in recording.values(FRAMES_TOPIC) if value.index < first})  # a live run did not take them all
    for topic in sorted(set(reach) & recording.topics):
        reader = TopicReader(recording, topic)
        recent[topic] = {}
        for ago in range(min(reach[topic], len(frames)), 0, -1):
            if (value := reader.at(frames[-ago])) is not None:
                recent[topic][first - ago] = value
        reader.at(first)
        if (latest := recent[topic][max(recent[topic])] if recent[topic] else reader.latest) is not None:
            held[topic] = latest
    return Memory(held, recent)
