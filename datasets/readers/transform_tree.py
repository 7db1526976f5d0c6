"""The tree of coordinate frames that a robot's transforms span, and transforms between any two of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.robot_values import Link
from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64


class TransformTree:
    """Each frame has one parent. Its transform is constant (`fixed`, and `moving` ones given only once) or interpolated between the times at
    which it is given, never beyond them."""

    def __init__(self, fixed: Iterable[Link], moving: Iterable[Link] = ()) -> None:
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, F64] = {}
        self._moving: dict[str, list[Link]] = defaultdict(list)
        for link in moving:
            if self._parents.setdefault(link.child, link.parent) == link.parent:
                self._moving[link.child].append(link)
        for link in fixed:
            self._parents[link.child] = link.parent
            self._fixed[link.child] = link.T_parent_child

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> F64 | None:
        """Return `T_target_source` at a time; None where the frames are not connected then. Without a time: of moving frames the first transform."""
        up_target, up_source = self._ancestors(target.lstrip("/")), self._ancestors(source.lstrip("/"))
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return None
        T_common_target, T_common_source = (self._chain(path[: path.index(common)], stamp_ns) for path in (up_target, up_source))
        if T_common_target is None or T_common_source is None:
            return None
        return np.asarray(matmul(invert(T_common_target), T_common_source))

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent and so on; a cycle ends the list."""
        path = [frame]
        seen = {frame}
        while (parent := self._parents.get(path[-1])) is not None and parent not in seen:
            path.append(parent)
            seen.add(parent)
        return path

    def _chain(self, frames: list[str], stamp_ns: int | None) -> F64 | None:
        """The transform from the first of the frames to the parent of the last."""
        T = np.eye(4)
        for frame in frames:
            step = self._fixed.get(frame)
            if step is None:
                step = self._at(frame, stamp_ns)
            if step is None:
                return None
            T = matmul(step, T)
        return T

    def _at(self, frame: str, stamp_ns: int | None) -> F64 | None:
        stamps, poses = self._sorted_links[frame]
        if stamp_ns is None or len(stamps) == 1:
            return np.asarray(poses[0])
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return np.asarray(poses[after])
        if after == 0 or after == len(stamps):
            return None
        before, span = after - 1, stamps[after] - stamps[after - 1]
        return interpolate(poses[before], poses[after], float(stamp_ns - stamps[before]) / float(span))

    @cached_property
    def _sorted_links(self) -> dict[str, tuple[NDArray[np.int64], F64]]:
        """Stamps (n,), increasing, and poses (n, 4, 4) of each moving frame."""
        found = {}
        for frame, links in self._moving.items():
            stamps, first = np.unique(np.array([link.stamp_ns for link in links], np.int64), return_index=True)
            found[frame] = (stamps, np.array([links[i].T_parent_child for i in first]))
        return found


def interpolate(T_a: F64, T_b: F64, share: float) -> F64:
    """Interpolate poses: positions linearly, rotations along the geodesic; `share` 0 gives `T_a`, 1 `T_b`."""
    R = matmul(T_a[:3, :3], exp_so3(share * log_so3(matmul(T_a[:3, :3].T, T_b[:3, :3]))))
    return np.asarray(pose_matrix(R, (1.0 - share) * T_a[:3, 3] + share * T_b[:3, 3]))
