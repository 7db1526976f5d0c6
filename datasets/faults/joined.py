"""Two recordings joined to one: the second begins where the first ends, one frame later, at another place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from trihedron.pipeline.core.types import Frame, Trajectory

APART_M = 1000.0  # between both worlds in the truth: no pose of one is right in the other


@dataclass(frozen=True)
class Joined:
    """The first `count` frames of a data set, then all of another one. Raises ValueError where the first is shorter than `count`."""

    first: Any
    count: int
    second: Any

    def __post_init__(self) -> None:
        if self.count > len(self.first):
            raise ValueError(f"join: the first data set has {len(self.first)} frames only")

    def __len__(self) -> int:
        return self.count + len(self.second)

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of both, with stamps that go on."""
        frame: Frame | None = self.first(index) if index < self.count else self.second(index - self.count)
        if frame is None or index < self.count:
            return frame
        return replace(frame, index=index, stamp_ns=frame.stamp_ns + self._later_ns)

    def truth(self) -> Trajectory | None:
        """The poses of both, APART_M apart, at the stamps of the joined frames; None unless both have truth."""
        a, b = self.first.truth(), self.second.truth()
        if a is None or b is None:
            return None
        own = a.stamps_ns < self._begin_ns
        moved = b.poses.copy()
        moved[:, 0, 3] += APART_M
        return Trajectory(np.concatenate([a.stamps_ns[own], b.stamps_ns + self._later_ns]), np.concatenate([a.poses[own], moved]))

    @cached_property
    def _begin_ns(self) -> int:
        """Stamp of the first frame of the second data set."""
        last: Frame | None = next((frame for i in range(self.count - 1, -1, -1) if (frame := self.first(i)) is not None), None)
        return 0 if last is None else last.stamp_ns + round(1e9 / last.camera.fps)

    @cached_property
    def _later_ns(self) -> int:
        """Time added to the stamps of the second data set."""
        first: Frame | None = next((frame for i in range(len(self.second)) if (frame := self.second(i)) is not None), None)
        return 0 if first is None else self._begin_ns - first.stamp_ns
