"""How well the part of a map that a pose was found in is known itself."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.types import F64, I32, Map

SCORE = np.array([1, 2, 5])  # what a point, a line and a plane count


def foundation_sigma_m(map: Map, points: I32, lines: I32, planes: I32) -> float:
    """Standard deviation (m, in the worst direction) of the keyframes that these landmarks (ids) were first seen from: the median over landmarks.

    A landmark's covariance holds its first keyframe's, but a pose found from hundreds of them averages what is common to all as if it were not."""
    seen = (map.points, points), (map.lines, lines), (map.planes, planes)
    first = np.concatenate([np.repeat(table.rows("first", ids), count) for (table, ids), count in zip(seen, SCORE)])
    if not len(first):
        return 0.0
    keyframes, times = np.unique(first, return_inverse=True)
    covariance: F64 = map.keyframes.rows("covariance", keyframes)[:, :3, :3]
    return float(np.median(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])[times]))
