"""Contradiction between depth and the map: distances between points are those that the map has.

No motion changes a distance, whether of the camera or of a rigid object. Where the scale of depth changes in mid-run, or images are zoomed, all
distances do, and a pose may make up for it: there is a place from which the same points look much the same. So distances are compared without the
pose. In a frame with hundreds of points their ratio is known to parts of a thousand; noise and what moves make some larger and others smaller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import F32, F64, Pose
from trihedron.plugins.shared.quantiles import quantiles

LEAST_POINTS = 20  # with depth, that distances are measured between
APART = 2, 3, 5  # each point is paired with those half, a third and a fifth of all points further on
MOST = 0.9  # of the distances
AVERAGED_FRAMES = 3  # that the difference is averaged over
LEAST = 0.005  # of a distance, that is worth a doubt
TINY_M = 1e-6


def with_scale_difference(pose: Pose, previous: Pose, known: F64, found: F32) -> Pose:
    """Give a pose the moving average of how much most distances between its matched points, (n, 3) `found` by the camera, differ from those in the
    map, where they are `known`; the previous one's where that is not measured. A new sub-map begins it."""
    before = previous.scale_difference if previous.submap == pose.submap else 0.0
    difference = scale_difference(known, found)
    return replace(pose, scale_difference=before if difference is None else before + (difference - before) / AVERAGED_FRAMES)


def scale_difference(known: F64, found: F32) -> float | None:
    """Return the logarithm of the ratio by which at least nine of ten distances between points (n, 3) `found` are larger, or smaller, than between
    the same points where they are `known`; 0.0 where some are larger and some smaller, None for few points. NaN are none. Of all distances the
    longer half is compared, which noise changes least."""
    finite = np.flatnonzero(np.isfinite(found[:, 2]))
    if len(finite) < LEAST_POINTS:
        return None
    before, now = _distances(np.stack([known.take(finite, 0), found.take(finite, 0)]))
    longer, middle = np.maximum(before, now), len(before) // 2
    counted = (longer >= np.partition(longer, middle)[middle]) & (np.minimum(before, now) > TINY_M)
    ratios = np.log(now[counted] / before[counted])
    if not len(ratios):
        return None
    least, most = quantiles(ratios, [1.0 - MOST, MOST]).tolist()
    return float(max(least, 0.0) + min(most, 0.0))


def contradicting_scale(pose: Pose) -> str:
    """Return why the distances between points contradict the map, empty where they do not."""
    if abs(pose.scale_difference) <= LEAST:
        return ""
    side, percent = ("larger", 100.0) if pose.scale_difference > 0.0 else ("smaller", -100.0)
    least = percent * np.expm1(pose.scale_difference)
    return f"depth and map contradict each other: of late most distances between points are {least:.1f} % {side} than in the map, or more"


def _distances(points: F64) -> F64:
    """Distances (k, 3 n) of points (k, n, 3) to those they are paired with."""
    count = points.shape[1]
    farther = (np.arange(count) - [[count // share] for share in APART]) % count
    x, y, z = np.moveaxis(points[:, None] - points.take(farther, 1), 3, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z).reshape(len(points), -1))
