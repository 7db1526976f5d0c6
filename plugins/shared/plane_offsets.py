"""Contradiction between depth and the map: planes, which depth alone measures, lie where the map has them.

Where colour is frozen with noise, or late, points and lines agree with each other on a pose at which walls are not where depth sees them. How far
planes lie from those of the map depends on the camera, its calibration and its distance, and a run shows what is usual; a contradiction is what is
far beyond that for a while. What moves is seldom most of what is flat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Planes, Pose

LATE, USUAL = 10.0, 100.0  # images full of matched planes that the offset of late, and the usual one, are averaged over
MOST = 3.5  # times the usual offset; two of 75 simulated sensors exceed it in 20 frames, six sequences come to 2.8
LEAST = 0.001  # of the distance, that is usual at least
LEARNED = 2.0  # times the usual offset that a frame counts at most in it: a fault of some seconds does not become usual, and a change for good does


def with_plane_offsets(pose: Pose, previous: Pose, known: F64, planes: Planes, matched: I32) -> Pose:
    """Give a refined pose the moving averages of how far the planes `matched` (m,) of its frame lie from those of the map, (m, 4) `known` in the
    world; the previous one's where none is."""
    late, usual, seen = previous.plane_offsets.tolist()
    offset, share = plane_offset(matmul(known, pose.T_world_camera), planes, matched)
    if not seen:
        late = usual = offset
    late += (offset - late) * share / LATE
    usual += (min(offset, LEARNED * max(usual, LEAST)) - usual) * share / min(LATE + seen, USUAL)
    return replace(pose, plane_offsets=np.array([late, usual, min(seen + share, USUAL)]))


def plane_offset(known: F64, planes: Planes, matched: I32) -> tuple[float, float]:
    """Return how far half of the area of the planes `matched` (m,) lies at least from where they are `known` (m, 4), in the camera's frame, as a
    share of its distance; and the area, as a share of the image. Zeros for none."""
    samples, size = planes.samples_m[matched].astype(np.float64), planes.labels.size * planes.stride**2
    distances = np.linalg.norm(samples, axis=2)
    usable = (distances > 0.0) & (distances < np.inf)  # NaN is neither
    plane, counts = np.nonzero(usable)[0], np.count_nonzero(usable, axis=1)
    if not len(plane):
        return 0.0, 0.0
    points, expected, weights = samples[usable], known[plane], (planes.pixels[matched] / np.maximum(counts, 1))[plane]
    offsets = np.abs((points * expected[:, :3]).sum(axis=1) + expected[:, 3]) / distances[usable]
    order = np.argsort(offsets)
    area = np.cumsum(weights[order])
    return float(offsets[order][np.searchsorted(area, area[-1] / 2.0)]), min(float(area[-1]) / size, 1.0)


def contradicting_offsets(pose: Pose) -> str:
    """Return why planes contradict the map, empty where they lie from it about as far as usual."""
    late, usual, _ = pose.plane_offsets.tolist()
    if late <= MOST * max(usual, LEAST):
        return ""
    return f"planes contradict the map: of late they lie {100.0 * late:.1f} % of their distance from where it has them, usually {100.0 * usual:.1f} %"
