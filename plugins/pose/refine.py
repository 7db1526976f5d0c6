"""All six degrees of freedom against the local map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import (
    DEGRADED,
    F64,
    LOST,
    OK,
    Frame,
    Keypoints,
    Map,
    Matches,
    Planes,
    Pose,
    Rotation,
    Segments,
    Tracks,
    Translation,
)
from trihedron.plugins.numerics.maps.anchoring import anchored
from trihedron.plugins.numerics.maps.decoupled import FIRST_SIGMA, Decoupled, decoupled_pose, reference_of
from trihedron.plugins.numerics.maps.focal_lengths import FocalLengths
from trihedron.plugins.numerics.maps.foundations import Foundations
from trihedron.plugins.numerics.maps.map_alignment import MapAlignment
from trihedron.plugins.numerics.maps.moving_objects import MovingObjects
from trihedron.plugins.numerics.maps.submaps import submap_of
from trihedron.plugins.numerics.maps.tracking_quality import TrackingQuality

EYE = np.eye(3)


@register("pose", "refine")
@dataclass(frozen=True)
class Refine(TrackingQuality, MovingObjects, Foundations, FocalLengths):
    """Map-to-frame refinement with parallel and perpendicular planes (section IV-C, eq. 8), from the decoupled pose.

    The decoupled rotation is a prior with its own covariance; the decoupled position only says where to start (`position_sigma_m`), since the same
    features made it. Without a map the decoupled pose stands. A lost pose is only where to look: it is found again when enough of the map agrees on a
    place that all directions are measured of, else it stays lost; and what neither the previous frame nor the map agrees with is lost. Each judgement
    of a pose is a base of its own, with its options: whether enough of the map agrees, what moves, how well the map there is known, and whether the
    focal lengths are right."""

    position_sigma_m: float = 0.05  # of the decoupled position, a weak prior
    rotation_sigma_deg: float = 0.2  # added to the rotation's own: no scene is exactly Manhattan
    line_sigma_px: float = 1.0  # of a segment's end point across it
    relation_sigma_deg: float = 0.5  # walls are parallel or perpendicular to within this
    submap_after: int = 15  # frames that show a place that is not known, after which a lost camera begins a new sub-map; 0 = never

    def __post_init__(self) -> None:
        for name in ("position_sigma_m", "rotation_sigma_deg", "line_sigma_px", "relation_sigma_deg"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"{name}: must be positive")
        if self.submap_after < 0:
            raise ValueError("submap_after: must not be negative")
        for judgement in Refine.__bases__:
            judgement.__post_init__(self)  # type: ignore[attr-defined]

    def __call__(
        self,
        frame: Frame,
        rotation: Rotation,
        translation: Translation,
        tracks: Tracks | None,
        matches: Matches | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Pose | None,
        map: Map | None,
        relocalise: Pose | None,
    ) -> Pose:
        """The pose with status and reason; the identity for the first frame."""
        previous, relocalise = (anchored(said, map) if said is not None else None for said in (previous, relocalise))
        start = decoupled_pose(rotation, translation, previous, relocalise)
        if map is None or matches is None or previous is None:
            return start.said(frame, map)
        submap = relocalise.submap if relocalise is not None and relocalise.status == OK else submap_of(previous, map)
        prior, sigmas = (start.T_world_camera, self._information(start)), (self.line_sigma_px, self.relation_sigma_deg)
        problem = MapAlignment(*prior, frame, matches, keypoints, segments, planes, map, *sigmas)
        found, by = self.solved_at_rest(problem) if start.status != LOST else (problem.solved(problem.terms(problem.T_start)), "")
        seen = problem.agreement(found)
        if start.status == LOST and not self.found_again(found, seen):
            return self._unknown_place(start, frame, previous, relocalise is not None and translation.estimated, map, submap)
        if rotation.source == "prediction" and not self.enough(seen):
            reason = f"the rotation was not measured, and only {seen.agreed} of {seen.matches} matches with the map agree"
            return replace(start, status=LOST, reason=reason).said(frame, map, submap=submap)
        if not seen.agreed:
            return start.said(frame, map, "nothing of the map was found, pose from the previous frame", submap)
        said = self.judged(found, seen, rotation)
        if by:
            said = self.judged_at_rest(found, problem, by, said)
        if said.status == OK:
            said = self.judged_by_focal_lengths(found, problem, self.judged_by_foundation(found, problem, said))
        if submap:
            said = replace(said, status=DEGRADED, reason=f"in sub-map {submap}, which is not tied to the first yet: {said.reason}")
        T, held, inliers = found.T_world_camera, found.unobservable.shape[1], np.array(seen.inliers, np.int32)
        reference, T_reference_camera = reference_of(map, T, submap)
        return Pose(
            frame.index, frame.stamp_ns, T, said.covariance, T_reference_camera, reference, inliers, held, said.status, said.reason, submap
        )

    def _information(self, start: Decoupled) -> F64:
        """(6, 6) of the decoupled pose as a prior."""
        information = np.zeros((6, 6))
        both = np.array([start.covariance[:3, :3], start.covariance[3:, 3:]])
        both[0] += self.position_sigma_m**2 * EYE
        both[1] += math.radians(self.rotation_sigma_deg) ** 2 * EYE
        information[:3, :3], information[3:, 3:] = np.linalg.inv(both)
        return information

    def _unknown_place(self, start: Decoupled, frame: Frame, previous: Pose, sought: bool, map: Map, submap: int) -> Pose:
        """Lost; or, once what is seen was `sought` in vain for long enough, the first pose of a new sub-map, exact by definition."""
        unrecognised = previous.unrecognised + int(sought)
        if not self.submap_after or unrecognised < self.submap_after:
            return replace(start.said(frame, map, submap=submap), unrecognised=unrecognised)
        number = int(map.keyframes.column("submap").max(initial=0)) + 1
        reason = f"first frame of sub-map {number}: nothing was recognised for {unrecognised} frames"
        new = replace(start, covariance=FIRST_SIGMA**2 * np.eye(6), status=DEGRADED, reason=reason)
        return new.said(frame, map, submap=number)
