"""Undistortion of images, and registration of the depth of a separate camera to colour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.kernel import constant, kernel
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, U8, Camera

WIDEST = 32  # pixels of colour that one pixel of depth may cover
NEAREST_M = 1e-3
MARGIN_PX = 0.05  # between readings on a slanted surface, parallax opens gaps of some hundredths of a pixel


@dataclass(frozen=True)
class Undistortion:
    """Removes the distortion (coefficients as OpenCV orders them, empty = none) from the images of `camera`.

    Colour is bilinear; depth nearest, since a mean across an edge is a point that does not exist. Outside the image colour repeats the border, which
    makes no edge, and depth is 0."""

    camera: Camera
    distortion: tuple[float, ...]

    @cached_property
    def _maps(self) -> tuple[F32, F32]:
        """(h, w) x and y in the distorted image of each pixel of the undistorted one."""
        size = self.camera.width, self.camera.height
        x, y = cv2.initUndistortRectifyMap(self.camera.K, np.array(self.distortion), np.eye(3), self.camera.K, size, cv2.CV_32FC1)
        return np.asarray(x), np.asarray(y)

    @cached_property
    def _color_maps(self) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """The maps, rounded as by `fixed_point`."""
        return fixed_point(*self._maps)

    def color(self, image: U8) -> U8:
        """(h, w, 3) RGB, undistorted."""
        if not self.distortion:
            return image
        return np.asarray(cv2.remap(image, *self._color_maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)

    def depth(self, depth_m: F32) -> F32:
        """(h, w) metres, undistorted."""
        if not self.distortion:
            return depth_m
        return np.asarray(cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT), np.float32)


def fixed_point(x: F32, y: F32) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Round maps (h, w) of x and y to 1/32 px, as `cv2.remap` takes them: it interpolates colour in two thirds of the time."""
    whole, parts = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return np.asarray(whole, np.int16), np.asarray(parts, np.uint16)


@dataclass(frozen=True)
class DepthCamera:
    """The separate camera of depth images of the size of the colour images: focal lengths and centre (px), and the pose of its frame in that of the
    colour camera, as the position (m) and the rotation vector (degrees) of `T_color_depth`. It has no lens distortion."""

    fx: float
    fy: float
    cx: float
    cy: float
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def K(self) -> F64:
        """Return the (3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def T_color_depth(self) -> F64:
        """Return the (4, 4) pose of the depth camera in the frame of the colour camera."""
        return pose_matrix(exp_so3(np.radians(self.rotation_deg)), np.array(self.translation_m))


@dataclass(frozen=True)
class Rectification:
    """Makes the images of one undistorted camera of those of a colour camera with `distortion` and of its depth sensor.

    A reading z becomes `1 / z' = (1 + depth_radial r²) / z + depth_offset`; r, about the depth camera's centre, is 1 in the corners of the image.
    Depth of a separate `depth_camera` is then registered to colour, else undistorted as colour is."""

    camera: Camera
    distortion: tuple[float, ...] = ()
    depth_offset: float = 0.0
    depth_radial: float = 0.0
    depth_camera: DepthCamera | None = None

    @cached_property
    def _undistortion(self) -> Undistortion:
        return Undistortion(self.camera, self.distortion)

    @cached_property
    def _registration(self) -> Registration | None:
        given, camera = self.depth_camera, self.camera
        return None if given is None else Registration(camera.width, camera.height, given.K, (), given.T_color_depth, camera)

    @cached_property
    def _radial_factor(self) -> F32:
        """(h, w) factor of inverse depth."""
        camera, center = self.camera, self.depth_camera or self.camera
        y, x = np.mgrid[: camera.height, : camera.width].astype(np.float32)
        radius2 = ((x - center.cx) ** 2 + (y - center.cy) ** 2) / ((camera.width**2 + camera.height**2) / 4.0)
        return np.asarray(1.0 + self.depth_radial * radius2, np.float32)

    def color(self, image: U8) -> U8:
        """(h, w, 3) RGB, undistorted."""
        return self._undistortion.color(image)

    def depth(self, depth_m: F32) -> F32:
        """(h, w) metres, 0 = none, corrected and in the pixels of colour."""
        if self.depth_radial:
            depth_m = np.asarray(depth_m / np.maximum(self._radial_factor, np.float32(0.1)), np.float32)
        if self.depth_offset:
            depth_m = np.asarray(depth_m / np.maximum(1.0 + np.float32(self.depth_offset) * depth_m, np.float32(0.1)), np.float32)
        return self._undistortion.depth(depth_m) if self._registration is None else self._registration(depth_m)


@dataclass(frozen=True)
class Registration:
    """Registers depth images of `width` × `height` (intrinsics `K`, distortion `D` as OpenCV orders it) to the undistorted camera `color`.

    Each reading covers the pixels whose centres its own pixel covers, the nearest one on top: no holes where colour is the finer one."""

    width: int
    height: int
    K: F64
    D: tuple[float, ...]
    T_color_depth: F64
    color: Camera

    @cached_property
    def _rays(self) -> tuple[F32, F32]:
        """Directions (x, y, z), rotated into the colour camera, of the middles of the left and right sides of the pixels (h, w + 1, 3) and of the
        upper and lower ones (h + 1, w, 3); pixel centres at integers."""
        columns, rows = np.arange(self.width + 1) - 0.5, np.arange(self.height + 1) - 0.5
        return self._rotated_rays(columns, rows[:-1] + 0.5), self._rotated_rays(columns[:-1] + 0.5, rows)

    def _rotated_rays(self, columns: NDArray[Any], rows: NDArray[Any]) -> F32:
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.K, np.array(self.D) if self.D else None).reshape(pixels.shape)
        with np.errstate(invalid="ignore", over="ignore"):  # where the distortion has no inverse, or the focal length is next to none
            rays = matmul(np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2), self.T_color_depth[:3, :3].T)
            return np.ascontiguousarray(rays, np.float32)

    def __call__(self, depth_m: F32) -> F32:
        """(h, w) metres of the depth camera, 0 = none -> (color.height, color.width) metres z of the colour camera, 0 = none."""
        camera, t = self.color, self.T_color_depth[:3, 3].astype(np.float32)
        return _splat(constant(depth_m, np.float32), *self._rays, t, camera.fx, camera.fy, camera.cx, camera.cy, camera.height, camera.width)


@kernel
def _splat(depth: F32, across: F32, down: F32, t: F32, fx: float, fy: float, cx: float, cy: float, height: int, width: int) -> F32:
    """The z-buffer of all readings, each a rectangle in the colour image between the middles of the sides of its pixel."""
    found = np.zeros((height, width), np.float32)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0.0:
                continue
            Z_left, Z_right = z * across[row, column, 2] + t[2], z * across[row, column + 1, 2] + t[2]
            Z_top, Z_bottom = z * down[row, column, 2] + t[2], z * down[row + 1, column, 2] + t[2]
            if not min(Z_left, Z_right, Z_top, Z_bottom) > NEAREST_M:
                continue
            left, right = fx * (z * across[row, column, 0] + t[0]) / Z_left + cx, fx * (z * across[row, column + 1, 0] + t[0]) / Z_right + cx
            top, bottom = fy * (z * down[row, column, 1] + t[1]) / Z_top + cy, fy * (z * down[row + 1, column, 1] + t[1]) / Z_bottom + cy
            low_x, high_x = min(left, right) - MARGIN_PX, max(left, right) + MARGIN_PX
            low_y, high_y = min(top, bottom) - MARGIN_PX, max(top, bottom) + MARGIN_PX
            inside = high_x > -1.0 and low_x < width and high_y > -1.0 and low_y < height
            if not (inside and high_x - low_x <= WIDEST and high_y - low_y <= WIDEST):
                continue
            Z = np.float32(0.5) * (Z_left + Z_right)
            for v in range(max(0, int(np.ceil(low_y))), min(height, int(np.ceil(high_y)))):
                for u in range(max(0, int(np.ceil(low_x))), min(width, int(np.ceil(high_x)))):
                    if found[v, u] == 0.0 or found[v, u] > Z:
                        found[v, u] = Z
    return found
