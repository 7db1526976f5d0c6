"""Contradiction between depth and the map: planes, which depth alone measures, lie where the map has them.

Where colour is frozen with noise, or late, points and lines agree with each other on a pose at which walls are not where depth sees them. How far
planes lie from those of the map depends on the camera and its distance, and a run shows what is usual. Where a camera turns, or comes back, an
imperfect calibration takes them farther, as is known from its parameters (`calibration_error.py`). A contradiction is what is far beyond both for a
while. What moves is seldom most of what is flat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, Bool, Planes, Pose

LATE, USUAL = 10.0, 100.0  # images full of matched planes that the offset of late, and the usual one, are averaged over
MOST = 3.5  # times the usual offset, beyond which that of late contradicts the map; six sequences come to 2.8
SIGMAS = 2.0  # standard deviations by the calibration that are no contradiction; offsets are 0.4 to 2.5 of them without a fault, 4 to 23 with one
LEAST = 0.0005  # of the distance, that is usual at least, also where depth is exact
LEARNED = 2.0  # times the usual offset that a frame counts at most in it: a fault of some seconds does not become usual, and a change for good does
TINY_M = 1e-6


def with_plane_offsets(pose: Pose, previous: Pose, known: F64, planes: Planes, matches: I32, sigmas_m: F64) -> Pose:
    """Give a refined pose the moving averages of how far the planes of its frame lie from those of the map that they are matched with by `matches`
    (m, 2: row, id), (m, 4) `known` in the world; the previous one's where none is. `sigmas_m` (m, s) is how far the calibration takes each sample,
    NaN where the map does not know the plane."""
    late, usual, seen = previous.plane_offsets.tolist()
    least = max(usual, LEAST)
    offset, share = plane_offset(matmul(known, pose.T_world_camera), planes, matches, sigmas_m, least)
    if not seen:
        late = usual = offset
    late += (offset - late) * share / LATE
    usual += (min(offset, LEARNED * least) - usual) * share / min(LATE + seen, USUAL)
    return replace(pose, plane_offsets=np.array([late, usual, min(seen + share, USUAL)]))


def samples_of(planes: Planes, matches: I32) -> F32:
    """Return every second sample (m, s, 3) of the matched planes: enough for a median, in half of the time."""
    return planes.samples_m[matches[:, 0], ::2]


def plane_offset(known: F64, planes: Planes, matches: I32, sigmas_m: F64, usual: float) -> tuple[float, float]:
    """Return how far half of the area of the planes matched by `matches` (m, 2: row, id) lies at least from where they are `known` (m, 4), in the
    camera's frame, as a share of its distance; and the area, as a share of the image. Zeros for none.

    Beyond `MOST` times the `usual` offset planes contradict the map. A sample that the calibration takes farther than that, by two of `sigmas_m`
    (m, s), counts that many times less, and one where these are not known not at all. Of several planes that are matched with one of the map, those
    that lie farther than that from the nearest are other surfaces, such as a board on a wall, and do not count."""
    rows, ids = matches.T
    samples, size = samples_of(planes, matches).astype(np.float64), planes.labels.size * planes.stride**2
    distances = np.linalg.norm(samples, axis=2)
    usable = (distances > 0.0) & (distances < np.inf)  # NaN is neither
    counts = np.maximum(np.count_nonzero(usable, axis=1), 1)
    if len(set(ids.tolist())) < len(ids):
        centres = np.where(usable[:, :, None], samples, 0.0).sum(axis=1) / counts[:, None]
        usable &= _on_the_nearest(centres, planes.coefficients[rows], known, ids, MOST * usual)[:, None]
    usable &= np.isfinite(sigmas_m)
    plane = np.nonzero(usable)[0]
    if not len(plane):
        return 0.0, 0.0
    points, expected, weights = samples[usable], known[plane], (planes.pixels[rows] / counts)[plane]
    far = distances[usable]
    offsets = np.abs((points * expected[:, :3]).sum(axis=1) + expected[:, 3]) / np.maximum(far, SIGMAS * sigmas_m[usable] / (MOST * usual))
    order = np.argsort(offsets)
    area = np.cumsum(weights[order])
    return float(offsets[order][np.searchsorted(area, area[-1] / 2.0)]), min(float(area[-1]) / size, 1.0)


def _on_the_nearest(centres: F64, coefficients: F64, known: F64, ids: I32, apart: float) -> Bool:
    """Return (m,) True for the planes that lie within `apart`, a share of their distance, of the nearest of those with their id: the one whose centre
    (m, 3) is nearest to where it is `known`. How far two lie from each other, this frame alone shows: the centre of either from the plane of the
    other, whichever is nearer, so that a small plane is not extended to a large one."""
    distances, rows = np.maximum(np.linalg.norm(centres, axis=1), TINY_M), np.arange(len(ids))
    offsets = np.abs((centres * known[:, :3]).sum(axis=1) + known[:, 3]) / distances
    nearest = np.where(ids[:, None] == ids, offsets, np.inf).argmin(axis=1)
    between = np.abs((centres[:, None] * coefficients[:, :3]).sum(axis=2) + coefficients[:, 3]) / distances[:, None]
    return np.asarray((np.minimum(between[rows, nearest], between[nearest, rows]) <= apart) | (nearest == rows), np.bool_)


def contradicting_offsets(pose: Pose) -> str:
    """Return why planes contradict the map, empty where they lie from it about as far as usual."""
    late, usual, _ = pose.plane_offsets.tolist()
    if late <= MOST * max(usual, LEAST):
        return ""
    return f"planes contradict the map: of late they lie {100.0 * late:.1f} % of their distance from where it has them, usually {100.0 * usual:.1f} %"
