"""What all surfaces have in common: the fold that gathers views, and the one that also fuses them as they come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.types import F64, I32, LOST, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.numerics.surfaces.half_edges import with_single_fans, without_crumbs
from trihedron.plugins.numerics.surfaces.measured_noise import with_measured_noise
from trihedron.plugins.numerics.surfaces.surface_nets import zero_level
from trihedron.plugins.numerics.surfaces.views import Known, View, readings, view_of
from trihedron.plugins.numerics.surfaces.volume import Volume

NEWS_COLUMNS = 80  # of readings that are asked for news
AHEAD_M = 2.0  # a pose has moved by as much as the camera and a point this far before it have
CELL_M = 0.1  # of what is remembered to be known


@dataclass
class Gathered:
    """The state of a surface: the views kept, what they know of each sub-map's world, and the last frame."""

    views: list[View] = field(default_factory=list)
    known: dict[int, Known] = field(default_factory=dict)
    fused: list[F64 | None] = field(default_factory=list)  # the pose each view has in the volume
    volume: Volume | None = None
    surfels: list[F64] = field(default_factory=list)  # each view's own
    axes: F64 | None = None  # R_world_manhattan
    index: int = 0
    stamp_ns: int = 0

    def settled(self, map: Map | None) -> list[tuple[View, F64]]:
        """The views that stand in the first frame's world in the end, with their final poses `T_world_camera`."""
        return [(view, T) for view in self.views if (T := view.settled(map)) is not None]

    def up(self, views: Sequence[tuple[View, F64]]) -> F64:
        """(3,) the Manhattan axis nearest to the mean of the views' upward directions; NaN without axes or views."""
        if self.axes is None or not views:
            return np.full(3, np.nan)
        upright = -np.mean([T[:3, 1] for _, T in views], axis=0)
        along = self.axes.T @ upright
        best = int(np.argmax(np.abs(along)))
        return np.asarray(self.axes[:, best] * np.sign(along[best]), np.float64)


@dataclass(frozen=True)
class ViewFold:
    """Keeps the views that tell something new, at their final poses in the end."""

    view_width: int = 320  # px, about, to which images are reduced
    max_sigma_m: float = 0.05  # depth less certain than this is not used: a Kinect's beyond 4.2 m; a frame's planes say how certain it is
    views: float = 6.0  # of its quality, after which a view has nothing new to tell of a place
    news: float = 0.15  # share of new readings for which a view is kept

    def __post_init__(self) -> None:
        if not 16 <= self.view_width <= 4096:
            raise ValueError("view_width: must be 16 to 4096 px")
        if self.max_sigma_m <= 0.0 or self.views < 1.0 or not 0.0 < self.news <= 1.0:
            raise ValueError("max_sigma_m, views, news: must be positive, at least 1, and a share in (0, 1]")

    def start(self) -> Gathered:
        """Nothing seen."""
        return Gathered()

    def add(self, state: Gathered, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> Gathered:
        """Keep the frame if it was tracked and tells something new."""
        state.index, state.stamp_ns = frame.index, frame.stamp_ns
        if rotation is not None and len(rotation.weights):
            state.axes = rotation.R_world_manhattan[int(np.argmax(rotation.weights))]
        if pose.status == LOST:
            return state
        frame = with_measured_noise(frame, planes)
        points, weight = readings(frame, pose.T_world_camera, max(1, frame.camera.width // NEWS_COLUMNS), self.max_sigma_m)
        known = state.known.setdefault(pose.submap, Known(CELL_M))
        if len(points) and known.news(points, weight, self.views) >= self.news:
            known.learn(points, weight)
            view = view_of(frame, planes, pose, map, self.view_width, self.max_sigma_m)
            state.views.append(view)
            self._kept(state, view)
        return state

    def _kept(self, state: Gathered, view: View) -> None:
        """What else is done with a view that was kept."""


@dataclass(frozen=True)
class VolumeFold(ViewFold):
    """Fuses the views it keeps as they come, and all of them again in the end if the map has moved one since."""

    voxel_m: float = 0.02
    truncation_m: float = 0.06
    max_error_m: float = 0.025  # standard deviation of a voxel's distance above which it is not known
    rebuild_m: float = 0.01  # motion of a view for which the volume is built again
    crumb_m2: float = 0.005  # a loose piece of the mesh that is smaller is left out

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.voxel_m <= 0.0 or self.truncation_m < 2.0 * self.voxel_m:
            raise ValueError("voxel_m, truncation_m: must be positive, and at least two voxels")
        if self.max_error_m <= 0.0 or self.rebuild_m <= 0.0 or self.crumb_m2 < 0.0:
            raise ValueError("max_error_m, rebuild_m, crumb_m2: must be positive, and not negative")

    def _kept(self, state: Gathered, view: View) -> None:
        """Fuse it, unless it stands in another world as yet."""
        if state.volume is None:
            state.volume = Volume(self.voxel_m, self.truncation_m)
        if view.submap == 0:
            state.volume.integrate(view, view.T_world_camera)
        state.fused.append(view.T_world_camera if view.submap == 0 else None)

    def _volume(self, state: Gathered, map: Map | None) -> Volume:
        """The volume of all views at their final poses."""
        finals = [view.settled(map) for view in state.views]
        if state.volume is not None and all(_moved_m(said, final) <= self.rebuild_m for said, final in zip(state.fused, finals)):
            return state.volume
        volume = Volume(self.voxel_m, self.truncation_m)
        for view, T in zip(state.views, finals):
            if T is not None:
                volume.integrate(view, T)
        return volume

    def _mesh(self, state: Gathered, map: Map | None) -> tuple[F64, I32]:
        """Vertices (v, 3) and triangles (t, 3) of the zero level at the final poses, without crumbs."""
        vertices, triangles = zero_level(self._volume(state, map), 1.0 / self.max_error_m**2)
        return with_single_fans(vertices, without_crumbs(vertices, triangles, self.crumb_m2))


def _moved_m(said: F64 | None, final: F64 | None) -> float:
    """How far a view has moved; infinite when it was fused and should not be, or the other way round."""
    if said is None or final is None:
        return 0.0 if said is final else float("inf")
    ahead = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, AHEAD_M, 1.0]])
    return float(np.linalg.norm((ahead @ (final - said).T)[:, :3], axis=1).max())
