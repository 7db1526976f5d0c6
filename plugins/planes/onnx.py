"""Learned planar regions by a network in an ONNX file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from trihedron.pipeline.core.linalg import eigvalsh, matmul, solve
from trihedron.pipeline.core.options import PositiveInt, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, I32, Frame, Normals, Planes
from trihedron.plugins.planes.grid_points import grid_points
from trihedron.plugins.planes.regions import RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_labelled
from trihedron.plugins.shared.depth_image_kernels import Grid
from trihedron.plugins.shared.networks import NetworkImage, NetworkOptions, network_image

LEAST = 3  # cells, of which a plane is made
COLLINEAR = 1e-12  # ratio of the least and the largest moment of points, below which they determine no plane


@register("planes", "onnx")
@dataclass(frozen=True)
class OnnxPlanes(NetworkOptions, RegionOptions):
    """Instance masks of a network that the user gives (PlaneRCNN: Liu et al., CVPR 2019; PlaneRecNet, BMVC 2021): RGB `image` (1, 3, h, w)
    in 0 … 1 to `masks` (1, n, h', w') in 0 … 1 and `scores` (1, n). A pixel belongs to the mask with the largest score × value.

    Each region's plane is then fitted to the depth, grown and reported as that of every detector, so that the covariance is comparable. Library: ONNX
    Runtime (MIT), one thread. The bytes may differ on another CPU."""

    slot: ClassVar[str] = "planes"
    multiple: PositiveInt = 32  # of which the image's sides are one
    min_score: Share = 0.3
    min_mask: Share = 0.5  # of a pixel that belongs to a mask

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals."""
        network, grid = self.network, grid_of(frame, normals)
        image = network_image(frame, network, "image", 3, self.multiple)
        outputs = network.run({"image": image.tensor}, ("masks", "scores"))
        masks = network.rows("masks", outputs[0], None, None, None)
        scores = network.rows("scores", outputs[1], len(masks))
        labels = self._labels(masks, scores, image, grid, normals.stride)
        labels, q = _initial_planes(labels, grid)
        core, fitted = fit_labelled(grid, labels, q, float(np.radians(self.cone_deg)), self.gate, least_cells(self, normals.stride))
        return complete_planes(self, core, fitted, grid, frame, normals.stride, flat=False)

    def _labels(self, masks: F32, scores: F32, image: NetworkImage, grid: Grid, stride: int) -> I32:
        """Label (h, w) of each cell with depth: 1 + its mask, 0 = none."""
        height, width = grid.rho.shape
        rows, columns = np.indices((height, width), np.float32)
        own = image.own(np.stack([columns * stride, rows * stride], axis=-1)).astype(np.float32)
        best, labels = np.zeros((height, width), np.float32), np.zeros((height, width), np.int32)
        for k in np.flatnonzero(scores >= self.min_score):
            sides = np.array(masks[k].shape[::-1]) / image.tensor.shape[:1:-1]
            at = ((own + 0.5) * sides - 0.5).astype(np.float32)
            value = cv2.remap(masks[k], at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
            wins = (value >= self.min_mask) & (value * scores[k] > best) & (grid.rho > 0.0)
            labels[wins], best[wins] = k + 1, (value * scores[k])[wins]
        return labels


def _initial_planes(labels: I32, grid: Grid) -> tuple[I32, F64]:
    """Labels 1 … k of the regions that a plane can be fitted to, and q (k, 3) of each by least squares, with `q · (x, y, z) = 1`."""
    rows, columns, points = grid_points(grid)
    numbers, out, planes = labels[rows, columns], np.zeros_like(labels), []
    for number in np.unique(numbers[numbers > 0]):
        mine = numbers == number
        if mine.sum() < LEAST:
            continue
        moments = matmul(points[mine].T, points[mine])
        values = eigvalsh(moments)
        if values[0] > COLLINEAR * values[-1]:
            planes.append(solve(moments, points[mine].sum(axis=0)))
            out[rows[mine], columns[mine]] = len(planes)
    return out, np.array(planes, np.float64).reshape(-1, 3)
