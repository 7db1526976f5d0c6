"""The views that a surface retains: those that show something new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.types import F64, LOST, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.shared.keyframe_views import KeyframeView, Known, readings, view_of
from trihedron.plugins.surface.measured_noise import with_measured_noise

NOVELTY_COLUMNS = 80  # of readings that are tested for novelty
CELL_M = 0.1  # of what is remembered to be known


@dataclass
class RetainedViews:
    """The state of a surface: the views kept, what they know of each sub-map's world, and the last frame."""

    views: list[KeyframeView] = field(default_factory=list)
    known: dict[int, Known] = field(default_factory=dict)
    surfels: list[F64] = field(default_factory=list)  # each view's own
    axes: F64 | None = None  # R_world_manhattan
    index: int = 0
    stamp_ns: int = 0

    def views_at_final_poses(self, map: Map | None) -> list[tuple[KeyframeView, F64]]:
        """The views that stand in the first frame's world in the end, with their final poses `T_world_camera`."""
        return [(view, T) for view in self.views if (T := view.final_pose(map)) is not None]

    def up(self, views: Sequence[tuple[KeyframeView, F64]]) -> F64:
        """(3,) the Manhattan axis nearest to the mean of the views' upward directions; NaN without axes or views."""
        if self.axes is None or not views:
            return np.full(3, np.nan)
        upright = -np.mean([T[:3, 1] for _, T in views], axis=0)
        along = matmul(self.axes.T, upright)
        best = int(np.argmax(np.abs(along)))
        return np.asarray(self.axes[:, best] * np.sign(along[best]), np.float64)


@dataclass(frozen=True)
class ViewOptions:
    """Options by which a surface retains views."""

    view_width: Annotated[int, Range(16, 4096)] = 320  # px, about, to which images are reduced
    max_sigma_m: PositiveFloat = 0.05  # depth less certain than this is not used: a Kinect's beyond 4.2 m; a frame's planes say how certain it is
    views: Annotated[float, Range(1)] = 6.0  # of its quality, after which a view has nothing new to tell of a place
    min_novelty: PositiveShare = 0.15  # share of new readings for which a view is kept


def add_view(
    options: ViewOptions, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None
) -> KeyframeView | None:  # fmt: skip
    """Retain the frame in the state and return its view, if it was tracked and shows something new; else return None."""
    state.index, state.stamp_ns = frame.index, frame.stamp_ns
    if rotation is not None and len(rotation.weights):
        state.axes = rotation.R_world_manhattan[int(np.argmax(rotation.weights))]
    if pose.status == LOST:
        return None
    frame = with_measured_noise(frame, planes)
    points, weight = readings(frame, pose.T_world_camera, max(1, frame.camera.width // NOVELTY_COLUMNS), options.max_sigma_m)
    known = state.known.setdefault(pose.submap, Known(CELL_M))
    if not len(points) or known.novelty(points, weight, options.views) < options.min_novelty:
        return None
    known.learn(points, weight)
    view = view_of(frame, planes, pose, map, options.view_width, options.max_sigma_m)
    state.views.append(view)
    return view
