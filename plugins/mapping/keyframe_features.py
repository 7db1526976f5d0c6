"""What a keyframe saw, as the map knows it by now: its landmarks in its camera, as the features of a frame."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform, transform_planes
from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Map, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import LocalWindow
from trihedron.plugins.mapping.visibility import clip_segments
from trihedron.plugins.shared.linalg import inverse, rotate_covariance, transform_plane_covariance

L2_BYTES = 128  # descriptors this long are histograms (SIFT), compared by Euclidean distance; all others are bits
PLANE_PX = 1000  # a region's size where none is known any more: only the order of a frame's own regions hangs on it


def features_of(map: Map, camera: Camera, T_world_camera: F64, seen: LocalWindow) -> tuple[Keypoints, Segments, Planes]:
    """The landmarks `seen` in a camera at `T_world_camera`, with the map's covariances as those of the features."""
    T = invert(T_world_camera)
    return _points(map, camera, T, seen.points), _lines(map, camera, T, seen.lines), _planes(map, T, seen.planes)


def measured_points(map: Map, keyframe: int) -> tuple[I32, F64, F64, F64]:
    """Ids (n,) of the points a keyframe measured with depth, sorted, their places (n, 3) in its axes by its own measurements, and σ of their depths
    (m) and pixels."""
    first, end = map.keyframes.row("points", keyframe)
    fx, fy, cx, cy = map.keyframes.row("intrinsics", keyframe)
    names = ("point", "pixel", "depth_m", "sigma_m", "sigma_px")
    ids, pixel, depth, sigma_m, sigma_px = map.point_observations.gathered(np.arange(first, end), *names)
    pixel, depth = pixel.astype(np.float64), depth.astype(np.float64)
    places = np.stack([(pixel[:, 0] - cx) / fx * depth, (pixel[:, 1] - cy) / fy * depth, depth], axis=1)
    known = np.flatnonzero(np.isfinite(depth))
    known = known[np.unique(ids[known], return_index=True)[1]]
    return ids[known], places[known], sigma_m[known].astype(np.float64), sigma_px[known].astype(np.float64)


def _points(map: Map, camera: Camera, T_camera_world: F64, ids: I32) -> Keypoints:
    local = transform(T_camera_world, map.points.rows("position_m", ids))
    front = local[:, 2] > 0.1
    ids, local = ids[front], local[front]
    covariance = rotate_covariance(T_camera_world[:3, :3], inverse(map.points.rows("information", ids)))
    across = np.sqrt(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    descriptors = map.points.rows("descriptor", ids)
    return Keypoints(
        map.index,
        map.stamp_ns,
        camera.project(local).astype(np.float32),
        local.astype(np.float32),
        np.maximum(camera.fx * across / local[:, 2], 0.3).astype(np.float32),
        np.sqrt(covariance[:, 2, 2]).astype(np.float32),
        map.points.rows("octave", ids),
        np.zeros(len(ids), np.float32),
        descriptors,
        "l2" if descriptors.shape[1] == L2_BYTES else "hamming",
    )


def _lines(map: Map, camera: Camera, T_camera_world: F64, ids: I32) -> Segments:
    world = map.lines.rows("endpoints_m", ids)
    pixels, inside = clip_segments(world, T_camera_world, camera)
    ids, local, pixels = ids[inside], transform(T_camera_world, world[inside]), pixels[inside]
    covariance = rotate_covariance(T_camera_world[:3, :3], inverse(map.lines.rows("information", ids)))
    descriptors = map.lines.rows("descriptor", ids)
    return Segments(map.index, map.stamp_ns, pixels.astype(np.float32), local.astype(np.float32), covariance.astype(np.float32), descriptors)


def _planes(map: Map, T_camera_world: F64, ids: I32) -> Planes:
    world = map.planes.rows("coefficients", ids)
    local = transform_planes(T_camera_world, world)
    away = local[:, 3] >= 0.0  # the camera has gone round it otherwise
    ids, world, local = ids[away], world[away], local[away]
    covariance = transform_plane_covariance(T_camera_world, world, local, map.planes.rows("covariance", ids))
    moments = T_camera_world @ map.planes.rows("moments", ids) @ T_camera_world.T
    samples = transform(T_camera_world, map.planes.rows("samples_m", ids)).astype(np.float32)
    pixels = np.full(len(ids), PLANE_PX, np.int32)
    return Planes(map.index, map.stamp_ns, local, covariance, moments, pixels, samples, np.zeros((1, 1), np.uint8), 1)
