"""Surfels to track against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.options import AcuteDeg, PositiveFloat, PositiveInt, Range, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import LOST, Bool, Column, Frame, Pose, PredictedView, Table
from trihedron.plugins.model.downsampled_frame import PosedCamera, downsample
from trihedron.plugins.model.surfels_kernels import Images, fuse, index_map, splat
from trihedron.plugins.shared.image_reduction_kernels import depth_normals, smooth_depth


@register("model", "surfels")
@dataclass(frozen=True)
class SurfelModel:
    """A coloured disc per newly observed pixel, fused where it is observed again, and the view predicted by splatting from this frame's pose
    (ElasticFusion: Whelan et al., RSS 2015; Keller et al., 3DV 2013; the paper's "ElasticFu").

    Without the publication's deformation graph and its loops. The surfels are the rows of the value's table, so that
    the wire `model@prev` is the only memory."""

    width: Annotated[int, Range(32, 4096)] = 213  # px, about, of the fused depth and of the view
    apart: PositiveFloat = 3.0  # standard deviations of a depth, between a pixel and its surfel
    most_deg: AcuteDeg = 40.0  # between their normals
    most: Annotated[float, Range(1)] = 100.0  # views, the limit of a surfel's confidence
    stable: Annotated[float, Range(1)] = 5.0  # views from which on a surfel is stable
    trial: PositiveInt = 20  # frames out of view after which one that is not stable is removed

    def __post_init__(self) -> None:
        check_increasing(self, "stable", "most")

    def __call__(self, frame: Frame, pose: Pose, previous: PredictedView | None) -> PredictedView | None:
        """Return the view from this frame's pose; None, so that the last one remains, while the camera is lost."""
        if pose.status == LOST:
            return None
        depth, color, intrinsics, camera = downsample(frame, pose, self.width)
        smooth = smooth_depth(depth, 2)
        images = Images(depth, depth_normals(smooth, intrinsics, 2), color, frame.camera.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01)))
        table = previous.model if previous is not None else Table.empty(SURFELS)
        table = fuse_frame(self, table, images, camera, frame.index)
        T = np.array(pose.T_world_camera)
        depth, normals, mean = splat(table.column("surfel"), camera, depth.shape, self.stable)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), np.float32(1e-6))
        return PredictedView(frame.index, frame.stamp_ns, T, depth, normals, np.rint(mean).astype(np.uint8), table)


# Point-based fusion (Keller et al., 3DV 2013) as in ElasticFusion (Whelan et al., RSS 2015). A row whose confidence is 0 is free, and is
# reused for the next surfel. Versions of the table share the chunks that a frame does not touch.

SURFELS = {
    "surfel": Column("f4", (11,)),  # position, unit normal, RGB, radius (m), confidence
    "seen": Column("i4"),  # the last frame it was measured in
}


def fuse_frame(options: SurfelModel, table: Table, images: Images, camera: PosedCamera, index: int) -> Table:
    """Fuse a frame into the table. A pixel is fused with the surfel nearest to its ray within `apart` standard deviations and `most_deg` of its
    normal, else it becomes one. Confidence is the number of views, up to `most`; a surfel that is not `stable` after `trial` frames out of view is
    removed."""
    cosine = float(np.cos(np.radians(options.most_deg)))
    surfels, seen = table.column("surfel"), table.column("seen")
    pixels = index_map(surfels, camera, images.depth_m.shape)
    changed, fresh = fuse(surfels, seen, pixels, images, camera, index, options.apart, cosine, options.most)
    removed = (surfels[:, 10] > 0.0) & (surfels[:, 10] < options.stable) & (index - seen > options.trial)
    surfels[removed, 10] = 0.0
    free = np.flatnonzero(surfels[:, 10] == 0.0)[: len(fresh)]
    surfels[free], seen[free] = fresh[: len(free)], index
    rows = np.flatnonzero(changed | removed | _at(free, len(surfels))).astype(np.int32)
    table = table.updated(rows, surfel=surfels[rows], seen=seen[rows]) if len(rows) else table
    left = fresh[len(free) :]
    return table.appended(surfel=left, seen=np.full(len(left), index, np.int32))[0]


def _at(rows: NDArray[np.signedinteger], count: int) -> Bool:
    """Mask (count,) of rows."""
    out = np.zeros(count, bool)
    out[rows] = True
    return out
