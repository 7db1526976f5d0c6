"""How well the part of a map that a pose was found in is known itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import adjoint, invert
from trihedron.pipeline.core.types import DEGRADED, F64, I32, Map
from trihedron.plugins.numerics.maps.map_alignment import SCORE, MapAlignment, Verdict
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution


@dataclass(frozen=True)
class Foundation:
    """The keyframe (a row, -1: none) that a pose hangs on, and its standard deviation (m, in the worst direction)."""

    keyframe: int
    sigma_m: float

    def covariance(self, map: Map, T_world_camera: F64) -> F64:
        """(6, 6) of xi of a camera that goes with the keyframe."""
        T, covariance = (map.keyframes.rows(name, np.array([self.keyframe]))[0] for name in ("T_world_camera", "covariance"))
        moved = adjoint(invert(T_world_camera) @ T)
        return np.asarray(moved @ covariance @ moved.T)


def foundation(map: Map, points: I32, lines: I32, planes: I32) -> Foundation:
    """Of the keyframes that these landmarks (ids) were first seen from, the one that is known no better than half of the landmarks' are.

    A landmark's covariance holds its first keyframe's, but a pose found from hundreds of them averages what is common to all as if it were not."""
    weights = np.zeros(len(map.keyframes), np.int64)
    for table, ids, score in zip((map.points, map.lines, map.planes), (points, lines, planes), SCORE):
        weights += score * np.bincount(table.rows("first", ids), minlength=len(weights))
    keyframes = np.flatnonzero(weights)
    if not len(keyframes):
        return Foundation(-1, 0.0)
    sigmas_m, half = _sigmas_m(map, keyframes.tolist()), int(weights.sum()) // 2
    known = 0  # how much is known as well as a keyframe or better
    for keyframe in sorted(keyframes.tolist(), key=sigmas_m.__getitem__):
        known += int(weights[keyframe])
        if known > half:
            break
    return Foundation(keyframe, sigmas_m[keyframe])


def _sigmas_m(map: Map, keyframes: list[int]) -> dict[int, float]:
    """Standard deviations of the keyframes' positions in their worst directions, and of others; found once in a version of the map."""
    found: dict[int, float] = map.memo.setdefault("sigmas_m", {})
    if new := [keyframe for keyframe in keyframes if keyframe not in found]:
        covariances = map.keyframes.rows("covariance", np.array(new))
        found.update(zip(new, np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1]).tolist()))
    return found


@dataclass(frozen=True)
class Foundations:
    """How much worse than a pose the keyframes behind it may be known: after a loss, or where planes alone said where they are, they are poor."""

    weak_foundation: float = 3.0  # times its own standard deviation that the map's keyframes about here may have before a pose is called degraded

    def __post_init__(self) -> None:
        if self.weak_foundation <= 0.0:
            raise ValueError("weak_foundation: must be positive")

    def judged_by_foundation(self, found: PoseSolution, problem: MapAlignment, said: Verdict) -> Verdict:
        """What is said of a pose, which is not better known than the keyframes behind what it was found from."""
        base = foundation(problem.map, *problem.landmarks(found))
        if base.sigma_m <= self.weak_foundation * np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]):
            return said
        reason = f"what is seen hangs on keyframes that are known to {1e3 * base.sigma_m:.0f} mm"
        return Verdict(DEGRADED, reason, said.covariance + base.covariance(problem.map, found.T_world_camera))
