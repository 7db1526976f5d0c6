"""The edges of a pose graph: how keyframes that saw the same points stand to each other, by their own measurements of these."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.types import F64, I32, Map
from trihedron.plugins.numerics.maps.keyframe_features import measured_points
from trihedron.plugins.numerics.motion.rigid_consensus import fit_covariance, fitted
from trihedron.plugins.numerics.motion.tracked_places import place_sigma
from trihedron.plugins.numerics.places.pose_graph import Edges

FLOOR_M, FLOOR = 2e-3, 1e-3  # least standard deviations of an edge, m and rad
LOOSE_M, LOOSE = 0.05, 0.02  # of keyframes that follow each other and share too little


def shared_edges(map: Map, rows: I32, poses: F64, least: int, gate: float) -> tuple[Edges, int]:
    """Edges between all of the keyframes `rows` (sorted), at `poses` (n, 4, 4), that saw at least `least` of the same points and agree on a motion;
    and the longest of them, in keyframes. Neighbours in time that share less stay as they stand, loosely."""
    seen = [measured_points(map, int(row)) for row in rows]
    pairs, measured, information = [], [], []
    for b in range(len(rows)):
        for a in range(b):
            edge = _edge(seen[a], seen[b], least, gate)
            if edge is None and a == b - 1:
                edge = invert(poses[a]) @ poses[b], np.diag(np.repeat([LOOSE_M**2, LOOSE**2], 3))
            if edge is not None:
                pairs.append((a, b))
                measured.append(edge[0])
                information.append(np.linalg.inv(edge[1]))
    longest = max((b - a for a, b in pairs), default=0)
    return Edges(np.array(pairs, np.int32).reshape(-1, 2), np.array(measured), np.array(information)), longest


def _edge(a: tuple[I32, F64, F64, F64], b: tuple[I32, F64, F64, F64], least: int, gate: float) -> tuple[F64, F64] | None:
    """`T_a_b` (4, 4) and the covariance (6, 6) of xi in `T_a_b · Exp(xi)`, or None."""
    _, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    if len(i) < least:
        return None
    there, here = a[1][i], b[1][j]
    sigma = place_sigma(there, here, a[2][i], b[2][j], b[3][j])
    agree = np.ones(len(i), bool)
    R, t = np.eye(3), np.zeros(3)
    for _ in range(3):
        R, t = fitted(here[agree], there[agree], sigma[agree])
        agree = np.linalg.norm(here @ R.T + t - there, axis=1) < gate * sigma
        if agree.sum() < least:
            return None
    covariance = fit_covariance(here[agree], sigma[agree]) + np.diag(np.repeat([FLOOR_M**2, FLOOR**2], 3))
    return pose_matrix(R, t), covariance
