"""All six degrees of freedom against the local map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.geometry import invert
from trihedron.pipeline.registry import register
from trihedron.pipeline.types import (
    DEGRADED,
    F64,
    I32,
    LOST,
    OK,
    Camera,
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
    spread_about,
)
from trihedron.plugins.numerics.maps.decoupled import FIRST_SIGMA, Decoupled, decoupled_pose, reference_of
from trihedron.plugins.numerics.maps.focal_check import focal_check
from trihedron.plugins.numerics.maps.focal_motion import focal_motion
from trihedron.plugins.numerics.maps.foundations import SCORE, foundation
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of
from trihedron.plugins.numerics.maps.map_terms import line_terms, plane_terms, point_terms
from trihedron.plugins.numerics.maps.submaps import submap_of
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution, Terms, classify_terms, first_step, solve_pose

FIRST_SHARE = 0.5  # of the limit that a first step must reach before the rest is solved for by itself
ALL = "all"  # nothing that is at rest says more than all matches do


@register("pose", "refine")
@dataclass(frozen=True)
class Refine:
    """Map-to-frame refinement with parallel and perpendicular planes (section IV-C, eq. 8), from the decoupled pose.

    The decoupled rotation is a prior with its own covariance; the decoupled position only says where to start (`position_sigma_m`), since the same
    features made it. Without a map the decoupled pose stands. A lost pose is only where to look: it is found again when enough of the map agrees on a
    place that all directions are measured of, else it stays lost; and what neither the previous frame nor the map agrees with is lost. Where
    something moves, what is at rest says the pose: what lies on planes, or was measured by two keyframes in one place (`numerics/maps/at_rest`). What
    moves as under other focal lengths is degraded (`numerics/maps/focal_motion`, and `focal_check` of the keyframes)."""

    position_sigma_m: float = 0.05  # of the decoupled position, a weak prior
    rotation_sigma_deg: float = 0.2  # added to the rotation's own: no scene is exactly Manhattan
    line_sigma_px: float = 1.0  # of a segment's end point across it
    relation_sigma_deg: float = 0.5  # walls are parallel or perpendicular to within this
    min_inliers: int = 10  # points + 2 lines + 5 planes below which the pose is called degraded
    min_share: float = 0.25  # of the matches that must agree, else it is called degraded
    found_inliers: int = 30  # points + 2 lines + 5 planes that find a lost pose again
    found_share: float = 0.5  # of the matches that must agree for that
    weak_foundation: float = 3.0  # times its own standard deviation that the map's keyframes about here may have before a pose is called degraded
    focal_off: float = 0.1  # share by which the focal lengths are off, beyond which a pose is called degraded, if the map's newest keyframes
    focal_worse: float = 0.2  # fit by this share worse for it
    focal_sure: float = 2.0  # or, while these are few, standard deviations by which the points that move tell so
    moving_share: float = 0.15  # by which the shares of new and of proven points that disagree may differ; beyond, something may move
    moving_gate: float = 2.2  # squared standard deviations (the lowest tenth of χ²) from the pose by what is proven alone, beyond which that is taken
    moving_sure: float = 13.9  # the same of the position (0.997 of χ²), beyond which it is taken although the new and the proven disagree alike
    moving_unproven: float = 9.0  # the same from the position by planes alone, beyond which those are taken while nothing can be proven
    moving_most: float = 0.4  # of all matches that must agree, half if no more of the planes do, else the pose is degraded, known as planes say
    submap_after: int = 15  # frames that show a place that is not known, after which a lost camera begins a new sub-map; 0 = never

    def __post_init__(self) -> None:
        for name in ("position_sigma_m", "rotation_sigma_deg", "line_sigma_px", "relation_sigma_deg"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"{name}: must be positive")
        if self.min_inliers < 0 or not 0.0 <= self.min_share <= 1.0:
            raise ValueError("min_inliers, min_share: must not be negative, min_share at most 1")
        if self.weak_foundation <= 0.0:
            raise ValueError("weak_foundation: must be positive")
        if min(self.focal_off, self.focal_worse, self.focal_sure) <= 0.0:
            raise ValueError("focal_off, focal_worse, focal_sure: must be positive")
        if not 0.0 < self.moving_share <= 1.0 or not 0.0 <= self.moving_most <= 1.0:
            raise ValueError("moving_share, moving_most: must be positive and at most 1")
        if min(self.moving_gate, self.moving_sure, self.moving_unproven) <= 0.0:
            raise ValueError("moving_gate, moving_sure, moving_unproven: must be positive")
        if self.submap_after < 0:
            raise ValueError("submap_after: must not be negative")
        if self.found_inliers < self.min_inliers or not self.min_share <= self.found_share <= 1.0:
            raise ValueError("found_inliers, found_share: must be at least min_inliers and min_share, found_share at most 1")

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
        found, moving = self._solved(start, frame, matches, keypoints, segments, planes, map)
        inliers = _inliers(found, len(matches.planes))
        sought = len(matches.keypoints) + len(matches.segments) + len(matches.planes)
        if start.status == LOST and not self._found_again(found, inliers, sought):
            return self._unknown_place(start, frame, previous, relocalise is not None and translation.estimated, map, submap)
        enough = inliers @ SCORE >= self.min_inliers and inliers.sum() >= self.min_share * sought
        if rotation.source == "prediction" and not enough:
            reason = f"the rotation was not measured, and only {inliers.sum()} of {sought} matches with the map agree"
            return replace(start, status=LOST, reason=reason).said(frame, map, submap=submap)
        if not inliers.any():
            return start.said(frame, map, "nothing of the map was found, pose from the previous frame", submap)
        status, reason = self._judge(found, inliers, sought, rotation)
        if moving:
            status, reason = self._judge_moving(inliers, matches, moving, status, reason)
        covariance = found.covariance
        if status == OK:
            said = self._judge_foundation(found, matches, map, reason)
            status, reason, covariance = self._judge_camera(found, frame, keypoints, matches, map, *said)
        if submap:
            status, reason = DEGRADED, f"in sub-map {submap}, which is not tied to the first yet: {reason}"
        T, held = found.T_world_camera, found.unobservable.shape[1]
        reference, T_reference_camera = reference_of(map, T, submap)
        return Pose(frame.index, frame.stamp_ns, T, covariance, T_reference_camera, reference, inliers, held, status, reason, submap)

    def _unknown_place(self, start: Decoupled, frame: Frame, previous: Pose, sought: bool, map: Map, submap: int) -> Pose:
        """Lost; or, once what is seen was `sought` in vain for long enough, the first pose of a new sub-map, exact by definition."""
        unrecognised = previous.unrecognised + int(sought)
        if not self.submap_after or unrecognised < self.submap_after:
            return replace(start.said(frame, map, submap=submap), unrecognised=unrecognised)
        number = int(map.keyframes.column("submap").max(initial=0)) + 1
        reason = f"first frame of sub-map {number}: nothing was recognised for {unrecognised} frames"
        new = replace(start, covariance=FIRST_SIGMA**2 * np.eye(6), status=DEGRADED, reason=reason)
        return new.said(frame, map, submap=number)

    def _prior(self, start: Decoupled) -> F64:
        """Information (6, 6) of the decoupled pose."""
        prior = np.zeros((6, 6))
        prior[:3, :3] = np.linalg.inv(self.position_sigma_m**2 * np.eye(3) + start.covariance[:3, :3])
        prior[3:, 3:] = np.linalg.inv(start.covariance[3:, 3:] + np.radians(self.rotation_sigma_deg) ** 2 * np.eye(3))
        return prior

    def _terms(
        self, T_world_camera: F64, frame: Frame, matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map
    ) -> Terms:
        """All matches as terms, lines taken as they are seen from a pose."""
        return (
            point_terms(map, keypoints, matches.keypoints),
            line_terms(map, segments, matches.segments, T_world_camera, frame.camera, self.line_sigma_px),
            plane_terms(map, planes, matches.planes, matches.parallel, matches.perpendicular, self.relation_sigma_deg),
        )

    def _solved(
        self, start: Decoupled, frame: Frame, matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map
    ) -> tuple[PoseSolution, str]:
        """The solution by all matches and ''; or, where something moves and pulls the pose away, that of what is at rest, with all matches judged by
        it, and what that is. Where most disagree even so, no more is known than the planes say."""
        prior, T = (frame.camera, start.T_world_camera, self._prior(start)), start.T_world_camera
        terms, same = self._terms(T, frame, matches, keypoints, segments, planes, map), len(matches.planes)
        sought = len(matches.keypoints) + len(matches.segments) + same
        found, by = solve_pose(T, *prior, *terms), ""
        if start.status == LOST:
            return found, by
        for rest in at_rest(map, matches, keypoints, segments, planes):
            alone = self._alone(found, T, prior, terms, rest, same)
            if alone is not None:
                again = self._terms(alone.T_world_camera, frame, matches, keypoints, segments, planes, map)
                flags = classify_terms(alone.T_world_camera, frame.camera, *again)
                found, by = replace(alone, points=flags.points, lines=flags.lines, planes=flags.planes), rest.name
                break
        if by != ON_PLANES and len(found.points) >= LEAST and self._denied(_inliers(found, same), sought, same):
            by = by or ALL
            found = replace(found, covariance=spread_about(found, solve_pose(T, *prior, *planes_alone(matches).only(terms))))
        return found, by

    def _alone(self, found: PoseSolution, T: F64, prior: tuple[Camera, F64, F64], terms: Terms, rest: AtRest, same: int) -> PoseSolution | None:
        """The solution from T by what is at rest alone, where all the others pull the pose away from it."""
        contradicted, far = rest.contradicted(found.points) >= self.moving_share, self.moving_unproven if rest.name == PLANES else self.moving_sure
        contradicted |= rest.name == PROVEN and 2 * int(np.count_nonzero(found.planes[:same])) < same
        if not contradicted and (1.0 - _agreed(found, same) < self.moving_share or same == 0):
            return None
        only = rest.only(terms)
        if not contradicted and position_chi2(*first_step(found.T_world_camera, *prior, only)) < FIRST_SHARE * far:
            return None
        alone = solve_pose(T, *prior, *only)
        if rest.name == ON_PLANES and 2 * np.count_nonzero(alone.planes[:same]) < same:  # planes that disagree with each other say nothing
            return None
        pulled = distance2(alone, found) >= self.moving_gate if contradicted else position_distance2(alone, found) > far
        return alone if pulled and (rest.name == PLANES or not alone.unobservable.shape[1]) else None

    def _found_again(self, found: PoseSolution, inliers: I32, sought: int) -> bool:
        """Whether the map alone says where a lost camera is."""
        enough = inliers @ SCORE >= self.found_inliers and inliers.sum() >= self.found_share * sought
        return bool(enough) and found.unobservable.shape[1] == 0

    def _judge(self, found: PoseSolution, inliers: I32, sought: int, rotation: Rotation) -> tuple[str, str]:
        """Status and reason of a refined pose."""
        if found.unobservable.shape[1]:
            return DEGRADED, f"{found.unobservable.shape[1]} directions of motion cannot be seen, held at the prediction"
        if inliers @ SCORE < self.min_inliers:
            return DEGRADED, f"only {inliers[0]} points, {inliers[1]} lines and {inliers[2]} planes of the map were found"
        if inliers.sum() < self.min_share * sought:
            return DEGRADED, f"only {inliers.sum()} of {sought} matches with the map agree"
        if rotation.source == "prediction":
            return DEGRADED, "the rotation was predicted, not measured, before refinement"
        return OK, f"{inliers[0]} points, {inliers[1]} lines and {inliers[2]} planes of the map"

    def _denied(self, inliers: I32, sought: int, same: int) -> bool:
        """Whether most of all that is seen disagrees with a pose; if of the planes as well, the larger part is enough, by more than one standard
        deviation of such a count."""
        agreed = int(inliers.sum())
        return agreed < self.moving_most * sought or (2.0 * agreed < sought - sought**0.5 and 2 * int(inliers[2]) <= same)

    def _judge_moving(self, inliers: I32, matches: Matches, by: str, status: str, reason: str) -> tuple[str, str]:
        """The same, of what is at rest; where most of what is seen denies it, or the planes alone agree, it may be something else."""
        same = len(matches.planes)
        sought = len(matches.keypoints) + len(matches.segments) + same
        if by == PLANES or (by != ON_PLANES and status == OK and self._denied(inliers, sought, same)):
            return DEGRADED, f"something moves: only {inliers.sum()} of {sought} matches agree" + (f" with {by}" if by != ALL else "")
        return status, f"{reason}, by {by} alone" if by != ALL else reason

    def _judge_foundation(self, found: PoseSolution, matches: Matches, map: Map, reason: str) -> tuple[str, str, F64]:
        """Status, reason and covariance. A pose is not better known than the keyframes behind what it was found from, which may be poor: after a
        loss, or where planes alone said where they are."""
        points, lines = matches.keypoints[found.points > 0, 1], matches.segments[found.lines > 0, 1]
        base = foundation(map, points, lines, matches.planes[found.planes[: len(matches.planes)] > 0, 1])
        if base.sigma_m <= self.weak_foundation * np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]):
            return OK, reason, found.covariance
        covariance = found.covariance + base.covariance(map, found.T_world_camera)
        return DEGRADED, f"what is seen hangs on keyframes that are known to {1e3 * base.sigma_m:.0f} mm", covariance

    def _judge_camera(
        self, found: PoseSolution, frame: Frame, keypoints: Keypoints, matches: Matches, map: Map, status: str, reason: str, covariance: F64
    ) -> tuple[str, str, F64]:
        """The same under focal lengths that may be wrong, which squeeze the world: nothing is known as well as it seems then, nor while the data do
        not say yet that they are right."""
        if (check := focal_check(map)) is not None and (doubt := check.doubt(self.focal_off, self.focal_worse)):
            first = map.keyframes.rows("T_world_camera", keyframes_of(map, current_submap(map))[:1])[0]
            depths_m = keypoints.points_m[matches.keypoints[:, 0], 2]
            return DEGRADED, doubt, covariance + check.covariance(invert(first) @ found.T_world_camera, depths_m)
        motion = focal_motion(map, frame, keypoints, matches, found.points, found.T_world_camera)
        if motion is None or motion.verified(self.focal_off, self.focal_sure):
            return status, reason, covariance
        doubt = motion.doubt(self.focal_off, self.focal_sure)
        if not doubt and len(map.keyframes) > 1:  # keyframes would hand it on to landmarks, as if it were the error of each
            return status, reason, covariance
        return DEGRADED if doubt else status, doubt or reason, covariance + motion.covariance(self.focal_off)


def _agreed(found: PoseSolution, same: int) -> float:
    """Share of all matches that agree with the pose."""
    return float(_inliers(found, same).sum() / max(len(found.points) + len(found.lines) + same, 1))


def _inliers(found: PoseSolution, same: int) -> I32:
    """Points, lines and planes (relations not counted) that agree with the pose."""
    return np.array([np.count_nonzero(found.points), np.count_nonzero(found.lines), np.count_nonzero(found.planes[:same])], np.int32)
