"""Poses where something moves: by what is at rest alone, where all the others pull away from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.types import DEGRADED, OK
from trihedron.plugins.numerics.maps.at_rest import (
    LEAST,
    ON_PLANES,
    PLANES,
    PROVEN,
    AtRest,
    at_rest,
    distance2,
    planes_alone,
    position_chi2,
    position_distance2,
    proven_planes,
    spread_about,
)
from trihedron.plugins.numerics.maps.map_alignment import Agreement, MapAlignment, Verdict
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution, Terms

FIRST_SHARE = 0.5  # of the limit that a first step must reach before the rest is solved for by itself
ALL = "all"  # nothing that is at rest says more than all matches do


@dataclass(frozen=True)
class MovingObjects:
    """When what is at rest (`at_rest`) is taken alone, and when what is left is too little to be sure which of the two moves."""

    moving_share: float = 0.15  # by which the shares of new and of proven points that disagree may differ; beyond, something may move
    moving_gate: float = 2.2  # squared standard deviations (the lowest tenth of χ²) from the pose by what is proven alone, beyond which that is taken
    moving_sure: float = 13.9  # the same of the position (0.997 of χ²), beyond which it is taken although the new and the proven disagree alike
    moving_unproven: float = 9.0  # the same from the position by planes alone, beyond which those are taken while nothing can be proven
    moving_most: float = 0.4  # of all matches that must agree, half if no more of the planes do, else the pose is degraded, known as planes say

    def __post_init__(self) -> None:
        if not 0.0 < self.moving_share <= 1.0 or not 0.0 <= self.moving_most <= 1.0:
            raise ValueError("moving_share, moving_most: must be positive and at most 1")
        if min(self.moving_gate, self.moving_sure, self.moving_unproven) <= 0.0:
            raise ValueError("moving_gate, moving_sure, moving_unproven: must be positive")

    def solved_at_rest(self, problem: MapAlignment) -> tuple[PoseSolution, str]:
        """The solution by all matches and ''; or, where something moves and pulls the pose away, that of what is at rest, with all matches judged by
        it, and what that is. Where most disagree even so, no more is known than the planes say."""
        terms = problem.terms(problem.T_start)
        found, by = problem.solved(terms), ""
        seen = problem.agreement(found)
        for rest in at_rest(problem.map, problem.matches, problem.keypoints, problem.segments, problem.planes):
            alone = self._alone(found, seen, problem, terms, rest)
            if alone is not None:
                found, by = problem.judged(alone), rest.name
                break
        if len(found.points) >= LEAST and self._denied(problem, found, by):
            by = by or ALL
            found = replace(found, covariance=spread_about(found, problem.solved(planes_alone(problem.matches).only(terms))))
        return found, by

    def judged_at_rest(self, found: PoseSolution, problem: MapAlignment, by: str, said: Verdict) -> Verdict:
        """What is said of a pose found by what is at rest; where most of what is seen denies it, or the planes alone agree, it may be something
        else."""
        if by == PLANES or (said.status == OK and self._denied(problem, found, by)):
            seen = problem.agreement(found)
            reason = f"something moves: only {seen.agreed} of {seen.matches} matches agree" + (f" with {by}" if by != ALL else "")
            return replace(said, status=DEGRADED, reason=reason)
        return replace(said, reason=f"{said.reason}, by {by} alone") if by != ALL else said

    def _alone(self, found: PoseSolution, seen: Agreement, problem: MapAlignment, terms: Terms, rest: AtRest) -> PoseSolution | None:
        """The solution by what is at rest alone, where all the others pull the pose away from the one found, which is agreed on as `seen`."""
        far = self.moving_unproven if rest.name == PLANES else self.moving_sure
        contradicted = rest.contradicted(found.points) >= self.moving_share or (rest.name == PROVEN and seen.fewer_planes)
        if not contradicted and (1.0 - seen.agreed / max(seen.matches, 1) < self.moving_share or seen.sought[2] == 0):
            return None
        if not contradicted and position_chi2(*problem.first_step(found.T_world_camera, terms, rest.flags(terms))) < FIRST_SHARE * far:
            return None
        alone = problem.solved(rest.only(terms))
        if rest.name == ON_PLANES and problem.agreement(alone).fewer_planes:  # planes that disagree with each other say nothing
            return None
        pulled = distance2(alone, found) >= self.moving_gate if contradicted else position_distance2(alone, found) > far
        return alone if pulled and (rest.name == PLANES or not alone.unobservable.shape[1]) else None

    def _denied(self, problem: MapAlignment, found: PoseSolution, by: str) -> bool:
        """Whether most of all that is seen disagrees with a pose; if of the planes as well, the larger part is enough, by more than one standard
        deviation of such a count. One by what lies on planes is denied by most and those planes that were met before: what is flat may move too."""
        seen = problem.agreement(found)
        agreed, sought, planes, same = seen.agreed, seen.matches, seen.inliers[2], seen.sought[2]
        by_larger = 2.0 * agreed < sought - sought**0.5
        if by == ON_PLANES:
            known = proven_planes(problem.map, problem.matches)
            return by_larger and bool(2 * np.count_nonzero(found.planes[:same][known]) <= np.count_nonzero(known))
        return agreed < self.moving_most * sought or (by_larger and bool(2 * planes <= same))
