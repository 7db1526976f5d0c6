"""The iso-surface of a volume that fuses the retained views as they come: TSDF integration, and extraction by surface nets."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat
from trihedron.pipeline.core.types import F64, I32, Map, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.tsdf_volume import CELLS, Volume
from trihedron.plugins.surface.common import Gathered, ViewOptions, coloured
from trihedron.plugins.surface.common_iso_surface_kernels import neighbours, signs_kernel, triangles_kernel, untangled, vertices_kernel
from trihedron.plugins.surface.common_meshes import with_single_fans, without_crumbs

AHEAD_M = 2.0  # a pose has moved by as much as the camera and a point this far before it have


@dataclass
class Fused(Gathered):
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


def fuse_view(options: VolumeOptions, state: Fused, view: KeyframeView | None) -> Fused:
    """Fuse a view that was retained, unless it stands in another world as yet."""
    if view is None:
        return state
    if state.volume is None:
        state.volume = Volume(options.voxel_m, options.truncation_m)
    if view.submap == 0:
        state.volume.integrate(*view.fused, view.T_world_camera)
    state.fused.append(view.T_world_camera if view.submap == 0 else None)
    return state


def volume_preview(options: VolumeOptions, state: Fused) -> Surface:
    """The mesh of the views as they were fused, coloured by them, without planes: for viewers."""
    if state.volume is None:
        return Surface.empty(state.index, state.stamp_ns)
    return coloured(state, None, *_volume_mesh(options, state.volume))


def final_mesh(options: VolumeOptions, state: Fused, map: Map | None) -> tuple[F64, I32]:
    """Vertices (v, 3) and triangles (t, 3) of the zero level at the final poses, without small fragments."""
    return _volume_mesh(options, final_volume(options, state, map))


def _volume_mesh(options: VolumeOptions, volume: Volume) -> tuple[F64, I32]:
    vertices, triangles = extract_iso_surface(volume, 1.0 / options.max_error_m**2)
    return with_single_fans(vertices, without_crumbs(vertices, triangles, options.crumb_m2))


def final_volume(options: VolumeOptions, state: Fused, map: Map | None) -> Volume:
    """The volume of all views at their final poses."""
    finals = [view.settled(map) for view in state.views]
    if state.volume is not None and all(_moved_m(fused_at, final) <= options.rebuild_m for fused_at, final in zip(state.fused, finals)):
        return state.volume
    volume = Volume(options.voxel_m, options.truncation_m)
    for view, T in zip(state.views, finals):
        if T is not None:
            volume.integrate(*view.fused, T)
    return volume


def _moved_m(fused_at: F64 | None, final: F64 | None) -> float:
    """Distance that a view has moved; infinite when it was fused and should not be, or the other way round."""
    if fused_at is None or final is None:
        return 0.0 if fused_at is final else float("inf")
    ahead = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, AHEAD_M, 1.0]])
    return float(np.linalg.norm(matmul(ahead, (final - fused_at).T)[:, :3], axis=1).max())


PASSES = 20  # at most, over all voxels, to untangle signs
NEAR = 2.0  # voxels from the surface, within which signs can tangle


def extract_iso_surface(volume: Volume, least_weight: float) -> tuple[F64, I32]:
    """Extract the iso-surface at distance 0 by surface nets: vertices (v, 3) in metres and triangles (t, 3), anticlockwise seen from outside, through
    voxels of at least that weight (1/m²)."""
    n = volume.count
    places, distance, weight = volume.places[:n], volume.distance[:n], volume.weight[:n]
    around = neighbours(volume.keys, volume.numbers, places)
    signs = np.zeros((n, CELLS), np.int8)
    signs_kernel(distance, weight, least_weight, signs)
    distance = distance.copy()
    for _ in range(PASSES):
        if not untangled(distance, signs, around, NEAR * volume.voxel_m):
            break
    cells = np.full((n, CELLS), -1, np.int32)
    vertices = vertices_kernel(places, distance, signs, around, cells, volume.voxel_m)
    return vertices, triangles_kernel(signs, around, cells, vertices)
