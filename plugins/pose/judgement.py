"""Judgement of a refined pose: ok, degraded or lost, and why.

A pose is not trusted because an optimiser converged. Five tests look for reasons to doubt it; the first that finds one gives the reason of the
status, with its figures:

- **Information**: landmarks of the map determine all six directions, and there are enough of them; where there is hardly a point or line, planes that
  agree do.
- **Agreement**: more matches agree with the pose than would by chance.
- **Contradiction**: what disagrees is not explained by something that moves (`dynamic_objects.py` asks static matches, and planes), of late most
  points agreed, planes lay where the map has them and turned as the camera did, distances were those of the map (`contradiction.py`), and the
  residuals so far do not contradict the camera's calibration (`calibration_uncertainty.py`). A frame that comes after a contradiction, and that the
  map does not support, is lost.
- **Continuity**: the rotation was measured, and the frame continues the previous one, or the map knows its details: of a place that is built alike,
  walls and lines agree, and points do not. A jump from a predicted rotation is verified by the map alone. The place where a camera is found again, or
  where it is after a change of motion that nothing carried makes (`continuity.py`), and which the map alone determines, three frames in a row verify
  with which their planes agree. It keeps finding what was mapped before it was lost; in a room like the one it was taken to be in, it does until it
  leaves.
- **Freshness**: an image that repeats the one before, wholly or for the most part, measures nothing, nor does one whose colour repeats it and whose
  depth does not.

Limits are options of `pose=refine`, or the constants below. `trihedron benchmark honesty` counts the clean frames that each test degrades (false
alarms in docs/explanation/results.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.lie import log_so3
from trihedron.pipeline.core.linalg import matmul, norm, solve
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Share
from trihedron.pipeline.core.types import DEGRADED, F32, F64, I32, LOST, OK, Keypoints, Planes, Pose, Rotation, Tracks, Translation
from trihedron.plugins.mapping.submaps import is_elsewhere
from trihedron.plugins.pose.calibration_uncertainty import contradicted_calibration
from trihedron.plugins.pose.dynamic_objects import MovingOptions, Selection, status_with_static
from trihedron.plugins.pose.map_alignment import InlierStatistics, MapAlignment, TrackingStatus
from trihedron.plugins.shared.contradiction import contradicting_depth, contradiction_so_far, disagreement
from trihedron.plugins.shared.pose_optimizer import PoseSolution
from trihedron.plugins.shared.residuals_kernels import NEAR_M

DETAILED = 100  # key points, or matches, with which a frame is expected to be recognised by them
BY_CHANCE = 0.15  # of DETAILED matches that agree by chance: after a jump at most 0.08, between frames of a walk at least 0.31
MISSING_POINTS = 1000.0  # mapped before the camera was lost, that their missing share is averaged over
SAME_M, SAME_SHARE = 0.05, 0.03  # and share of its depth, from the plane that is observed there, within which a point lies on it
SAME_VIEW, SAME_DISTANCE = np.cos(np.deg2rad(30.0)), 1.5  # between views of a point, and ratio of their distances, that show the same of it
JUMP_SIGMAS2 = 16.3  # Mahalanobis distance² (0.999 quantile of χ² with 3 dof) from a predicted rotation beyond which the camera has jumped
CONFIRMING = 3  # frames in a row, ok and with planes that agree, from the third of which on a camera that was found again is ok
MOST_REPEATED = 0.5  # of the tracked key points: at most 0.012 in eleven clean recordings, 0.7 and more where two fifths of colour are frozen
BLURRED_PX = 1.0  # blur that is worth a word: with more the covariance is half as large again


@dataclass(frozen=True)
class JudgementOptions(MovingOptions):
    """Limits of the tests."""

    min_inliers: NonNegativeInt = 10  # points + 2 lines + 5 planes below which the pose is degraded
    found_inliers: NonNegativeInt = 30  # points + 2 lines + 5 planes that relocalise a lost pose
    found_share: Share = 0.5  # of the matches that must be inliers for that
    min_continued: Share = 0.06  # of the key points with depth, known from the previous frame or the map; two rooms: 0.04, fast walks: at least 0.087
    weak_foundation: PositiveFloat = 3.0  # times the pose's σ beyond which the nearby keyframes' σ is added to it


@dataclass(frozen=True)
class Evidence:
    """Evidence of a frame for and against a solution: its matches with the map (`problem`), the selection of static ones that the pose was estimated
    by (None: all), those that agree with it, the results of the stages before, and the previous pose. `submap` is the part of the map that the frame
    is in."""

    problem: MapAlignment
    solution: PoseSolution
    static: Selection | None
    inliers: InlierStatistics
    rotation: Rotation
    translation: Translation
    tracks: Tracks | None
    submap: int
    previous: Pose


def is_found_again(options: JudgementOptions, evidence: Evidence) -> bool:
    """Return True if the map alone determines the pose of a lost camera, and shows its details."""
    inliers = evidence.inliers
    enough = inliers.score >= options.found_inliers and inliers.total >= options.found_share * inliers.matches
    known = inliers.inliers[0]
    return enough and evidence.solution.unobservable.shape[1] == 0 and not _is_another_place(options, evidence.problem, known)


def reason_to_be_lost(options: JudgementOptions, evidence: Evidence, start_status: str) -> str:
    """Return why a frame is lost although the previous one, or relocalisation, gave it a pose (`start_status`); empty where it is not."""
    inliers, tracked = evidence.inliers, is_tracked(options, evidence.inliers)
    agree = f"only {inliers.total} of {inliers.matches} matches"
    doubt = "" if tracked else _repeating(evidence.previous.repeats)
    if not (tracked and inliers.image_score >= options.min_inliers):  # planes are of the depth that is in doubt
        doubt = doubt or contradicting_depth(evidence.previous)
    if start_status != LOST and doubt:
        return f"{doubt}; and now {agree} with the map agree"
    if evidence.rotation.source == "prediction" and not tracked:
        return f"the rotation was not measured, and {agree} with the map agree"
    if evidence.rotation.source == "prediction" and (jump_deg := _jump_deg(evidence)) and not is_found_again(options, evidence):
        return f"the rotation was not measured, the map turns it by {jump_deg:.0f}°, and does not determine the pose by itself: {agree} agree"
    continued = int(evidence.translation.inliers[0]), inliers.inliers[0]
    if start_status != LOST and _is_another_place(options, evidence.problem, max(continued)):
        known = f"{continued[0]} key points continue the previous frame and {continued[1]} are in the map"
        return f"another place: of {len(evidence.problem.keypoints.pixels)}, {known}"
    if start_status != LOST and inliers.matches >= DETAILED and inliers.total < BY_CHANCE * inliers.matches:
        return f"the frame contradicts the map: {agree} agree"
    if evidence.submap and not tracked:  # nothing ties it to the sub-map: it is searched for in the others
        return f"sub-map {evidence.submap} does not show what the frame does: {agree} agree"
    return ""


def status_by_matches(options: JudgementOptions, evidence: Evidence) -> TrackingStatus:
    """Judge a refined pose by the matches of this frame with the map: whether they are enough, and agree."""
    status = _by_information(options, evidence)
    if evidence.static is None:
        return status
    return status_with_static(status, evidence.solution, evidence.problem, evidence.static, options)


def status_by_images(status: TrackingStatus, evidence: Evidence, repeats: int) -> TrackingStatus:
    """Judge further by the images and the sub-map: the reason names blur; a pose in a sub-map that is not merged is degraded, and so is one of
    `repeats` images in a row, more than one, that repeat the one before, and one of an image that repeats it in colour alone."""
    problem = evidence.problem
    if problem.keypoints.blur_px >= BLURRED_PX:
        status = replace(status, reason=f"{status.reason}; the image is blurred by {problem.keypoints.blur_px:.1f} px: turn slower")
    if evidence.submap:
        reason = f"in sub-map {evidence.submap}, which is not merged with the first yet: {status.reason}"
        status = replace(status, status=DEGRADED, reason=reason)
    if status.status == OK and (reason := _repeating_in_color(evidence.tracks, problem.planes, evidence.inliers) or _repeating(repeats)):
        return replace(status, status=DEGRADED, reason=reason)
    return status


def judge_by_run(pose: Pose, planes_agree: bool) -> Pose:
    """Degrade an ok pose that contradicts the run so far: its matched points have disagreed for ten frames, planes turned otherwise, what was mapped
    before the latest loss or jump is not there, or the residuals contradict the calibration; and one that too few frames since that loss or jump have
    confirmed: frames in a row that are ok, and with which most of their planes agree (`planes_agree`)."""
    tests = contradiction_so_far, _found_elsewhere, contradicted_calibration
    reason = next(filter(None, (test(pose) for test in tests)), "") if pose.status == OK else ""
    pose = replace(pose, status=DEGRADED, reason=reason) if reason else pose
    if not pose.lost_from or pose.confirmations == CONFIRMING:
        return pose
    pose = replace(pose, confirmations=pose.confirmations + 1 if pose.status == OK and planes_agree else 0)
    if pose.status != OK or pose.confirmations == CONFIRMING:
        return pose
    reason = f"found again, which {pose.confirmations} of {CONFIRMING} frames in a row confirm: {pose.reason}"
    return replace(pose, status=DEGRADED, reason=reason)


def with_disagreement(pose: Pose, previous: Pose, inliers: InlierStatistics, static: Selection | None) -> Pose:
    """Give a pose the average of the previous one, updated by the matched points of this frame that disagree. Few leave it as it is, and so does a
    pose by planes alone, for which all points may be what moves."""
    points, matched_points = inliers.inliers[0], inliers.matched[0]
    counted = matched_points >= DETAILED and static is not Selection.PLANES
    average = disagreement(previous, matched_points, points) if counted else previous.disagreement
    return replace(pose, disagreement=average)


def since_loss(pose: Pose, previous: Pose) -> Pose:
    """Give a pose the previous one's `lost_from`, `missing` and `confirmations`; the first lost one, and a jump, begin them anew."""
    if pose.jumps or (pose.status == LOST and previous.status != LOST):
        return replace(pose, lost_from=pose.index)
    if not previous.lost_from:
        return pose
    return replace(pose, lost_from=previous.lost_from, missing=previous.missing, confirmations=previous.confirmations)


def with_missing_points(pose: Pose, previous: Pose, problem: MapAlignment) -> Pose:
    """Give a pose the moving average of the share of points mapped before the latest loss or jump that should be matched and are not: the surface
    that they lie on is observed, from about where they were mapped. It begins anew where the sub-map of the camera was merged or split since the
    previous pose."""
    map, visible = problem.map, problem.matches.visible_points
    if not pose.lost_from or pose.submap != previous.submap:
        return replace(pose, missing=0.0) if pose.missing else pose
    old = visible[map.keyframes.rows("index", map.points.rows("first", visible)) < pose.lost_from]
    expected = old[_is_observed(problem, old, pose.T_world_camera)]
    if not len(expected):
        return pose
    missing = 1.0 - float(np.isin(expected, problem.matches.keypoints[:, 1]).mean())
    return replace(pose, missing=pose.missing + (missing - pose.missing) * len(expected) / (len(expected) + MISSING_POINTS))


def _is_observed(problem: MapAlignment, points: I32, T_world_camera: F64) -> NDArray[np.bool_]:
    """Return (n,) True for points of the map that lie on the plane that is observed there, and that the camera sees as their first keyframe did."""
    map, camera = problem.map, problem.camera
    positions, first = map.points.columns_at(points, "position_m", "first")
    local, first = transform(invert(T_world_camera), positions), map.keyframes.rows("T_world_camera", first)[:, :3, 3]
    rays, before = positions - T_world_camera[:3, 3], positions - first
    distance, distance_before = np.linalg.norm(rays, axis=1), np.linalg.norm(before, axis=1)
    alike = (rays * before).sum(axis=1) > SAME_VIEW * distance * distance_before
    alike &= (distance < SAME_DISTANCE * distance_before) & (distance_before < SAME_DISTANCE * distance)
    seen = np.flatnonzero(alike & (local[:, 2] > NEAR_M))
    depth = local[seen, 2]
    ray = local[seen] / depth[:, None]
    surface = problem.surfaces_at(ray[:, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy])
    apart = np.abs(surface[:, 3] + depth * (surface[:, :3] * ray).sum(axis=1))  # of the point from the plane; NaN without one
    out = np.zeros(len(points), bool)
    out[seen] = apart < np.maximum(SAME_M, SAME_SHARE * depth)
    return out


def repeated_images(previous: Pose, tracks: Tracks | None, keypoints: Keypoints, planes: Planes, inliers: InlierStatistics) -> int:
    """Return how many images in a row repeat the one before: every tracked key point and plane is bit-identical, which two images of a sensor never
    are; or most key points with depth are, and a plane, which is computed from thousands of depths; or colour repeats, and planes disagree."""
    if tracks is None:
        return 0
    before, points, walls = tracks.points_m, keypoints.points_m[tracks.keypoints[:, 1]], planes.coefficients[tracks.planes[:, 1]]
    whole = len(points) + len(walls) and np.array_equal(before, points, True) and np.array_equal(tracks.coefficients, walls, True)
    partly = _has_same_plane(tracks, planes) and _most_alike(before, points)
    return previous.repeats + 1 if whole or partly or _repeating_in_color(tracks, planes, inliers) else 0


def _most_alike(before: F32, now: F32) -> bool:
    """Return whether more than half of the key points (n, 3) that have depth in both images are bit-identical."""
    with_depth = np.isfinite(before[:, 2]) & np.isfinite(now[:, 2])
    return bool(2 * np.count_nonzero((before == now).all(axis=1)) > np.count_nonzero(with_depth))


def _has_same_plane(tracks: Tracks, planes: Planes) -> bool:
    """Return whether a plane is bit-identical to that of the previous image."""
    return bool((tracks.coefficients == planes.coefficients[tracks.planes[:, 1]]).all(axis=1).any())


def _repeating_in_color(tracks: Tracks | None, planes: Planes, inliers: InlierStatistics) -> str:
    """Return why an image whose colour repeats the one before, and whose depth does not, contradicts itself: most planes, which depth alone measures,
    disagree with the pose. Of a camera at rest they agree, and the colour of a compressed video may repeat."""
    if tracks is None or tracks.repeated <= MOST_REPEATED or not inliers.most_planes_disagree or _has_same_plane(tracks, planes):
        return ""
    disagree = f"{inliers.matched[2] - inliers.inliers[2]} of {inliers.matched[2]} planes disagree"
    return f"colour repeats the previous frame, and depth does not: {100.0 * tracks.repeated:.0f} % of the key points are bit-identical, {disagree}"


def _repeating(repeats: int) -> str:
    """Return why so many images in a row that repeat the one before are no measurement; empty for one, which a Kinect repeats now and then."""
    return "the images repeat the previous frame bit for bit, wholly or in part: at rest, or frozen" if repeats > 1 else ""


def _by_information(options: JudgementOptions, evidence: Evidence) -> TrackingStatus:
    """Status by the number and share of the inliers, and by the rotation that they were searched with."""
    solution, inliers = evidence.solution, evidence.inliers
    points, lines, planes = inliers.inliers
    status, reason = OK, f"{points} points, {lines} lines and {planes} planes of the map"
    if solution.unobservable.shape[1]:
        status, reason = DEGRADED, f"{solution.unobservable.shape[1]} directions of motion are unobservable, held at the prediction"
    elif inliers.score < options.min_inliers:
        status, reason = DEGRADED, f"only {points} points, {lines} lines and {planes} planes of the map were found"
    elif inliers.total < options.min_share * inliers.matches:
        status, reason = DEGRADED, f"only {inliers.total} of {inliers.matches} matches with the map agree"
    elif solution.disputed and inliers.image_score < options.min_inliers:
        status, reason = DEGRADED, f"planes alone observe {solution.disputed} directions of motion, and disagree with the map"
    elif evidence.rotation.source == "prediction":
        status, reason = DEGRADED, "the rotation was predicted, not measured, before refinement"
    return TrackingStatus(status, reason)


def is_tracked(options: JudgementOptions, inliers: InlierStatistics) -> bool:
    """Return True if enough of the map agrees with a tracked pose."""
    return inliers.score >= options.min_inliers and inliers.total >= options.min_share * inliers.matches


def _is_another_place(options: JudgementOptions, problem: MapAlignment, continued: int) -> bool:
    """Return True if the frame has details where details are expected, and hardly one of them is known from the previous frame or the map: what its
    planes and lines agree with is then a place built alike."""
    with_depth = int(np.count_nonzero(np.isfinite(problem.keypoints.points_m[:, 2])))
    expected = min(with_depth, len(problem.matches.visible_points))
    return expected >= DETAILED and continued < options.min_continued * with_depth


def _jump_deg(evidence: Evidence) -> float:
    """Return by how much the pose is turned from a predicted rotation where that is more than the prediction allows for; 0 elsewhere."""
    rotation = evidence.rotation
    phi = log_so3(matmul(rotation.R_world_camera.T, evidence.solution.T_world_camera[:3, :3]))
    return float(np.rad2deg(norm(phi))) if matmul(phi, solve(rotation.covariance, phi)) > JUMP_SIGMAS2 else 0.0


def _found_elsewhere(pose: Pose) -> str:
    """Return why the place at which the camera was found again is another one, empty where it shows what was mapped before."""
    if not is_elsewhere(pose):
        return ""
    missing = f"{100.0 * pose.missing:.0f} % of what was mapped before and should be seen is missing"
    return f"the camera was lost or jumped in frame {pose.lost_from}, and found again in a place that looks the same: of late {missing}"
