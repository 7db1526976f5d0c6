"""What goes into a run besides its graph, and what comes out of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from trihedron.pipeline.recording import Recording
from trihedron.pipeline.types import Map, Pose, Value


@dataclass(frozen=True)
class Replay:
    """A recording to read from, the stages to compute again, and whether delayed wires of those see the recorded past."""

    recording: Recording
    only: tuple[str, ...]
    recorded_feedback: bool = False


@dataclass
class Result:
    """What a run leaves in memory: poses in frame order, the last map, results of folds, counts."""

    poses: list[Pose] = field(default_factory=list)
    map: Map | None = None
    loaded_keyframes: int = 0  # of another run, whose numbers say nothing here
    folds: dict[str, Value] = field(default_factory=dict)
    stamps_ns: list[int] = field(default_factory=list)  # of every readable frame
    unreadable: int = 0
    fps: float = 30.0  # nominal, of the camera


@dataclass(frozen=True)
class Step:
    """One finished frame, as handed to whoever watches the run (progress, tests)."""

    position: int
    count: int
    index: int
    values: Mapping[str, Value | None]
