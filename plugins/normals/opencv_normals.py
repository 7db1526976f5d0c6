"""Normals by OpenCV's methods for organised points, made robust to the noise, holes and edges of depth images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, Range
from trihedron.pipeline.core.types import F32, F64, I32, U8, Camera, Frame, Normals
from trihedron.plugins.normals.opencv_normals_kernels import select_normals, smooth_cells, smooth_points
from trihedron.plugins.normals.patch_size import patch_sides
from trihedron.plugins.shared.depth_image_kernels import cell_inverse_depths, cell_rays
from trihedron.plugins.shared.per_thread import PerThread


@dataclass(frozen=True)
class CloudOptions:
    """Options of the plugins that run a method of OpenCV on smoothed points."""

    stride: Annotated[int, Range(1, 8)] = 2  # px between cells of the output grid
    max_patch_px: Annotated[int, Range(1, 100)] = 30  # side of the largest square points are averaged over, the method's own window included
    noise_deg: PositiveFloat = 1.0  # the square grows with range until the normal's predicted standard deviation is below this
    jump: NonNegativeFloat = 0.04  # a depth edge is a step above jump · z + jump_m
    jump_m: PositiveFloat = 0.02


def cloud_normals(
    options: CloudOptions, normals_of: PerThread[CloudMethod], frame: Frame, method: int, window: int, reach: int, border: int
) -> Normals:  # fmt: skip
    """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells by a method with a window of `window` cells, which needs smooth cells up to
    `reach` cells away and fails within `border` cells of the image's border.

    OpenCV's methods look at 7 × 7 points at most, take a missing point for one at the camera and see no depth edge: on a Kinect's raw points at
    2 m their normals scatter by tens of degrees. So points are averaged first, over what range asks for, and normals near an edge are dropped."""
    camera, stride = frame.camera, options.stride
    rho, _, count = cell_inverse_depths(frame.depth_m, stride, options.jump, options.jump_m, camera.depth_noise.coefficients)
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    rays_x, rays_y = cell_rays(rho.shape[0], rho.shape[1], stride, intrinsics)
    clear = clearance(smooth_cells(rho, count, stride**2, options.jump, options.jump_m))
    radii = _radii(options, camera, window)
    points = smooth_points(rho, clear, radii, rays_x, rays_y)
    fx, fy = camera.fx / stride, camera.fy / stride
    calibration = np.array([[fx, 0.0, -rays_x[0] * fx], [0.0, fy, -rays_y[0] * fy], [0.0, 0.0, 1.0]])  # of the grid's cells
    found = normals_of()(points, calibration, method, window)
    normals = select_normals(found, rho, clear, radii, reach, border, rays_x, rays_y)
    return Normals(index=frame.index, stamp_ns=frame.stamp_ns, normals=normals, stride=stride)


def _radii(options: CloudOptions, camera: Camera, window: int) -> I32:
    """Half-width in cells of the square that is averaged, for depths of 0, 0.1 … 10 m: what the method's own window leaves to do."""
    side = patch_sides(camera, options.noise_deg, 0.0, options.max_patch_px)
    return np.maximum(np.round((side / options.stride - window) / 2.0), 0).astype(np.int32)


class CloudMethod:
    """OpenCV's normals of organised points; its object holds tables for one size and calibration."""

    def __init__(self) -> None:
        self._key: object = None
        self._method: Any = None

    def __call__(self, points: F64, calibration: F64, method: int, window: int) -> F64:
        """(h, w, 4) normals of (h, w, 4) points.

        Double precision: with single, FALS errs by 0.2° (rms) on exact planes with a window of 5 px, as its systems are nearly singular."""
        if min(points.shape[:2]) < window:
            return np.full(points.shape, np.nan)
        key = (points.shape, calibration.tobytes(), method, window)
        if self._key != key:
            height, width = points.shape[:2]
            self._key, self._method = key, cv2.RgbdNormals.create(height, width, cv2.CV_64F, calibration, window, 50.0, method)
        return np.asarray(self._method.apply(points), np.float64)


def clearance(smooth: U8) -> F32:
    """(h, w) chessboard distance to the nearest cell that is not smooth; the image's border is far away."""
    return np.asarray(cv2.distanceTransform(smooth, cv2.DIST_C, 3), np.float32)
