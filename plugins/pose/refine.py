"""Whether enough of the map was found for a pose to be believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.geometry import adjoint, invert
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import (
    DEGRADED,
    F64,
    I32,
    LOST,
    OK,
    Camera,
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
from trihedron.plugins.mapping.reference_keyframe import FIRST_SIGMA, Decoupled, anchored, decoupled_pose, reference_of
from trihedron.plugins.mapping.submaps import submap_of
from trihedron.plugins.pose.dynamic_objects import MovingObjects
from trihedron.plugins.pose.focal_length import FocalLengths
from trihedron.plugins.pose.map_alignment import SCORE, Agreement, MapAlignment, Verdict
from trihedron.plugins.shared.pose_optimizer import PoseSolution


@dataclass(frozen=True)
class TrackingQuality:
    """How much of what is sought must agree with a pose; and with the first one after a loss, which has nothing else to go by."""

    min_inliers: NonNegativeInt = 10  # points + 2 lines + 5 planes below which the pose is called degraded
    min_share: Share = 0.25  # of the matches that must agree, else it is called degraded
    found_inliers: NonNegativeInt = 30  # points + 2 lines + 5 planes that find a lost pose again
    found_share: Share = 0.5  # of the matches that must agree for that

    def __post_init__(self) -> None:
        check_increasing(self, "min_inliers", "found_inliers")
        check_increasing(self, "min_share", "found_share")

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


# How well the part of a map that a pose was found in is known itself.


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

    weak_foundation: PositiveFloat = 3.0  # times its own standard deviation that the nearby keyframes may have before a pose is degraded

    def judged_by_foundation(self, found: PoseSolution, problem: MapAlignment, said: Verdict) -> Verdict:
        """What is said of a pose, which is not better known than the keyframes behind what it was found from."""
        base = foundation(problem.map, *problem.landmarks(found))
        if base.sigma_m <= self.weak_foundation * np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]):
            return said
        reason = f"what is seen hangs on keyframes that are known to {1e3 * base.sigma_m:.0f} mm"
        return Verdict(DEGRADED, reason, said.covariance + base.covariance(problem.map, found.T_world_camera))


# All six degrees of freedom against the local map.

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

    position_sigma_m: PositiveFloat = 0.05  # of the decoupled position, a weak prior
    rotation_sigma_deg: PositiveFloat = 0.2  # added to the rotation's own: no scene is exactly Manhattan
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    relation_sigma_deg: PositiveFloat = 0.5  # walls are parallel or perpendicular to within this
    submap_after: NonNegativeInt = 15  # frames that show a place that is not known, after which a lost camera begins a new sub-map; 0 = never

    def __call__(
        self,
        camera: Camera,
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
            return start.said(rotation, map)
        submap = relocalise.submap if relocalise is not None and relocalise.status == OK else submap_of(previous, map)
        prior, sigmas = (start.T_world_camera, self._information(start)), (self.line_sigma_px, self.relation_sigma_deg)
        problem = MapAlignment(*prior, camera, matches, keypoints, segments, planes, map, *sigmas)
        found, by = self.solved_at_rest(problem) if start.status != LOST else (problem.solved(problem.terms(problem.T_start)), "")
        seen = problem.agreement(found)
        if start.status == LOST and not self.found_again(found, seen):
            return self._unknown_place(start, rotation, previous, relocalise is not None and translation.estimated, map, submap)
        if rotation.source == "prediction" and not self.enough(seen):
            reason = f"the rotation was not measured, and only {seen.agreed} of {seen.matches} matches with the map agree"
            return replace(start, status=LOST, reason=reason).said(rotation, map, submap=submap)
        if not seen.agreed:
            return start.said(rotation, map, "nothing of the map was found, pose from the previous frame", submap)
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
            rotation.index, rotation.stamp_ns, T, said.covariance, T_reference_camera, reference, inliers, held, said.status, said.reason, submap
        )

    def localising(self) -> Refine:
        """Return the refinement of a camera that begins no sub-map: where the loaded map does not reach it stays lost."""
        return replace(self, submap_after=0)

    def _information(self, start: Decoupled) -> F64:
        """(6, 6) of the decoupled pose as a prior."""
        information = np.zeros((6, 6))
        both = np.array([start.covariance[:3, :3], start.covariance[3:, 3:]])
        both[0] += self.position_sigma_m**2 * EYE
        both[1] += math.radians(self.rotation_sigma_deg) ** 2 * EYE
        information[:3, :3], information[3:, 3:] = np.linalg.inv(both)
        return information

    def _unknown_place(self, start: Decoupled, rotation: Rotation, previous: Pose, sought: bool, map: Map, submap: int) -> Pose:
        """Lost; or, once what is seen was `sought` in vain for long enough, the first pose of a new sub-map, exact by definition."""
        unrecognised = previous.unrecognised + int(sought)
        if not self.submap_after or unrecognised < self.submap_after:
            return replace(start.said(rotation, map, submap=submap), unrecognised=unrecognised)
        number = int(map.keyframes.column("submap").max(initial=0)) + 1
        reason = f"first frame of sub-map {number}: nothing was recognised for {unrecognised} frames"
        new = replace(start, covariance=FIRST_SIGMA**2 * np.eye(6), status=DEGRADED, reason=reason)
        return new.said(rotation, map, submap=number)
