"""The offset of a depth sensor's inverse depths, from walls and floors that should meet at right angles.

A sensor that triangulates errs in disparity first of all: `1 / z_true = 1 / z + δ` with one δ for all pixels. A plane stays a plane then, but turns:
with `1 / z = q·r` along the rays r (`q = -n / d`), q becomes `q + δ e_z`. So right angles become oblique, the more the further away, and their
mean departure says δ. A scale of all depths turns no plane and cannot be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.types import F64, Planes

RIGHT_DEG = 8.0  # planes that meet within this of a right angle are meant to
BUILT_DEG = 0.5  # standard deviation of what builders mean by a right angle
HUBER = 1.345  # of a pair's departure over its standard deviation
ROUNDS = 20


@dataclass(frozen=True)
class RightAngle:
    """Two planes seen in one frame: the sine of their departure from a right angle, how much an offset changes it (m), and its variance."""

    sine: float
    lever_m: float
    variance: float


@dataclass(frozen=True)
class DepthOffset:
    """δ in 1/m, its standard deviation, and the pairs of planes it rests on; NaN and infinite without any."""

    per_m: float
    sigma_per_m: float
    pairs: int


def right_angles(planes: Planes, landmarks: dict[int, int]) -> dict[tuple[int, int], RightAngle]:
    """The right angles between planes of one frame, by the landmarks they belong to (`landmarks`: row -> id)."""
    found: dict[tuple[int, int], RightAngle] = {}
    n, d = planes.coefficients[:, :3], planes.coefficients[:, 3]
    tangents = tangent_basis(n)
    rows = sorted(landmarks)
    for a in rows:
        for b in rows:
            sine = float(n[a] @ n[b])
            if landmarks[a] < landmarks[b] and abs(sine) < np.sin(np.radians(RIGHT_DEG)):
                across = tangents[a].T @ n[b], tangents[b].T @ n[a]
                variance = sum(float(g @ planes.covariance[k, :2, :2] @ g) for g, k in zip(across, (a, b)))
                lever = -float(n[a, 2] * d[b] + n[b, 2] * d[a])
                found[landmarks[a], landmarks[b]] = RightAngle(sine, lever, variance)
    return found


def estimate_depth_offset(pairs: dict[tuple[int, int], list[RightAngle]]) -> DepthOffset:
    """Robust least squares over pairs of landmarks, each with all frames it was seen in and an angle of its own that is right within BUILT_DEG.

    The standard deviation is enlarged when the pairs disagree by more than theirs."""
    information, estimates = np.array([_of_pair(seen) for seen in pairs.values()]).reshape(-1, 2).T
    used = information > 0.0
    information, estimates = information[used], estimates[used]
    if not len(information):
        return DepthOffset(np.nan, np.inf, 0)
    weights, delta = np.ones(len(information)), 0.0
    for _ in range(ROUNDS):
        delta = float((weights * information * estimates).sum() / (weights * information).sum())
        weights = np.minimum(1.0, HUBER / np.maximum(np.sqrt(information) * np.abs(estimates - delta), 1e-12))
    total = float((weights * information).sum())
    spread = float((weights * information * (estimates - delta) ** 2).sum()) / max(len(information) - 1, 1)
    return DepthOffset(delta, float(np.sqrt(max(spread, 1.0) / total)), len(information))


def _of_pair(seen: list[RightAngle]) -> tuple[float, float]:
    """Information about δ and its estimate from one pair of landmarks: frames err independently, the angle they share does not."""
    rows: F64 = np.array([(s.sine, s.lever_m, 1.0 / s.variance) for s in seen])
    sine, lever, weight = rows.T
    shared = 1.0 / np.radians(BUILT_DEG) ** 2
    mixed = (weight * lever).sum()
    information = (weight * lever * lever).sum() - mixed * mixed / (weight.sum() + shared)
    score = -(weight * lever * sine).sum() + mixed * (weight * sine).sum() / (weight.sum() + shared)
    return float(information), float(score / information) if information > 0.0 else 0.0
