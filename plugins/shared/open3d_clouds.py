"""Frames and grids of cells as Open3D takes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8, Frame
from trihedron.plugins.shared.libraries import open3d


def depth_cells(frame: Frame, stride: int) -> tuple[I32, I32, F64]:
    """Rows and columns (n,) of every `stride`-th pixel that has depth, in cells, and its point (n, 3) in the camera frame."""
    depth = frame.depth_m[::stride, ::stride]
    rows, columns = np.nonzero(depth > 0.0)
    pixels = np.stack([columns * stride, rows * stride], axis=1).astype(np.float64)
    points = frame.camera.back_project(pixels, depth[rows, columns].astype(np.float64))
    return rows.astype(np.int32), columns.astype(np.int32), points


def point_cloud(points_m: F64) -> Any:
    """An Open3D cloud of points (n, 3)."""
    library = open3d()
    return library.geometry.PointCloud(library.utility.Vector3dVector(np.array(points_m, np.float64, order="C")))


def cloud_with_normals(points_m: F64) -> Any:
    """The cloud of points (n, 3) with Open3D's normals (30 nearest neighbours, its default), towards the camera."""
    cloud = point_cloud(points_m)
    cloud.estimate_normals()
    cloud.orient_normals_towards_camera_location()
    return cloud


def rgbd_image(color: U8, depth_m: F32) -> Any:
    """An Open3D image of colour (h, w, 3) and depth in metres (h, w)."""
    geometry = open3d().t.geometry
    return geometry.RGBDImage(geometry.Image(np.ascontiguousarray(color)), geometry.Image(np.ascontiguousarray(depth_m)))
