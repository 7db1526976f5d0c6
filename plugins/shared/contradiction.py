"""Contradictions between colour, depth and the map. A frame of whose points and planes most disagree is not mapped, and the map goes on to contradict
those that follow; a pose of a contradiction that lasts for several frames is not ok, and not mapped either where planes take part in it.

Each of the latter is a share or a rotation averaged over the latest frames: matched points that disagree with their pose; matched planes that do,
beyond what is usual in this run (with an imperfect calibration most may); and planes that turn otherwise than the camera (`plane_turns.py`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import DEGRADED, F64, Matches, Pose
from trihedron.plugins.shared.plane_turns import contradicting_turn

AVERAGED_FRAMES = 10  # that the disagreement of points is averaged over
MOST_DISAGREEMENT = 0.5  # of points: more is no moment of blur and nobody who walks by; at most 0.35 of five cameras as they are stated
LEAST_AGREEING = 0.25  # of the matches of a frame that is mapped: landmarks made from another one would agree with the next frame, right or wrong
AVERAGED_PLANES = np.array([[60.0], [600.0]])  # that their disagreement of late, and the usual one, are averaged over
LEAST_PLANES = 8  # of a frame that are counted: of fewer, two that are matched wrongly from frame to frame are most
UNUSUAL = 0.2  # that a plane counts in what is usual while they disagree
MOST_DISAGREEING_PLANES = 0.4  # beyond the usual share; at most 0.34 of 75 simulated sensors and five sequences, 0.6 and more where colour froze


def contradiction_so_far(pose: Pose) -> str:
    """Return why the images up to a pose contradict each other or the map, empty where they do not."""
    return _disagreeing_points(pose) or contradicting_depth(pose)


def contradicts_map(pose: Pose, matches: Matches) -> bool:
    """Return True where a frame contradicts the map in its planes, of which no majority agrees with the pose, and in three quarters of all matches,
    or in most points of late. Where planes agree, points may be those of what moves, which is seldom flat and large. Not where no match agrees, as of
    a pose without the map."""
    points, lines, planes = len(matches.keypoints), len(matches.segments), len(matches.planes)
    agreeing, agreeing_planes = int(pose.inliers.sum()), int(pose.inliers[2])
    if pose.status != DEGRADED or not planes or 2 * agreeing_planes > planes:
        return False
    return bool(_disagreeing_points(pose)) or 0 < agreeing < LEAST_AGREEING * (points + lines + planes)


def contradicting_depth(pose: Pose) -> str:
    """Return why depth contradicts colour up to a pose, empty where it does not. Where most points disagree, something may move over half the image;
    planes are large and seldom move."""
    return _disagreeing_planes(pose) or contradicting_turn(pose)


def disagreement(previous: Pose, matched: int, agreed: int) -> float:
    """Return the moving average of the share of matched points that do not agree with the pose. The first frame with any begins it (an average that
    begins at zero takes a contradiction from the first frame on for agreement)."""
    share = 1.0 - agreed / matched
    return previous.disagreement + (share - previous.disagreement) / AVERAGED_FRAMES if previous.disagreement else share


def plane_counts(previous: Pose, matched: int, agreed: int) -> F64:
    """Return `Pose.plane_counts` with the planes of a frame, of which `agreed` agree with the pose; a frame with few planes leaves them as they are.
    While they contradict it, what is usual changes slowly: a fault of some seconds does not become usual, and a change for good does."""
    if matched < LEAST_PLANES:
        return previous.plane_counts
    counted = matched * np.array([[1.0], [UNUSUAL if _disagreeing_planes(previous) else 1.0]])
    kept = AVERAGED_PLANES / (AVERAGED_PLANES + counted)
    return np.asarray(kept * previous.plane_counts + counted * [1.0 - agreed / matched, 1.0], np.float64)


def with_averages_of(previous: Pose, pose: Pose) -> Pose:
    """Give a pose that the map did not refine, and that measured nothing to average, what the previous one shows of the run so far. Only the mean of
    how planes turn otherwise begins anew."""
    return replace(
        pose,
        disagreement=previous.disagreement,
        plane_counts=previous.plane_counts,
        usual_turn_difference=previous.usual_turn_difference,
        usual_accelerations=previous.usual_accelerations,
    )


def _disagreeing_points(pose: Pose) -> str:
    """Return why matched points have contradicted the map for a while, empty where most of them agree."""
    if pose.disagreement <= MOST_DISAGREEMENT:
        return ""
    return f"colour, depth and map contradict each other: of late {100.0 * pose.disagreement:.0f} % of the matched points disagree"


def _disagreeing_planes(pose: Pose) -> str:
    """Return why planes, which depth alone measures, have contradicted the pose for a while, empty where as many agree as usual."""
    late, usual = (disagreeing / max(matched, 1.0) for disagreeing, matched in pose.plane_counts.tolist())
    if late - usual <= MOST_DISAGREEING_PLANES:
        return ""
    return (
        f"colour and depth contradict each other: of late {100.0 * late:.0f} % of the planes disagree with the points, usually {100.0 * usual:.0f} %"
    )
