"""Keyframes optimised by all that they saw in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Frame, Map
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of
from trihedron.plugins.numerics.places.loop_correction import moved_keyframes
from trihedron.plugins.numerics.places.pose_graph import solve_pose_graph
from trihedron.plugins.numerics.places.shared_edges import shared_edges


@register("loop", "pose_graph")
@dataclass(frozen=True)
class PoseGraph:
    """Every keyframe is tied to every other one that measured some of the same points, by the motion between these measurements, and all poses are
    those that agree best with all edges (RGB-D SLAM: Endres et al., T-RO 2014; Grisetti et al., ITS Magazine 2010). Points follow their keyframes.

    Which points are the same `matches` says, neighbours and loops alike. Landmarks are not adjusted: that is what bundle adjustment does."""

    every: int = 3  # keyframes between two optimisations
    min_points: int = 20  # that two keyframes must share
    gate: float = 3.0  # standard deviations within which a point agrees with an edge
    least_m: float = 1e-4  # motion of a keyframe below which nothing is said

    def __post_init__(self) -> None:
        if self.every < 1 or self.min_points < 3 or self.gate <= 0.0 or self.least_m < 0.0:
            raise ValueError("every, min_points, gate, least_m: at least 1, at least 3, positive, and not negative")

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """The correction of all keyframes; None unless the newest one is due and closes a cycle."""
        newest = len(map.keyframes) - 1
        if newest < 2 or newest % self.every or map.keyframes.row("index", newest) != frame.index:
            return None
        rows = keyframes_of(map, current_submap(map))
        before = map.keyframes.rows("T_world_camera", rows)
        edges, longest = shared_edges(map, rows, before, self.min_points, self.gate)
        if longest < 2:
            return None
        after = solve_pose_graph(before, edges)
        moved = float(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max())
        return moved_keyframes(map, rows, before, after) if moved >= self.least_m else None
