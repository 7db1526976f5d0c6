"""What goes into a run besides its graph, and what comes out of it."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Map, Pose, Value
from trihedron.pipeline.record.recording import Recording


@dataclass(frozen=True)
class Replay:
    """A recording to read from, the stages to compute again, and whether delayed wires of those see the recorded past."""

    recording: Recording
    only: tuple[str, ...]
    recorded_feedback: bool = False


class Poses(Sequence[Pose]):
    """Poses in frame order, kept as numbers, without those that a rigid motion and a symmetric covariance imply: of a long run there are many."""

    _REALS, _WHOLE = 12 + 12 + 21, 11  # numbers a pose
    _STATUSES = (OK, DEGRADED, LOST)
    _UPPER = np.triu_indices(6)
    _LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])

    def __init__(self, poses: Iterable[Pose] = ()) -> None:
        self._reals, self._whole, self._reasons = array("d"), array("q"), bytearray()
        for pose in poses:
            self.append(pose)

    def append(self, pose: Pose) -> None:
        """One more."""
        for numbers in (pose.T_world_camera[:3], pose.T_reference_camera[:3], pose.covariance[self._UPPER]):
            self._reals.frombytes(numbers.tobytes())
        self._reasons += pose.reason.encode()
        counts = pose.inliers.tolist()
        self._whole.extend((pose.index, pose.stamp_ns, pose.reference, *counts, pose.unobservable, pose.submap, pose.unrecognised))
        self._whole.extend((self._STATUSES.index(pose.status), len(self._reasons)))

    def __len__(self) -> int:
        return len(self._whole) // self._WHOLE

    @overload
    def __getitem__(self, at: int) -> Pose: ...

    @overload
    def __getitem__(self, at: slice) -> list[Pose]: ...

    def __getitem__(self, at: int | slice) -> Pose | list[Pose]:
        """The pose, or poses, at a place."""
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        k = range(len(self))[at]
        reals = np.array(self._reals[k * self._REALS : (k + 1) * self._REALS])
        T, T_reference = (np.vstack([rows.reshape(3, 4), self._LAST_ROW]) for rows in (reals[:12], reals[12:24]))
        covariance = np.empty((6, 6))
        covariance[self._UPPER] = covariance.T[self._UPPER] = reals[24:]
        index, stamp_ns, reference, *inliers, unobservable, submap, unrecognised, state, end = self._whole[k * self._WHOLE : (k + 1) * self._WHOLE]
        counts, reason = np.array(inliers, np.int32), self._reasons[self._whole[k * self._WHOLE - 1] if k else 0 : end].decode()
        status = self._STATUSES[state]
        return Pose(index, stamp_ns, T, covariance, T_reference, reference, counts, unobservable, status, reason, submap, unrecognised)


@dataclass
class Result:
    """What a run leaves in memory: poses in frame order, the last map, results of folds, counts."""

    poses: Poses = field(default_factory=Poses)
    map: Map | None = None
    loaded_keyframes: int = 0  # of another run, whose numbers say nothing here
    folds: dict[str, Value] = field(default_factory=dict)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))  # of every readable frame
    unreadable: int = 0
    fps: float = 30.0  # nominal, of the camera


@dataclass(frozen=True)
class Step:
    """One finished frame, as handed to whoever watches the run (progress, tests)."""

    position: int
    count: int
    index: int
    values: Mapping[str, Value | None]
