"""The poses of a run, compact: a long run has hundreds of thousands."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np

from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Pose


class Poses(Sequence[Pose]):
    """A sequence of poses in frame order, stored as numbers: the rows of rigid motions and the upper triangles of covariances."""

    _REALS, _WHOLE = 12 + 12 + 21 + 21 + 2, 12  # numbers a pose
    _STATUSES = (OK, DEGRADED, LOST)
    _UPPER = np.triu_indices(6)
    _LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])

    def __init__(self, poses: Iterable[Pose] = ()) -> None:
        self._reals, self._whole, self._reasons = array("d"), array("q"), bytearray()
        for pose in poses:
            self.append(pose)

    def append(self, pose: Pose) -> None:
        """Append one pose."""
        for numbers in (pose.T_world_camera[:3], pose.T_reference_camera[:3], pose.covariance[self._UPPER], pose.map_covariance[self._UPPER]):
            self._reals.frombytes(numbers.tobytes())
        self._reals.extend((pose.noise_scale, pose.depth_scale_sigma))
        self._reasons += pose.reason.encode()
        counts = pose.inliers.tolist()
        self._whole.extend((pose.index, pose.stamp_ns, pose.reference, *counts, pose.unobservable, pose.submap, pose.unrecognised, pose.repeats))
        self._whole.extend((self._STATUSES.index(pose.status), len(self._reasons)))

    def __len__(self) -> int:
        return len(self._whole) // self._WHOLE

    @overload
    def __getitem__(self, at: int) -> Pose: ...

    @overload
    def __getitem__(self, at: slice) -> list[Pose]: ...

    def __getitem__(self, at: int | slice) -> Pose | list[Pose]:
        """Return the pose, or poses, at a position."""
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        k = range(len(self))[at]
        reals = np.array(self._reals[k * self._REALS : (k + 1) * self._REALS])
        T, T_reference = (np.vstack([rows.reshape(3, 4), self._LAST_ROW]) for rows in (reals[:12], reals[12:24]))
        covariances = np.empty((2, 6, 6))
        for covariance, numbers in zip(covariances, (reals[24:45], reals[45:66])):
            covariance[self._UPPER] = covariance.T[self._UPPER] = numbers
        whole = self._whole[k * self._WHOLE : (k + 1) * self._WHOLE]
        index, stamp_ns, reference, *inliers, unobservable, submap, unrecognised, repeats, state, end = whole
        counts, reason = np.array(inliers, np.int32), self._reasons[self._whole[k * self._WHOLE - 1] if k else 0 : end].decode()
        status = self._STATUSES[state]
        first, second = (index, stamp_ns, T, covariances[0], T_reference, reference), (counts, unobservable, status, reason, submap, unrecognised)
        return Pose(*first, *second, covariances[1], float(reals[66]), repeats, depth_scale_sigma=float(reals[67]))
