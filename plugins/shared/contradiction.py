"""Contradictions between colour, depth and the map that last for several frames: such a pose is not ok, and is not mapped.

Each is a share, a ratio or a rotation averaged over the latest frames: matched points that disagree with their pose; matched planes that do, beyond
what is usual in this run (with an imperfect calibration most may); planes that turn otherwise than the camera (`plane_turns.py`); and distances
between points that are not those of the map (`distance_scale.py`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import F64, Pose
from trihedron.plugins.shared.distance_scale import contradicting_scale
from trihedron.plugins.shared.plane_turns import contradicting_turn

AVERAGED_FRAMES = 10  # that the disagreement of points is averaged over
MOST_DISAGREEMENT = 0.5  # of points: more is no moment of blur and nobody who walks by; at most 0.35 of five cameras as they are stated
AVERAGED_PLANES = np.array([[60.0], [600.0]])  # that their disagreement of late, and the usual one, are averaged over
LEAST_PLANES = 8  # of a frame that are counted: of fewer, two that are matched wrongly from frame to frame are most
UNUSUAL = 0.2  # that a plane counts in what is usual while they disagree
MOST_DISAGREEING_PLANES = 0.4  # beyond the usual share; at most 0.34 of 75 simulated sensors and five sequences, 0.6 and more where colour froze


def contradiction_so_far(pose: Pose) -> str:
    """Return why the images up to a pose contradict each other or the map, empty where they do not."""
    return _disagreeing_points(pose) or contradicting_depth(pose)


def contradicting_depth(pose: Pose) -> str:
    """Return why depth contradicts colour or the map up to a pose, empty where it does not. Where most points disagree, something may move over half
    the image; planes are large and seldom move, and what moves keeps its size."""
    return _disagreeing_planes(pose) or contradicting_turn(pose) or contradicting_scale(pose)


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
        scale_difference=previous.scale_difference,
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
