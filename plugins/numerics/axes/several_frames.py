"""What an estimator of several frames says: of those it sees, and of those it knows but does not see."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.axis_fit import NOTHING_KNOWN, AxisFit
from trihedron.plugins.numerics.axes.manhattan_modes import Modes
from trihedron.plugins.numerics.axes.sphere_modes import orthonormal


def lost_frames(modes: Modes, fit: AxisFit, segments: Segments, planes: Planes, normals: Normals, known: F64, ids: I32) -> ManhattanFrame:
    """Not supported: a single axis of the first still turns all that are known (k, 3, 3), and tells two of its three angles."""
    R, covariance = known[0], np.eye(3) * NOTHING_KNOWN
    if modes.seen.sum() == 1:
        turned = orthonormal(modes.axes, np.where(modes.seen, 1.0, 1e-6))
        R, covariance = fit(turned, modes.axes, modes.normals, modes.seen, segments, planes)
    count, spread = len(known), np.full((len(known), 3), np.nan)
    spread[0] = mode_spread(modes)
    inliers = np.zeros((count, 3), np.int32)
    inliers[0] = np.where(modes.seen, modes.normals[:, 0] + modes.lines[:, 0], 0)
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=R @ known[0].T @ known,
        ids=ids,
        covariance=np.concatenate([covariance[None], np.tile(np.eye(3) * NOTHING_KNOWN, (count - 1, 1, 1))]),
        inliers=inliers,
        spread=spread,
        supported=False,
    )


def seen_frames(
    normals: Normals, rotations: F64, covariance: F64, inliers: F64, spread: F64, rows: I32, ids: I32, unseen: I32, expected: F64
) -> ManhattanFrame:
    """The frames seen, (k, 3, 3) with their covariances, inliers (k, 3) and spread (k, 3), then those out of sight, where they are `expected`
    (u, 3, 3): without inliers, with a covariance that says nothing.

    `rows` (k,) and `unseen` (u,) say which of the known frames, with `ids`, they are; -1 is a new one and gets a number of its own."""
    nothing = np.zeros((len(unseen), 3))
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=np.concatenate([rotations, expected.reshape(-1, 3, 3)]),
        ids=np.concatenate([np.where(rows >= 0, ids[rows], ids.max() + np.cumsum(rows < 0)), ids[unseen]]).astype(np.int32),
        covariance=np.concatenate([covariance, np.tile(np.eye(3) * NOTHING_KNOWN, (len(unseen), 1, 1))]),
        inliers=np.concatenate([inliers, nothing]).astype(np.int32),
        spread=np.concatenate([spread, nothing * np.nan]),
        supported=True,
    )


def mode_spread(modes: Modes) -> F64:
    """(3,) rad; NaN of axes that are not seen."""
    return np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)
