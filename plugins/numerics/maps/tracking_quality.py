"""Whether enough of the map was found for a pose to be believed."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.types import DEGRADED, OK, Rotation
from trihedron.plugins.numerics.maps.map_alignment import Agreement, Verdict
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution


@dataclass(frozen=True)
class TrackingQuality:
    """How much of what is sought must agree with a pose; and with the first one after a loss, which has nothing else to go by."""

    min_inliers: int = 10  # points + 2 lines + 5 planes below which the pose is called degraded
    min_share: float = 0.25  # of the matches that must agree, else it is called degraded
    found_inliers: int = 30  # points + 2 lines + 5 planes that find a lost pose again
    found_share: float = 0.5  # of the matches that must agree for that

    def __post_init__(self) -> None:
        if self.min_inliers < 0 or not 0.0 <= self.min_share <= 1.0:
            raise ValueError("min_inliers, min_share: must not be negative, min_share at most 1")
        if self.found_inliers < self.min_inliers or not self.min_share <= self.found_share <= 1.0:
            raise ValueError("found_inliers, found_share: must be at least min_inliers and min_share, found_share at most 1")

    def enough(self, seen: Agreement) -> bool:
        """Whether this much is believed of a camera that was tracked."""
        return seen.score >= self.min_inliers and seen.agreed >= self.min_share * seen.matches

    def found_again(self, found: PoseSolution, seen: Agreement) -> bool:
        """Whether the map alone says where a lost camera is."""
        enough = seen.score >= self.found_inliers and seen.agreed >= self.found_share * seen.matches
        return enough and found.unobservable.shape[1] == 0

    def judged(self, found: PoseSolution, seen: Agreement, rotation: Rotation) -> Verdict:
        """What is said of a refined pose."""
        points, lines, planes = seen.inliers
        status, reason = OK, f"{points} points, {lines} lines and {planes} planes of the map"
        if found.unobservable.shape[1]:
            status, reason = DEGRADED, f"{found.unobservable.shape[1]} directions of motion cannot be seen, held at the prediction"
        elif seen.score < self.min_inliers:
            status, reason = DEGRADED, f"only {points} points, {lines} lines and {planes} planes of the map were found"
        elif seen.agreed < self.min_share * seen.matches:
            status, reason = DEGRADED, f"only {seen.agreed} of {seen.matches} matches with the map agree"
        elif rotation.source == "prediction":
            status, reason = DEGRADED, "the rotation was predicted, not measured, before refinement"
        return Verdict(status, reason, found.covariance)
