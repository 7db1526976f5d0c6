"""Contradictions between colour, depth and the map that last for several frames: such a pose is not ok, and is not mapped.

Each is a share, a ratio or a rotation averaged over the latest frames: matched points that disagree with their pose; planes that lie elsewhere than
in the map (`plane_offsets.py`); points that disagree in depth alone (`point_depths.py`); planes that turn otherwise than the camera
(`plane_turns.py`); and distances between points that are not those of the map (`distance_scale.py`)."""

from __future__ import annotations

from dataclasses import replace

from trihedron.pipeline.core.types import Pose
from trihedron.plugins.shared.distance_scale import contradicting_scale
from trihedron.plugins.shared.plane_offsets import contradicting_offsets
from trihedron.plugins.shared.plane_turns import contradicting_turn
from trihedron.plugins.shared.point_depths import contradicting_point_depths

AVERAGED_FRAMES = 10  # that the disagreement of points is averaged over
AGREEING_POINTS = 100  # in a frame, that outweigh its planes
FEW_DISAGREE = 0.25  # share of the matched points of late up to which they do: 0.1 where a map is inexact; where colour froze it comes to 0.45 to 0.6
MOST_DISAGREEMENT = 0.5  # of points: more is no moment of blur and nobody who walks by; at most 0.35 of five cameras as they are stated


def contradiction_so_far(pose: Pose) -> str:
    """Return why the images up to a pose contradict each other or the map, empty where they do not."""
    return _disagreeing_points(pose) or contradicting_depth(pose)


def contradicting_depth(pose: Pose) -> str:
    """Return why depth contradicts colour or the map up to a pose, empty where it does not. Where most points disagree, something may move over half
    the image; planes are large and seldom move, and what moves keeps its size. Planes that are off while points, which have depth, too, are where the
    map has them, contradict those as well: the map is inexact there."""
    outweighed = pose.inliers[0] >= AGREEING_POINTS and pose.disagreement <= FEW_DISAGREE
    tests = contradicting_point_depths, contradicting_turn, contradicting_scale
    return next(filter(None, (test(pose) for test in (tests if outweighed else (contradicting_offsets, *tests)))), "")


def disagreement(previous: Pose, matched: int, agreed: int) -> float:
    """Return the moving average of the share of matched points that do not agree with the pose. The first frame with any begins it (an average that
    begins at zero takes a contradiction from the first frame on for agreement)."""
    share = 1.0 - agreed / matched
    return previous.disagreement + (share - previous.disagreement) / AVERAGED_FRAMES if previous.disagreement else share


def with_averages_of(previous: Pose, pose: Pose) -> Pose:
    """Give a pose that the map did not refine, and that measured nothing to average, what the previous one shows of the run so far. Only the mean of
    how planes turn otherwise begins anew."""
    return replace(
        pose,
        disagreement=previous.disagreement,
        depth_disagreement=previous.depth_disagreement,
        usual_depth_disagreement=previous.usual_depth_disagreement,
        plane_offsets=previous.plane_offsets,
        usual_turn_difference=previous.usual_turn_difference,
        usual_accelerations=previous.usual_accelerations,
        scale_difference=previous.scale_difference,
    )


def _disagreeing_points(pose: Pose) -> str:
    """Return why matched points have contradicted the map for a while, empty where most of them agree."""
    if pose.disagreement <= MOST_DISAGREEMENT:
        return ""
    return f"most points contradict the map: of late {100.0 * pose.disagreement:.0f} % of the matched ones disagree"
