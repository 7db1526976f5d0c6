"""Poses at which the planes and lines of a frame lie on those of the map, for a scene whose axes are known: no descriptor and no prediction needed.

With the rotation fixed a plane says where the camera is along its normal (`n·t = d_camera - d_world`) and a line where it is across itself. So each
axis of the scene has a handful of likely coordinates, found by votes, and their combinations are counted out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Map, Planes, Segments
from trihedron.plugins.numerics.axes.cube_symmetry import CUBE

ON_AXIS = np.cos(np.radians(8.0))
BIN_M = 0.03  # of the votes
NEAR_M = 1.5 * BIN_M  # what lies this near to a candidate belongs to it
PEAKS = 8  # coordinates kept on each axis


@dataclass(frozen=True)
class Layout:
    """Planes and lines along three axes, in the coordinates of these. Planes: side they face (0..5: +x +y +z -x -y -z), place along that axis, area.
    Lines: axis, ends along it (low, high), the two other coordinates in cyclic order, length; sorted by axis, then by the first of these."""

    sides: I32
    places_m: F64
    areas: F64
    axes: I32
    spans_m: F64
    across_m: F64
    lengths: F64


def layout_of(coefficients: F64, areas: F64, endpoints_m: F64, lengths: F64, R: F64) -> Layout:
    """What of planes (n, 4) and lines (m, 2, 3) lies along the columns of R (3, 3), which are in their frame."""
    along = coefficients[:, :3] @ R
    axis = np.abs(along).argmax(axis=1)
    dot = along[np.arange(len(axis)), axis]
    good = np.abs(dot) > ON_AXIS
    sides = (axis + 3 * (dot < 0.0))[good].astype(np.int32)
    places = -(np.sign(dot) * coefficients[:, 3])[good]  # n·x + d = 0 with n = ±axis
    local = endpoints_m @ R
    step = local[:, 1] - local[:, 0]
    size = np.linalg.norm(step, axis=1)
    line_axis = np.abs(step).argmax(axis=1)
    straight = np.abs(step[np.arange(len(step)), line_axis]) > ON_AXIS * np.maximum(size, 1e-9)
    local, line_axis = local[straight], line_axis[straight]
    rows = np.arange(len(local))
    ends = np.sort(local[rows, :, line_axis], axis=1)
    middle = local.mean(axis=1)
    across = np.stack([middle[rows, (line_axis + 1) % 3], middle[rows, (line_axis + 2) % 3]], axis=-1)
    order = np.lexsort((across[:, 0], line_axis))
    return Layout(sides, places, areas[good], line_axis[order].astype(np.int32), ends[order], across[order], lengths[straight][order])


def layout_poses(
    map: Map, plane_ids: I32, line_ids: I32, planes: Planes, segments: Segments, R_world: F64, R_camera: F64, ways: F64 = CUBE
) -> tuple[F64, F64]:
    """(n, 4, 4) poses `T_world_camera` and (n,) how much of the frame's planes and lines they explain (0..2), best first, for axes seen as the
    columns of `R_camera` and known as those of `R_world`, whichever of the `ways` (n, 3, 3) round."""
    known = layout_of(
        map.planes.rows("coefficients", plane_ids), np.ones(len(plane_ids)), map.lines.rows("endpoints_m", line_ids), np.ones(len(line_ids)), R_world
    )
    solid = np.isfinite(segments.endpoints_m).all(axis=(1, 2))
    ends, pixels = segments.endpoints_m[solid].astype(np.float64), segments.endpoints_px[solid]
    lengths = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1).astype(np.float64)
    poses, scores = [], []
    for S in ways:
        named = R_camera @ S
        seen = layout_of(planes.coefficients, planes.pixels.astype(np.float64), ends, lengths, named)
        t, score = _places(seen, known)
        R = R_world @ named.T
        for place, value in zip(t, score):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, R_world @ place
            poses.append(T)
            scores.append(value)
    order = np.argsort(-np.array(scores), kind="stable")
    return np.array(poses).reshape(-1, 4, 4)[order], np.array(scores)[order]


def _places(seen: Layout, known: Layout) -> tuple[F64, F64]:
    """(n, 3) coordinates of the camera along the axes and (n,) the share of the frame explained there."""
    candidates = [_peaks(*_votes(seen, known, axis)) for axis in range(3)]
    grid = np.stack(np.meshgrid(*candidates, indexing="ij"), axis=-1).reshape(-1, 3)
    score = _explained(
        grid, seen.sides, seen.places_m, seen.areas / max(float(seen.areas.sum()), 1.0), seen.axes, seen.spans_m, seen.across_m,
        seen.lengths / max(float(seen.lengths.sum()), 1.0), known.sides, known.places_m, known.axes, known.spans_m, known.across_m,
    )  # fmt: skip
    best = np.argsort(-score, kind="stable")[:3]
    return grid[best], score[best]


def _votes(seen: Layout, known: Layout, axis: int) -> tuple[F64, F64]:
    """Coordinates of the camera along an axis that pairs of planes or lines would mean, and what each counts."""
    values, weights = [], []
    for side in (axis, axis + 3):
        ours, theirs = np.flatnonzero(seen.sides == side), np.flatnonzero(known.sides == side)
        values.append((known.places_m[theirs][None] - seen.places_m[ours][:, None]).ravel())
        weights.append(np.repeat(2.0 * np.sqrt(seen.areas[ours] / max(float(seen.areas.max(initial=1.0)), 1.0)), len(theirs)))
    for k in range(2):
        line_axis = (axis - 1 - k) % 3  # whose coordinate k across is this axis
        ours, theirs = np.flatnonzero(seen.axes == line_axis), np.flatnonzero(known.axes == line_axis)
        values.append((known.across_m[theirs, k][None] - seen.across_m[ours, k][:, None]).ravel())
        weights.append(np.repeat(np.sqrt(seen.lengths[ours] / max(float(seen.lengths.max(initial=1.0)), 1.0)), len(theirs)))
    return np.concatenate(values), np.concatenate(weights)


def _peaks(values: F64, weights: F64) -> F64:
    """The coordinates with most votes, at most PEAKS."""
    if not len(values):
        return np.empty(0)
    bins = np.floor(values / BIN_M).astype(np.int64)
    low = bins.min() - 1
    histogram = np.bincount(bins - low, weights, bins.max() - low + 2)
    smooth = histogram + 0.5 * (np.roll(histogram, 1) + np.roll(histogram, -1))
    found: list[float] = []
    for b in np.argsort(-smooth, kind="stable"):
        centre = (b + low + 0.5) * BIN_M
        if smooth[b] <= 0.0 or len(found) == PEAKS:
            break
        if all(abs(centre - other) > 2.0 * BIN_M for other in found):
            found.append(float(centre))
    near = [np.abs(values - centre) < NEAR_M for centre in found]
    return np.array([np.average(values[here], weights=weights[here]) for here in near])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _explained(
    places: F64, sides: I32, offsets: F64, areas: F64, axes: I32, spans: F64, across: F64, lengths: F64,
    known_sides: I32, known_offsets: F64, known_axes: I32, known_spans: F64, known_across: F64,
) -> F64:  # fmt: skip
    """(n,) share of the areas plus share of the lengths that lie on a known plane or line when the camera is at each of the places (n, 3)."""
    out = np.zeros(len(places))
    start = np.searchsorted(known_axes, np.arange(4))
    for k in range(len(places)):
        for i in range(len(sides)):
            place = offsets[i] + places[k, sides[i] % 3]
            for j in range(len(known_sides)):
                if known_sides[j] == sides[i] and abs(known_offsets[j] - place) < NEAR_M:
                    out[k] += areas[i]
                    break
        for i in range(len(axes)):
            a = axes[i]
            u, v = across[i, 0] + places[k, (a + 1) % 3], across[i, 1] + places[k, (a + 2) % 3]
            low, high = spans[i, 0] + places[k, a], spans[i, 1] + places[k, a]
            first = start[a] + np.searchsorted(known_across[start[a] : start[a + 1], 0], u - NEAR_M)
            for j in range(first, start[a + 1]):
                if known_across[j, 0] > u + NEAR_M:
                    break
                if abs(known_across[j, 1] - v) > NEAR_M:
                    continue
                if min(high, known_spans[j, 1]) - max(low, known_spans[j, 0]) > 0.3 * min(high - low, known_spans[j, 1] - known_spans[j, 0]):
                    out[k] += lengths[i]
                    break
    return out
