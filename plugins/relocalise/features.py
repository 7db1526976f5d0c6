"""Relocalisation of a lost camera by points, lines and planes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Keypoints, Map, Planes, Pose, Rotation, Segments
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT
from trihedron.plugins.places.recognition import distinct_poses, rigid_hypotheses
from trihedron.plugins.places.verification import FrameFeatures
from trihedron.plugins.relocalise.features_kernels import BIN_M, NEAR_M, explained_share
from trihedron.plugins.relocalise.hypothesis_verification import RelocaliseOptions, recognise
from trihedron.plugins.shared.feature_matching import nearest_matches
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE


@register("relocalise", "features")
@dataclass(frozen=True)
class Features(RelocaliseOptions):
    """Recognise a place by hypotheses and verification. Hypotheses are from points of similar appearance (three by three, Procrustes) and, where none
    holds, from the layout of planes and lines (all 24 orientations of each Manhattan frame in view). Each is verified by searching the map from there
    and solving the pose with points, lines and planes.

    A place is recognised when enough of the map agrees, details among it, a fair share of those expected in view, without free-space violations, and
    no other place explains the frame nearly as well: a symmetric room is refused. A large map is searched block by block, one a frame. Points need
    binary descriptors."""

    draws: PositiveInt = 1000  # triples of points tried
    by_points: PositiveInt = 4  # hypotheses verified
    by_layout: PositiveInt = 8
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    floor_m: PositiveFloat = 0.01  # least error of a point's place

    def __call__(
        self,
        frame: Frame,
        rotation: Rotation,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        map: Map | None,
        previous_pose: Pose | None,
        rng: np.random.Generator,
    ) -> Pose | None:
        """Return the pose; for a lost camera that is not recognised the lost one, and else None. Points are more distinctive than any layout."""
        ways = partial(self._by_points, rng=rng), partial(self._by_layout, rotation=rotation)
        return recognise(self, ways, FrameFeatures(frame, keypoints, segments, planes), map, previous_pose)

    def _by_points(self, view: FrameFeatures, map: Map, keyframes: I32, rng: np.random.Generator) -> F64:
        """Poses (n, 4, 4) by points similar to those of the map, best first."""
        keypoints = view.keypoints
        if keypoints.metric != "hamming":
            return np.empty((0, 4, 4))
        ids, rows = observed_by(map, keyframes, POINT), np.flatnonzero(np.isfinite(keypoints.points_m[:, 2])).astype(np.int32)
        matched = nearest_matches(keypoints.descriptors[rows], map.points.rows("descriptor", ids), self.max_bits, self.ratio)
        rows, ids = rows[matched >= 0], ids[matched[matched >= 0]]
        points = keypoints.points_m[rows].astype(np.float64)
        across = keypoints.sigma_px[rows] * self.angle_px * points[:, 2]
        sigma = np.sqrt(self.floor_m**2 + across**2 + keypoints.sigma_m[rows].astype(np.float64) ** 2)
        samples = rng.integers(0, max(len(rows), 1), (self.draws, 3)).astype(np.int32)
        return rigid_hypotheses(points, map.points.rows("position_m", ids), sigma, samples, self.by_points)

    def _by_layout(self, view: FrameFeatures, map: Map, keyframes: I32, rotation: Rotation) -> F64:
        """Poses (n, 4, 4) by the layout of planes and lines about each known Manhattan frame in view, best first."""
        found, scores = np.empty((0, 4, 4)), np.empty(0)
        plane_ids, line_ids = observed_by(map, keyframes, PLANE), observed_by(map, keyframes, LINE)
        for R_world, R_camera in zip(rotation.R_world_manhattan, rotation.R_camera_manhattan):
            if np.isfinite(R_camera).all():
                poses, values = layout_poses(map, plane_ids, line_ids, view.planes, view.segments, R_world, R_camera)
                found, scores = np.concatenate([found, poses]), np.concatenate([scores, values])
        return distinct_poses(found[np.argsort(-scores, kind="stable")], self.by_layout)


# Hypotheses by layout: poses at which the planes and lines of a frame lie on those of the map, for known Manhattan axes, without descriptors.
#
# With the rotation fixed a plane determines the position along its normal (`n·t = d_camera - d_world`) and a line the position across itself. So each
# axis has a handful of likely coordinates, found by votes, and all their combinations are scored.

ON_AXIS = np.cos(np.radians(8.0))
PEAKS = 8  # coordinates retained on each axis


@dataclass(frozen=True)
class Layout:
    """Planes and lines along three axes, in their coordinates. Planes: direction of the normal (0..5: +x +y +z -x -y -z), offset along that axis,
    area. Lines: axis, ends along it (low, high), the two other coordinates in cyclic order, length; sorted by axis, then by the first of these."""

    sides: I32
    offsets_m: F64
    areas: F64
    axes: I32
    spans_m: F64
    across_m: F64
    lengths: F64


def layout_of(coefficients: F64, areas: F64, endpoints_m: F64, lengths: F64, R: F64) -> Layout:
    """Select the planes (n, 4) and lines (m, 2, 3) along the columns of R (3, 3), which are in their frame."""
    along = matmul(coefficients[:, :3], R)
    axis = np.abs(along).argmax(axis=1)
    dot = along[np.arange(len(axis)), axis]
    good = np.abs(dot) > ON_AXIS
    sides = (axis + 3 * (dot < 0.0))[good].astype(np.int32)
    places = -(np.sign(dot) * coefficients[:, 3])[good]  # n·x + d = 0 with n = ±axis
    local = matmul(endpoints_m, R)
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


def layout_poses(map: Map, plane_ids: I32, line_ids: I32, planes: Planes, segments: Segments, R_world: F64, R_camera: F64) -> tuple[F64, F64]:
    """Return poses `T_world_camera` (n, 4, 4) and the share of the frame's planes and lines that they explain (0..2), best first, for axes observed
    as the columns of `R_camera` and known as those of `R_world`, in any of the 24 orientations."""
    known = layout_of(
        map.planes.rows("coefficients", plane_ids), np.ones(len(plane_ids)), map.lines.rows("endpoints_m", line_ids), np.ones(len(line_ids)), R_world
    )
    solid = np.isfinite(segments.endpoints_m).all(axis=(1, 2))
    ends, pixels = segments.endpoints_m[solid].astype(np.float64), segments.endpoints_px[solid]
    lengths = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1).astype(np.float64)
    poses, scores = [], []
    for S in CUBE:
        named = matmul(R_camera, S)
        seen = layout_of(planes.coefficients, planes.pixels.astype(np.float64), ends, lengths, named)
        t, score = _positions(seen, known)
        R = matmul(R_world, named.T)
        for place, value in zip(t, score):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, matmul(R_world, place)
            poses.append(T)
            scores.append(value)
    order = np.argsort(-np.array(scores), kind="stable")
    return np.array(poses).reshape(-1, 4, 4)[order], np.array(scores)[order]


def _positions(seen: Layout, known: Layout) -> tuple[F64, F64]:
    """Coordinates (n, 3) of the camera along the axes, and the share of the frame (n,) explained there."""
    candidates = [_peaks(*_votes(seen, known, axis)) for axis in range(3)]
    grid = np.stack(np.meshgrid(*candidates, indexing="ij"), axis=-1).reshape(-1, 3)
    score = explained_share(
        grid, seen.sides, seen.offsets_m, seen.areas / max(float(seen.areas.sum()), 1.0), seen.axes, seen.spans_m, seen.across_m,
        seen.lengths / max(float(seen.lengths.sum()), 1.0), known.sides, known.offsets_m, known.axes, known.spans_m, known.across_m,
    )  # fmt: skip
    best = np.argsort(-score, kind="stable")[:3]
    return grid[best], score[best]


def _votes(seen: Layout, known: Layout, axis: int) -> tuple[F64, F64]:
    """Coordinates of the camera along an axis by each pair of planes or lines, and their weights."""
    values, weights = [], []
    for side in (axis, axis + 3):
        ours, theirs = np.flatnonzero(seen.sides == side), np.flatnonzero(known.sides == side)
        values.append((known.offsets_m[theirs][None] - seen.offsets_m[ours][:, None]).ravel())
        weights.append(np.repeat(2.0 * np.sqrt(seen.areas[ours] / max(float(seen.areas.max(initial=1.0)), 1.0)), len(theirs)))
    for k in range(2):
        line_axis = (axis - 1 - k) % 3  # whose coordinate k across is this axis
        ours, theirs = np.flatnonzero(seen.axes == line_axis), np.flatnonzero(known.axes == line_axis)
        values.append((known.across_m[theirs, k][None] - seen.across_m[ours, k][:, None]).ravel())
        weights.append(np.repeat(np.sqrt(seen.lengths[ours] / max(float(seen.lengths.max(initial=1.0)), 1.0)), len(theirs)))
    return np.concatenate(values), np.concatenate(weights)


def _peaks(values: F64, weights: F64) -> F64:
    """Coordinates with most votes, at most PEAKS."""
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
