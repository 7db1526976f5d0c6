"""The volume that fuses the retained views as they come, and the mesh of its iso-surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat
from trihedron.pipeline.core.types import F64, I32, Map, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.tsdf_volume import Volume
from trihedron.plugins.surface.colored_mesh import colored_surface
from trihedron.plugins.surface.half_edges import remove_small_components, split_fans
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions
from trihedron.plugins.surface.surface_nets import extract_iso_surface

AHEAD_M = 2.0  # a pose has moved by as much as the camera and a point this far before it have


@dataclass
class FusedViews(RetainedViews):
    """The state of a surface with a volume."""

    fused: list[F64 | None] = field(default_factory=list)  # the pose each view has in the volume
    volume: Volume | None = None


@dataclass(frozen=True)
class VolumeOptions(ViewOptions):
    """Options of a volume that fuses the retained views as they come, and all of them again in the end if the map has moved one since."""

    voxel_m: PositiveFloat = 0.02
    truncation_m: PositiveFloat = 0.06
    max_error_m: PositiveFloat = 0.025  # standard deviation of a voxel's distance above which it is not known
    rebuild_m: PositiveFloat = 0.01  # motion of a view for which the volume is built again
    crumb_m2: NonNegativeFloat = 0.005  # a loose piece of the mesh that is smaller is left out

    def __post_init__(self) -> None:
        if self.truncation_m < 2.0 * self.voxel_m:
            raise ValueError(f"truncation_m: {self.truncation_m} is less than two voxels of {self.voxel_m} m")


def fuse_view(options: VolumeOptions, state: FusedViews, view: KeyframeView | None) -> FusedViews:
    """Fuse a view that was retained, unless it stands in another world as yet."""
    if view is None:
        return state
    if state.volume is None:
        state.volume = Volume(options.voxel_m, options.truncation_m)
    if view.submap == 0:
        state.volume.integrate(*view.tsdf_input, view.T_world_camera)
    state.fused.append(view.T_world_camera if view.submap == 0 else None)
    return state


def volume_preview(options: VolumeOptions, state: FusedViews) -> Surface:
    """The mesh of the views as they were fused, coloured by them, without planes: for viewers."""
    if state.volume is None:
        return Surface.empty(state.index, state.stamp_ns)
    return colored_surface(state, None, *_volume_mesh(options, state.volume))


def final_mesh(options: VolumeOptions, state: FusedViews, map: Map | None) -> tuple[F64, I32]:
    """Vertices (v, 3) and triangles (t, 3) of the zero level at the final poses, without small fragments."""
    return _volume_mesh(options, final_volume(options, state, map))


def _volume_mesh(options: VolumeOptions, volume: Volume) -> tuple[F64, I32]:
    vertices, triangles = extract_iso_surface(volume, 1.0 / options.max_error_m**2)
    return split_fans(vertices, remove_small_components(vertices, triangles, options.crumb_m2))


def final_volume(options: VolumeOptions, state: FusedViews, map: Map | None) -> Volume:
    """The volume of all views at their final poses."""
    finals = [view.final_pose(map) for view in state.views]
    if state.volume is not None and all(_moved_m(fused_at, final) <= options.rebuild_m for fused_at, final in zip(state.fused, finals)):
        return state.volume
    volume = Volume(options.voxel_m, options.truncation_m)
    for view, T in zip(state.views, finals):
        if T is not None:
            volume.integrate(*view.tsdf_input, T)
    return volume


def _moved_m(fused_at: F64 | None, final: F64 | None) -> float:
    """Distance that a view has moved; infinite when it was fused and should not be, or the other way round."""
    if fused_at is None or final is None:
        return 0.0 if fused_at is final else float("inf")
    ahead = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, AHEAD_M, 1.0]])
    return float(np.linalg.norm(matmul(ahead, (final - fused_at).T)[:, :3], axis=1).max())
