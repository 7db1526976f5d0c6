"""All six degrees of freedom against the local map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.linalg import inv
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import (
    DEGRADED,
    F64,
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
from trihedron.plugins.mapping.reference_keyframe import reference_of, submap_of, transform_to_map
from trihedron.plugins.pose.calibration_uncertainty import contradicted_calibration
from trihedron.plugins.pose.decoupled_pose import FIRST_SIGMA, Decoupled, decoupled_pose
from trihedron.plugins.pose.dynamic_objects import MovingOptions, Selection, solve_with_static, status_with_static
from trihedron.plugins.pose.map_alignment import InlierStatistics, MapAlignment, TrackingStatus
from trihedron.plugins.pose.world_uncertainty import in_world, propagate_world_covariance, widened_by_keyframes
from trihedron.plugins.shared.pose_optimizer import PoseSolution

EYE = np.eye(3)
DETAILED = 100  # key points, or matches, with which a frame is expected to be recognised by them
AGREEMENT_FRAMES = 10  # that the agreement of matched points is averaged over
LEAST_AGREEMENT = 0.5  # less is no moment of blur and nobody who walks by; at least 0.65 of five cameras and three simulated ones
BLURRED_PX = 1.0  # blur that is worth a word: with more the covariance is half as large again
BY_CHANCE = 0.15  # of these matches that agree by chance: after a jump at most 0.08, between frames of a walk at least 0.31


@register("pose", "refine")
@dataclass(frozen=True)
class Refine(MovingOptions):
    """Map-to-frame refinement with parallel and perpendicular planes (section IV-C, eq. 8), from the decoupled pose.

    The decoupled rotation is a prior with its own covariance; the decoupled position is a weak prior (`position_sigma_m`), since the same features
    produced it. Without a map the decoupled pose stands. A lost pose is only an initial guess: it is relocalised when enough of the map agrees on a
    pose with all directions observable, else it stays lost; a pose that neither the previous frame nor the map supports is lost. The status then
    follows from the inliers, from dynamic objects (`dynamic_objects.py`), and from the keyframes' uncertainty (`world_uncertainty.py`)."""

    position_sigma_m: PositiveFloat = 0.05  # of the decoupled position, a weak prior
    rotation_sigma_deg: PositiveFloat = 0.2  # added to the rotation's own: no scene is exactly Manhattan
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    relation_sigma_deg: PositiveFloat = 0.5  # walls are parallel or perpendicular to within this
    min_inliers: NonNegativeInt = 10  # points + 2 lines + 5 planes below which the pose is degraded
    found_inliers: NonNegativeInt = 30  # points + 2 lines + 5 planes that relocalise a lost pose
    found_share: Share = 0.5  # of the matches that must be inliers for that
    min_continued: Share = 0.06  # of the key points with depth, known from the previous frame or the map; two rooms: 0.04, fast walks: at least 0.087
    weak_foundation: PositiveFloat = 3.0  # times the pose's σ beyond which the nearby keyframes' σ is added to it
    submap_after: NonNegativeInt = 5  # frames without relocalisation, of those that show enough, after which a sub-map begins; 0 = never

    def __post_init__(self) -> None:
        check_increasing(self, "min_inliers", "found_inliers")
        check_increasing(self, "min_share", "found_share")

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
        """Return the pose with status and reason; the identity for the first frame."""
        previous, relocalise = (transform_to_map(pose, map) if pose is not None else None for pose in (previous, relocalise))
        start = decoupled_pose(rotation, translation, previous, relocalise)
        if map is None or matches is None or previous is None:
            return start.to_pose(rotation, map)
        submap = relocalise.submap if relocalise is not None and relocalise.status == OK else submap_of(previous, map)
        problem = MapAlignment(self, start.T_world_camera, self._information(start), camera, matches, keypoints, segments, planes, map)
        solution, static = self._solve(problem, start)
        inliers = problem.statistics(solution)
        found_again = self._is_relocalised(solution, inliers) and not self._is_another_place(keypoints, matches, inliers.inliers[0])
        if start.status == LOST and not found_again:
            searched = relocalise is not None and translation.estimated
            return self._stay_lost(start, rotation, previous, searched, map, submap)
        if reason := self._contradiction(start, rotation, translation, keypoints, matches, inliers, submap):
            return propagate_world_covariance(replace(start, status=LOST, reason=reason).to_pose(rotation, map, submap=submap), previous)
        if not inliers.total:
            return propagate_world_covariance(
                start.to_pose(rotation, map, "nothing of the map was found, pose from the previous frame", submap), previous
            )
        status = self._status(problem, solution, static, inliers, rotation, submap)
        repeats = previous.repeats + 1 if tracks is not None and _repeats(tracks, keypoints, planes) else 0
        if status.status == OK and repeats > 1:  # a Kinect repeats single images
            status = replace(status, status=DEGRADED, reason="the images repeat the previous frame bit for bit: at rest, or frozen")
        T, held, counts = solution.T_world_camera, solution.unobservable.shape[1], np.array(inliers.inliers, np.int32)
        reference, T_reference_camera = reference_of(map, T, submap)
        stamps = rotation.index, rotation.stamp_ns
        pose = Pose(*stamps, T, status.covariance, T_reference_camera, reference, counts, held, status.status, status.reason, submap, repeats=repeats)
        pose = replace(in_world(pose, previous, solution, problem), agreement=_agreement(previous, inliers))
        contradiction = (_lasting_disagreement(pose) or contradicted_calibration(pose)) if pose.status == OK else ""
        return replace(pose, status=DEGRADED, reason=contradiction) if contradiction else pose

    def localising(self) -> Refine:
        """Return the refinement of a camera that begins no sub-map: where the loaded map does not reach it stays lost."""
        return replace(self, submap_after=0)

    def _information(self, start: Decoupled) -> F64:
        """Information (6, 6) of the decoupled pose as a prior."""
        information = np.zeros((6, 6))
        both = np.array([start.covariance[:3, :3], start.covariance[3:, 3:]])
        both[0] += self.position_sigma_m**2 * EYE
        both[1] += math.radians(self.rotation_sigma_deg) ** 2 * EYE
        information[:3, :3], information[3:, 3:] = inv(both)
        return information

    def _solve(self, problem: MapAlignment, start: Decoupled) -> tuple[PoseSolution, Selection | None]:
        """Estimate the pose; also the selection of static matches that it was estimated by, None for all matches."""
        if start.status == LOST:
            return problem.solve(problem.terms(problem.T_start)), None
        return solve_with_static(problem, self)

    def _is_tracked(self, inliers: InlierStatistics) -> bool:
        """Return True if enough of the map agrees with a tracked pose."""
        return inliers.score >= self.min_inliers and inliers.total >= self.min_share * inliers.matches

    def _is_relocalised(self, solution: PoseSolution, inliers: InlierStatistics) -> bool:
        """Return True if the map alone determines the pose of a lost camera."""
        enough = inliers.score >= self.found_inliers and inliers.total >= self.found_share * inliers.matches
        return enough and solution.unobservable.shape[1] == 0

    def _is_another_place(self, keypoints: Keypoints, matches: Matches, continued: int) -> bool:
        """Return True if the frame has details where details are expected, and hardly one of them is known from the previous frame or the map: what
        its planes and lines agree with is then a place built alike."""
        with_depth = int(np.count_nonzero(np.isfinite(keypoints.points_m[:, 2])))
        expected = min(with_depth, len(matches.visible_points))
        return expected >= DETAILED and continued < self.min_continued * with_depth

    def _contradiction(
        self,
        start: Decoupled,
        rotation: Rotation,
        translation: Translation,
        keypoints: Keypoints,
        matches: Matches,
        inliers: InlierStatistics,
        submap: int,
    ) -> str:
        """Return why a frame is lost although the previous one, or relocalisation, gave it a pose; empty where nothing contradicts that."""
        tracked, agree = self._is_tracked(inliers), f"only {inliers.total} of {inliers.matches} matches"
        if rotation.source == "prediction" and not tracked:
            return f"the rotation was not measured, and {agree} with the map agree"
        continued = int(translation.inliers[0]), inliers.inliers[0]
        if start.status != LOST and self._is_another_place(keypoints, matches, max(continued)):
            known = f"{continued[0]} key points continue the previous frame and {continued[1]} are in the map"
            return f"another place: of {len(keypoints.pixels)}, {known}"
        if start.status != LOST and inliers.matches >= DETAILED and inliers.total < BY_CHANCE * inliers.matches:
            return f"the frame contradicts the map: {agree} agree"
        if submap and not tracked:  # nothing ties it to the sub-map: it is searched for in the others
            return f"sub-map {submap} does not show what the frame does: {agree} agree"
        return ""

    def _status(
        self, problem: MapAlignment, solution: PoseSolution, static: Selection | None, inliers: InlierStatistics, rotation: Rotation, submap: int
    ) -> TrackingStatus:
        """Status of a refined pose: by its inliers, dynamic objects, keyframes and sub-map."""
        status = self._inlier_status(solution, inliers, rotation)
        if static is not None:
            status = status_with_static(status, solution, problem, static, self)
        if status.status == OK:
            status = widened_by_keyframes(status, solution, problem, self.weak_foundation)
        if problem.keypoints.blur_px >= BLURRED_PX:
            status = replace(status, reason=f"{status.reason}; the image is blurred by {problem.keypoints.blur_px:.1f} px: turn slower")
        if submap:
            status = replace(status, status=DEGRADED, reason=f"in sub-map {submap}, which is not merged with the first yet: {status.reason}")
        return status

    def _inlier_status(self, solution: PoseSolution, inliers: InlierStatistics, rotation: Rotation) -> TrackingStatus:
        """Status of a refined pose by the number and share of its inliers."""
        points, lines, planes = inliers.inliers
        status, reason = OK, f"{points} points, {lines} lines and {planes} planes of the map"
        if solution.unobservable.shape[1]:
            status, reason = DEGRADED, f"{solution.unobservable.shape[1]} directions of motion are unobservable, held at the prediction"
        elif inliers.score < self.min_inliers:
            status, reason = DEGRADED, f"only {points} points, {lines} lines and {planes} planes of the map were found"
        elif inliers.total < self.min_share * inliers.matches:
            status, reason = DEGRADED, f"only {inliers.total} of {inliers.matches} matches with the map agree"
        elif rotation.source == "prediction":
            status, reason = DEGRADED, "the rotation was predicted, not measured, before refinement"
        return TrackingStatus(status, reason, solution.covariance)

    def _stay_lost(self, start: Decoupled, rotation: Rotation, previous: Pose, searched: bool, map: Map, submap: int) -> Pose:
        """Return a lost pose; or, once relocalisation has failed for `submap_after` frames (`searched`), the first pose of a sub-map, exact by
        definition."""
        unrecognised = previous.unrecognised + int(searched)
        if not self.submap_after or unrecognised < self.submap_after:
            return propagate_world_covariance(replace(start.to_pose(rotation, map, submap=submap), unrecognised=unrecognised), previous)
        number = int(map.keyframes.column("submap").max(initial=0)) + 1
        reason = f"first frame of sub-map {number}: relocalisation failed for {unrecognised} frames"
        new = replace(start, covariance=FIRST_SIGMA**2 * np.eye(6), status=DEGRADED, reason=reason)
        pose, information = new.to_pose(rotation, map, submap=number), previous.calibration_information
        return replace(pose, calibration_information=information, calibration_score=previous.calibration_score)


def _agreement(previous: Pose, inliers: InlierStatistics) -> float:
    """Return the moving average of the share of matched points that agree; a frame with few of them says nothing."""
    if inliers.matched[0] < DETAILED:
        return previous.agreement
    return previous.agreement + (inliers.inliers[0] / inliers.matched[0] - previous.agreement) / AGREEMENT_FRAMES


def _lasting_disagreement(pose: Pose) -> str:
    """Return why what is seen has contradicted the map for a while, empty where most of it agrees."""
    if pose.agreement >= LEAST_AGREEMENT:
        return ""
    return f"colour, depth and map contradict each other: of late {100.0 * pose.agreement:.0f} % of the matched points agree"


def _repeats(tracks: Tracks, keypoints: Keypoints, planes: Planes) -> bool:
    """Return True if every tracked key point and plane is bit-identical to that of the previous frame, which no two images of a sensor are."""
    points, walls = keypoints.points_m[tracks.keypoints[:, 1]], planes.coefficients[tracks.planes[:, 1]]
    return bool(len(points) + len(walls)) and np.array_equal(tracks.points_m, points, True) and np.array_equal(tracks.coefficients, walls, True)
