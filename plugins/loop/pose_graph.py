"""Loop closing by a pose graph over all keyframes that share points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.linalg import inv, matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Correction, Map
from trihedron.plugins.loop.keyframe_correction import correct_keyframes
from trihedron.plugins.mapping.covisibility_graph import current_submap, keyframes_of
from trihedron.plugins.shared.pose_graph import Edges, solve_pose_graph
from trihedron.plugins.shared.rigid_alignment import fit_covariance, fit_motion, point_pair_sigma


@register("loop", "pose_graph")
@dataclass(frozen=True)
class PoseGraph:
    """Connect all keyframes that measured some of the same points by the motion between these measurements, and optimise all poses (RGB-D SLAM:
    Endres et al., T-RO 2014; Grisetti et al., ITS Magazine 2010). Points move with their keyframes.

    `matches` associates the points, of neighbours and loops alike. Landmarks are not adjusted: that is the task of bundle adjustment."""

    every: PositiveInt = 3  # keyframes between two optimisations
    min_points: Annotated[int, Range(3)] = 20  # that two keyframes must share
    gate: PositiveFloat = 3.0  # standard deviations within which a point agrees with an edge
    least_m: NonNegativeFloat = 1e-4  # motion of a keyframe below which nothing is corrected

    def __call__(self, map: Map) -> Correction | None:
        """Return the correction of all keyframes; None unless the newest one is due and closes a cycle."""
        newest = len(map.keyframes) - 1
        if newest < 2 or newest % self.every or map.keyframes.row("index", newest) != map.index:
            return None
        rows = keyframes_of(map, current_submap(map))
        before = map.keyframes.rows("T_world_camera", rows)
        edges, longest = shared_edges(map, rows, before, self.min_points, self.gate)
        if longest < 2:
            return None
        after = solve_pose_graph(before, edges)
        moved = float(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max())
        return correct_keyframes(map, rows, before, after) if moved >= self.least_m else None


FLOOR_M, FLOOR = 2e-3, 1e-3  # least standard deviations of an edge, m and rad
LOOSE_M, LOOSE = 0.05, 0.02  # of keyframes that follow each other and share too little


def shared_edges(map: Map, rows: I32, poses: F64, least: int, gate: float) -> tuple[Edges, int]:
    """Return the edges between all of the keyframes `rows` (sorted), at `poses` (n, 4, 4), that measured at least `least` of the same points and
    agree on a motion; and the longest of them, in keyframes. Neighbours in time that share less are connected loosely by their present motion."""
    seen = [measured_points(map, int(row)) for row in rows]
    pairs, measured, information = [], [], []
    for b in range(len(rows)):
        for a in range(b):
            edge = _edge(seen[a], seen[b], least, gate)
            if edge is None and a == b - 1:
                edge = matmul(invert(poses[a]), poses[b]), np.diag(np.repeat([LOOSE_M**2, LOOSE**2], 3))
            if edge is not None:
                pairs.append((a, b))
                measured.append(edge[0])
                information.append(inv(edge[1]))
    longest = max((b - a for a, b in pairs), default=0)
    return Edges(np.array(pairs, np.int32).reshape(-1, 2), np.array(measured), np.array(information)), longest


def _edge(a: tuple[I32, F64, F64, F64], b: tuple[I32, F64, F64, F64], least: int, gate: float) -> tuple[F64, F64] | None:
    """`T_a_b` (4, 4) and the covariance (6, 6) of xi in `T_a_b · Exp(xi)`, or None."""
    _, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    if len(i) < least:
        return None
    there, here = a[1][i], b[1][j]
    sigma = point_pair_sigma(there, here, a[2][i], b[2][j], b[3][j])
    agree = np.ones(len(i), bool)
    R, t = np.eye(3), np.zeros(3)
    for _ in range(3):
        R, t = fit_motion(here[agree], there[agree], sigma[agree])
        agree = np.linalg.norm(matmul(here, R.T) + t - there, axis=1) < gate * sigma
        if agree.sum() < least:
            return None
    covariance = fit_covariance(here[agree], sigma[agree]) + np.diag(np.repeat([FLOOR_M**2, FLOOR**2], 3))
    return pose_matrix(R, t), covariance


def measured_points(map: Map, keyframe: int) -> tuple[I32, F64, F64, F64]:
    """Return the ids (n,) of the points that a keyframe measured with depth, sorted, their positions (n, 3) in its frame by these measurements, and σ
    of their depths (m) and pixels."""
    first, end = map.keyframes.row("points", keyframe)
    fx, fy, cx, cy = map.keyframes.row("intrinsics", keyframe)
    names = ("point", "pixel", "depth_m", "sigma_m", "sigma_px")
    ids, pixel, depth, sigma_m, sigma_px = map.point_observations.columns_at(np.arange(first, end), *names)
    pixel, depth = pixel.astype(np.float64), depth.astype(np.float64)
    places = np.stack([(pixel[:, 0] - cx) / fx * depth, (pixel[:, 1] - cy) / fy * depth, depth], axis=1)
    known = np.flatnonzero(np.isfinite(depth))
    known = known[np.unique(ids[known], return_index=True)[1]]
    return ids[known], places[known], sigma_m[known].astype(np.float64), sigma_px[known].astype(np.float64)
