"""What is left of several frames when none of them is seen."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.types import F64, I32, ManhattanFrame, Normals, Planes, Segments
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


def mode_spread(modes: Modes) -> F64:
    """(3,) rad; NaN of axes that are not seen."""
    return np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)
