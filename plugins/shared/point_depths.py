"""Contradiction between colour and depth: a point that the image shows where the map has it must be as far away, too.

Where colour is frozen with noise, or late, points agree with each other on where the camera is by their pixels, and depth is that of another view.
Most of what moves, or is matched wrongly, lies elsewhere in the image, too. An imperfect calibration takes some depths beyond their noise
in every frame, and a run shows how many that usually are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import U8, Camera, Pose
from trihedron.plugins.shared.pose_optimizer import classify_terms
from trihedron.plugins.shared.residuals_kernels import PointTerms

FEWEST = 50  # points, of which the share is known to 0.07
LATE, USUAL = 3, 30  # frames that the share of late, and the usual one, are averaged over
LEAST = 0.08  # that is usual at least: chance takes 0.02 beyond the gate
MOST = 3.0  # times the usual share, beyond which that of late is a contradiction; six sequences come to 2.3
LEARNED = 2.0  # times the usual share that a frame counts at most in it: a fault of some frames does not become usual


def with_depth_disagreement(pose: Pose, previous: Pose, camera: Camera, points: PointTerms, agreeing: U8) -> Pose:
    """Give a refined pose the moving averages of the share of points that disagree in depth alone, of those (n,) `points` that its image shows where
    the map has them; 0 in `agreeing` (n,) are those that disagree in any way. In that of late, a frame where most of these lie elsewhere in the
    image, too, counts as none: something moves. The previous one's where there are few."""
    late, usual = previous.depth_disagreement, previous.usual_depth_disagreement
    pixels = classify_terms(pose.T_world_camera, camera, points._replace(depth_m=np.full(len(points.depth_m), np.nan))).points
    measured, disagreeing = np.isfinite(points.depth_m), agreeing == 0
    shown = measured & (pixels > 0)
    count = np.count_nonzero(shown)
    if count >= FEWEST:
        alone = np.count_nonzero(shown & disagreeing)
        share = alone / count
        counted = share if 2 * alone > np.count_nonzero(measured & disagreeing) else 0.0
        late = late + (counted - late) / LATE if usual else counted
        usual = usual + (min(share, LEARNED * max(usual, LEAST)) - usual) / USUAL if usual else share
    return replace(pose, depth_disagreement=float(late), usual_depth_disagreement=float(usual))


def contradicting_point_depths(pose: Pose) -> str:
    """Return why the depths of points contradict their pixels, empty where no more do than usual."""
    late, usual = 100.0 * pose.depth_disagreement, 100.0 * pose.usual_depth_disagreement
    if late <= MOST * max(usual, 100.0 * LEAST):
        return ""
    where = "lie where the image shows them, but elsewhere in depth"
    return f"colour and depth contradict each other: of late {late:.0f} % of the points {where}, usually {usual:.0f} %"
