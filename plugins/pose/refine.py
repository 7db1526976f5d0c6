"""All six degrees of freedom against the local map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.linalg import inv
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, check_increasing
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
from trihedron.plugins.pose.calibration_uncertainty import plane_sigmas_m
from trihedron.plugins.pose.continuity import with_motion
from trihedron.plugins.pose.decoupled_pose import FIRST_SIGMA, Decoupled, decoupled_pose
from trihedron.plugins.pose.dynamic_objects import Selection, solve_with_static
from trihedron.plugins.pose.judgement import (
    Evidence,
    JudgementOptions,
    is_found_again,
    judge_by_run,
    reason_to_be_lost,
    repeated_images,
    since_loss,
    status_by_images,
    status_by_matches,
    with_disagreement,
    with_missing_points,
)
from trihedron.plugins.pose.map_alignment import MapAlignment
from trihedron.plugins.pose.world_uncertainty import in_world, keyframe_covariance, propagate_world_covariance
from trihedron.plugins.shared.contradiction import with_averages_of
from trihedron.plugins.shared.distance_scale import with_scale_difference
from trihedron.plugins.shared.plane_offsets import with_plane_offsets
from trihedron.plugins.shared.plane_turns import with_turn_difference
from trihedron.plugins.shared.point_depths import with_depth_disagreement
from trihedron.plugins.shared.pose_optimizer import PoseSolution

EYE = np.eye(3)


@register("pose", "refine")
@dataclass(frozen=True)
class Refine(JudgementOptions):
    """Map-to-frame refinement with parallel and perpendicular planes (section IV-C, eq. 8), from the decoupled pose.

    The decoupled rotation is a prior with its own covariance; the decoupled position is a weak prior (`position_sigma_m`), since the same features
    produced it. Without a map the decoupled pose stands. A lost pose is only an initial guess: it is relocalised when enough of the map agrees on a
    pose with all directions observable, else it stays lost; a pose that neither the previous frame nor the map supports is lost. What
    status it has, `judgement.py` decides."""

    position_sigma_m: PositiveFloat = 0.05  # of the decoupled position, a weak prior
    rotation_sigma_deg: PositiveFloat = 0.2  # added to the rotation's own: no scene is exactly Manhattan
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    relation_sigma_deg: PositiveFloat = 0.5  # walls are parallel or perpendicular to within this
    submap_after: NonNegativeInt = 5  # frames with depth without relocalisation, of those that show enough, after which a sub-map begins; 0 = never

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
        evidence = Evidence(problem, solution, static, inliers, rotation, translation, tracks, submap, previous)
        if start.status == LOST and not is_found_again(self, evidence):
            with_depth = len(planes.coefficients) > 0 or bool(np.isfinite(keypoints.points_m[:, 2]).any())
            searched = relocalise is not None and translation.estimated and with_depth
            return self._stay_lost(start, rotation, previous, searched, map, submap)
        if reason := reason_to_be_lost(self, evidence, start.status):
            return self._lost(start, reason, rotation, previous, map, submap)
        if not inliers.total:
            reason = "nothing of the map was found, pose from the previous frame"
            return self._unrefined(start.to_pose(rotation, map, reason, submap), previous)
        repeats = repeated_images(previous, tracks, keypoints, planes, inliers)
        status = status_by_matches(self, evidence)
        shared = keyframe_covariance(solution, problem, self.weak_foundation) if status.status == OK else np.zeros((6, 6))
        status = status_by_images(status, evidence, repeats)
        T, held, counts = solution.T_world_camera, solution.unobservable.shape[1], np.array(inliers.inliers, np.int32)
        reference, T_reference_camera = reference_of(map, T, submap)
        stamps = rotation.index, rotation.stamp_ns
        pose = Pose(
            *stamps, T, solution.covariance, T_reference_camera, reference, counts, held, status.status, status.reason, submap,
            repeats=repeats, keyframe_covariance=shared,
        )  # fmt: skip
        pose = with_motion(pose, previous)
        if pose.jumps and not is_found_again(self, evidence):
            reason = f"the camera jumped, and the map does not determine the pose by itself: only {inliers.total} of {inliers.matches} matches agree"
            return self._lost(start, reason, rotation, previous, map, submap)
        pose = in_world(pose, previous, solution, problem)
        pose = with_disagreement(with_turn_difference(pose, previous, tracks, planes, camera), previous, inliers, static)
        points_known, _, planes_known = problem.terms(T)
        pose = with_scale_difference(pose, previous, points_known.positions_m, keypoints.points_m[matches.keypoints[:, 0]])
        pose = with_depth_disagreement(pose, previous, camera, points_known, solution.points)
        sigmas_m = plane_sigmas_m(pose, problem)
        pose = with_plane_offsets(pose, previous, planes_known.coefficients[: len(matches.planes)], planes, matches.planes, sigmas_m)
        pose = with_missing_points(since_loss(pose, previous), previous, problem)
        return judge_by_run(pose, not inliers.most_planes_disagree)

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

    def _stay_lost(self, start: Decoupled, rotation: Rotation, previous: Pose, searched: bool, map: Map, submap: int) -> Pose:
        """Return a lost pose; or, once relocalisation has failed for `submap_after` frames with depth (`searched`), the first pose of a sub-map,
        exact by definition: what is mapped without depth has no place."""
        unrecognised = previous.unrecognised + int(searched)
        if not self.submap_after or unrecognised < self.submap_after:
            return self._unrefined(replace(start.to_pose(rotation, map, submap=submap), unrecognised=unrecognised), previous)
        number = int(map.keyframes.column("submap").max(initial=0)) + 1
        reason = f"first frame of sub-map {number}: relocalisation failed for {unrecognised} frames"
        new = replace(start, covariance=FIRST_SIGMA**2 * np.eye(6), status=DEGRADED, reason=reason)
        pose = replace(
            new.to_pose(rotation, map, submap=number),
            calibration_information=previous.calibration_information,
            calibration_score=previous.calibration_score,
            usual_accelerations=previous.usual_accelerations,
        )
        return since_loss(pose, previous)

    def _lost(self, start: Decoupled, reason: str, rotation: Rotation, previous: Pose, map: Map, submap: int) -> Pose:
        """Return the pose of a frame that is lost for a reason."""
        return self._unrefined(replace(start, status=LOST, reason=reason).to_pose(rotation, map, submap=submap), previous)

    def _unrefined(self, pose: Pose, previous: Pose) -> Pose:
        """Give a pose that the map did not refine what it takes over from the previous one."""
        return since_loss(propagate_world_covariance(with_averages_of(previous, pose), previous), previous)
