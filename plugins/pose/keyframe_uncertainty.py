"""Uncertainty of the keyframes that a pose is relative to: after a loss, or where planes alone localised them, it may exceed that of the pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import adjoint, invert
from trihedron.pipeline.core.types import DEGRADED, F64, I32, Map
from trihedron.plugins.pose.map_alignment import MapAlignment, TrackingStatus
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution


@dataclass(frozen=True)
class KeyframeUncertainty:
    """The keyframe (row, -1: none) that a pose is relative to, and the standard deviation of its position (m) in the worst direction."""

    keyframe: int
    sigma_m: float

    def covariance(self, map: Map, T_world_camera: F64) -> F64:
        """Covariance (6, 6) of the keyframe as that of xi of a camera that moves with it."""
        T, covariance = (map.keyframes.rows(name, np.array([self.keyframe]))[0] for name in ("T_world_camera", "covariance"))
        to_camera = adjoint(invert(T_world_camera) @ T)
        return np.asarray(to_camera @ covariance @ to_camera.T)


def keyframe_uncertainty(map: Map, points: I32, lines: I32, planes: I32) -> KeyframeUncertainty:
    """Select the weighted median, by σ, of the keyframes that created these landmarks (ids).

    A landmark's covariance includes its first keyframe's, but a pose estimated from hundreds of them averages out what is common to all."""
    weights = np.zeros(len(map.keyframes), np.int64)
    for table, ids, score in zip((map.points, map.lines, map.planes), (points, lines, planes), LANDMARK_SCORE):
        weights += score * np.bincount(table.rows("first", ids), minlength=len(weights))
    keyframes = np.flatnonzero(weights)
    if not len(keyframes):
        return KeyframeUncertainty(-1, 0.0)
    sigmas_m, half = _sigmas_m(map, keyframes.tolist()), int(weights.sum()) // 2
    below = 0
    for keyframe in sorted(keyframes.tolist(), key=sigmas_m.__getitem__):
        below += int(weights[keyframe])
        if below > half:
            break
    return KeyframeUncertainty(keyframe, sigmas_m[keyframe])


def _sigmas_m(map: Map, keyframes: list[int]) -> dict[int, float]:
    """Standard deviations of (at least) these keyframes' positions in their worst directions; computed once per version of the map."""
    sigmas_m: dict[int, float] = map.memo.setdefault("sigmas_m", {})
    if new := [keyframe for keyframe in keyframes if keyframe not in sigmas_m]:
        covariances = map.keyframes.rows("covariance", np.array(new))
        sigmas_m.update(zip(new, np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1]).tolist()))
    return sigmas_m


def degrade_by_keyframes(status: TrackingStatus, solution: PoseSolution, problem: MapAlignment, factor: float) -> TrackingStatus:
    """Degrade a pose whose keyframes are uncertain by more than `factor` times its own standard deviation, and add their covariance to it."""
    base = keyframe_uncertainty(problem.map, *problem.landmarks(solution))
    if base.sigma_m <= factor * np.sqrt(np.linalg.eigvalsh(solution.covariance[:3, :3])[-1]):
        return status
    reason = f"relative to keyframes with σ = {1e3 * base.sigma_m:.0f} mm"
    return TrackingStatus(DEGRADED, reason, status.covariance + base.covariance(problem.map, solution.T_world_camera))
