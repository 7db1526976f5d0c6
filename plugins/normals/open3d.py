"""Normals by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.shared.open3d_clouds import cloud_with_normals, depth_cells

LEAST = 3  # points, of which a normal is made


@register("normals", "open3d")
@dataclass(frozen=True)
class Open3dNormals:
    """`open3d.geometry.PointCloud.estimate_normals` (principal components of the 30 nearest neighbours, its default) of every `stride`-th pixel.

    Neither noise nor depth edges are taken into account. Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), held to one thread. The bytes
    may differ on another CPU."""

    stride: Annotated[int, Range(1, 8)] = 4  # px between cells of the output grid

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN without depth."""
        shape = -(-frame.depth_m.shape[0] // self.stride), -(-frame.depth_m.shape[1] // self.stride)
        normals = np.full((*shape, 3), np.nan, np.float32)
        rows, columns, points = depth_cells(frame, self.stride)
        if len(points) >= LEAST:
            normals[rows, columns] = np.asarray(cloud_with_normals(points).normals)
        return Normals(index=frame.index, stamp_ns=frame.stamp_ns, normals=normals, stride=self.stride)
