"""What goes into a run besides its graph, and what comes out of it."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from trihedron.pipeline.recording import Recording
from trihedron.pipeline.types import Map, Pose, Value


@dataclass(frozen=True)
class Replay:
    """A recording to read from, the stages to compute again, and whether delayed wires of those see the recorded past."""

    recording: Recording
    only: tuple[str, ...]
    recorded_feedback: bool = False


class Poses(Sequence[Pose]):
    """Poses in frame order, kept as numbers: as values they take twice the memory, and of a long run there are many."""

    _REALS, _WHOLE = 16 + 36 + 16, 9  # numbers a pose

    def __init__(self, poses: Iterable[Pose] = ()) -> None:
        self._reals, self._whole = array("d"), array("q")
        self._said: list[tuple[str, str]] = []
        for pose in poses:
            self.append(pose)

    def append(self, pose: Pose) -> None:
        """One more."""
        for matrix in (pose.T_world_camera, pose.covariance, pose.T_reference_camera):
            self._reals.frombytes(matrix.tobytes())
        counts = pose.inliers.tolist()
        self._whole.extend((pose.index, pose.stamp_ns, pose.reference, *counts, pose.unobservable, pose.submap, pose.unrecognised))
        self._said.append((pose.status, pose.reason))

    def __len__(self) -> int:
        return len(self._said)

    @overload
    def __getitem__(self, at: int) -> Pose: ...

    @overload
    def __getitem__(self, at: slice) -> list[Pose]: ...

    def __getitem__(self, at: int | slice) -> Pose | list[Pose]:
        """The pose, or poses, at a place."""
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        status, reason = self._said[at]
        k = at % len(self)
        reals = np.array(self._reals[k * self._REALS : (k + 1) * self._REALS])
        index, stamp_ns, reference, *inliers, unobservable, submap, unrecognised = self._whole[k * self._WHOLE : (k + 1) * self._WHOLE]
        T, covariance, T_reference = reals[:16].reshape(4, 4), reals[16:52].reshape(6, 6), reals[52:].reshape(4, 4)
        counts = np.array(inliers, np.int32)
        return Pose(index, stamp_ns, T, covariance, T_reference, reference, counts, unobservable, status, reason, submap, unrecognised)


@dataclass
class Result:
    """What a run leaves in memory: poses in frame order, the last map, results of folds, counts."""

    poses: Poses = field(default_factory=Poses)
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
