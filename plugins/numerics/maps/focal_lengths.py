"""What is said of poses under focal lengths that may be wrong, which squeeze the world: nothing is known as well as it seems then."""

from __future__ import annotations

from dataclasses import dataclass, replace

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import DEGRADED
from trihedron.plugins.numerics.maps.focal_check import focal_check
from trihedron.plugins.numerics.maps.focal_motion import focal_motion
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of
from trihedron.plugins.numerics.maps.map_alignment import MapAlignment, Verdict
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution


@dataclass(frozen=True)
class FocalLengths:
    """How wrong focal lengths may be, by what keyframes say (`focal_check`) and, while these are few, the frame's motion (`focal_motion`)."""

    focal_off: float = 0.1  # share by which the focal lengths are off, beyond which a pose is called degraded, if the map's newest keyframes
    focal_worse: float = 0.2  # fit by this share worse for it
    focal_sure: float = 2.0  # or, while these are few, standard deviations by which the points that move tell so

    def __post_init__(self) -> None:
        if min(self.focal_off, self.focal_worse, self.focal_sure) <= 0.0:
            raise ValueError("focal_off, focal_worse, focal_sure: must be positive")

    def judged_by_focal_lengths(self, found: PoseSolution, problem: MapAlignment, said: Verdict) -> Verdict:
        """What is said of a pose; degraded where the focal lengths are wrong, and less well known while the data do not say yet that they are
        right."""
        map, keypoints, matches = problem.map, problem.keypoints, problem.matches
        if (check := focal_check(map)) is not None and (doubt := check.doubt(self.focal_off, self.focal_worse)):
            first = map.keyframes.rows("T_world_camera", keyframes_of(map, current_submap(map))[:1])[0]
            depths_m = keypoints.points_m[matches.keypoints[:, 0], 2]
            return Verdict(DEGRADED, doubt, said.covariance + check.covariance(invert(first) @ found.T_world_camera, depths_m))
        motion = focal_motion(map, problem.frame, keypoints, matches, found.points, found.T_world_camera)
        if motion is None or motion.verified(self.focal_off, self.focal_sure):
            return said
        doubt = motion.doubt(self.focal_off, self.focal_sure)
        if not doubt and len(map.keyframes) > 1:  # keyframes would hand it on to landmarks, as if it were the error of each
            return said
        covariance = said.covariance + motion.covariance(self.focal_off)
        return Verdict(DEGRADED, doubt, covariance) if doubt else replace(said, covariance=covariance)
