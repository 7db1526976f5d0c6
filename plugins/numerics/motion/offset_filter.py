"""A linear Kalman filter over the camera's position and the offsets of planes whose normals are known (Kim, Coltin, Kim, ECCV 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, Planes, Rotation

SAME_AXIS = 0.99  # cosine between the normals of one plane, seen twice
SLACK_M = 0.01  # that a plane may be off besides: two that are this near are one
FIRST_SIGMA_M = 1e-6  # the first position is the origin by definition


@dataclass(frozen=True)
class Sight:
    """A plane seen on a signed Manhattan axis `normal` (3,) of the world: its distance from the camera along it, m, and the variance of that, m²."""

    normal: F64
    distance_m: float
    variance: float


@dataclass(frozen=True)
class OffsetFilter:
    """`position_m` (3,), `planes` (m, 4) as (n, d) of the world, and the covariance (3 + m, 3 + m) of the position and all d."""

    position_m: F64
    planes: F64
    covariance: F64

    def moved(self, step: F64, noise: F64) -> OffsetFilter:
        """After a step (3,) of the camera, with covariance (3, 3)."""
        covariance = self.covariance.copy()
        covariance[:3, :3] += noise
        return OffsetFilter(self.position_m + step, self.planes, covariance)

    def updated(self, sights: list[Sight], gate: float, gate_m: float) -> tuple[OffsetFilter, int]:
        """Corrected by the sights of known planes, with the others joined, and how many were known: `distance = n·position + d`. The sights are
        put in that order."""
        state, fresh, known = self, [], []
        for sight in sights:
            row = self._row(sight, gate, gate_m)
            if row < 0:
                fresh.append(sight)
            else:
                known.append(sight)
                state = state._corrected(sight, row)
        for sight in fresh:
            state = state._joined(sight)
        sights[:] = known + fresh
        return state, len(known)

    def _row(self, sight: Sight, gate: float, gate_m: float) -> int:
        """The known plane nearest to the sight within the gates, -1 = none."""
        n, P = sight.normal, self.covariance
        off = np.abs(sight.distance_m - n @ self.position_m - self.planes[:, 3])
        variance = n @ P[:3, :3] @ n + 2.0 * n @ P[:3, 3:] + np.diag(P)[3:] + sight.variance
        within = (self.planes[:, :3] @ n > SAME_AXIS) & (off < np.minimum(gate * np.sqrt(variance) + SLACK_M, gate_m))
        return int(np.argmin(np.where(within, off, np.inf))) if within.any() else -1

    def _measures(self, normal: F64, row: int) -> F64:
        h = np.zeros(3 + len(self.planes))
        h[:3], h[3 + row] = normal, 1.0
        return h

    def _corrected(self, sight: Sight, row: int) -> OffsetFilter:
        h, P = self._measures(sight.normal, row), self.covariance
        gain = P @ h / (h @ P @ h + sight.variance)
        change = gain * (sight.distance_m - sight.normal @ self.position_m - self.planes[row, 3])
        rest = np.eye(len(h)) - np.outer(gain, h)
        planes = self.planes.copy()
        planes[:, 3] += change[3:]
        return OffsetFilter(self.position_m + change[:3], planes, rest @ P @ rest.T + sight.variance * np.outer(gain, gain))

    def _joined(self, sight: Sight) -> OffsetFilter:
        n, P = sight.normal, self.covariance
        m = len(P)
        covariance = np.zeros((m + 1, m + 1))
        covariance[:m, :m] = P
        covariance[m, :m] = covariance[:m, m] = -n @ P[:3]
        covariance[m, m] = n @ P[:3, :3] @ n + sight.variance
        plane = np.append(n, sight.distance_m - n @ self.position_m)
        return OffsetFilter(self.position_m, np.concatenate([self.planes, plane[None]]), covariance)


def first_filter() -> OffsetFilter:
    """At the origin, without planes."""
    return OffsetFilter(np.zeros(3), np.empty((0, 4)), FIRST_SIGMA_M**2 * np.eye(3))


def axis_sights(planes: Planes, rotation: Rotation, axis_deg: float, floor_m: float, min_pixels: int) -> list[Sight]:
    """The planes that stand on an axis of the best known Manhattan frame in view: the distance of their centre along it."""
    seen = np.isfinite(rotation.R_camera_manhattan[:, 0, 0])
    if not seen.any():
        return []
    axes = rotation.R_world_manhattan[int(np.argmax(np.where(seen, rotation.weights, -1.0)))]
    turn = float(np.trace(rotation.covariance)) / 3.0
    found = []
    for plane, moments, pixels in zip(planes.coefficients, planes.moments, planes.pixels):
        along = axes.T @ rotation.R_world_camera @ plane[:3]
        k = int(np.argmax(np.abs(along)))
        if abs(along[k]) < np.cos(np.radians(axis_deg)) or pixels < min_pixels:
            continue
        normal = np.asarray(axes[:, k] * np.sign(along[k]))
        centre, local = moments[:3, 3] / moments[3, 3], rotation.R_world_camera.T @ normal
        aside2 = float(centre @ centre - (centre @ local) ** 2)
        found.append(Sight(normal, float(-local @ centre), 1.0 / float(moments[3, 3]) + turn * aside2 + floor_m**2))
    return found
