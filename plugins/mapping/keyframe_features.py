"""Features of a keyframe from the map: its landmarks, projected into its camera with their present estimates, as the features of a frame."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform, transform_planes
from trihedron.pipeline.core.linalg import inv_symmetric, matmul
from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Map, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import LocalWindow
from trihedron.plugins.mapping.projection import clip_segments
from trihedron.plugins.shared.covariances import transform_plane_covariance

L2_BYTES = 128  # least length of descriptors that are compared by Euclidean distance (SIFT, learned ones); binary ones are shorter
PLANE_PX = 1000  # size of a region where it is unknown


def features_of(map: Map, camera: Camera, T_world_camera: F64, window: LocalWindow) -> tuple[Keypoints, Segments, Planes]:
    """Project the landmarks of a window into a camera at `T_world_camera`, with the map's covariances as those of the features."""
    T = invert(T_world_camera)
    return _points(map, camera, T, window.points), _lines(map, camera, T, window.lines), _planes(map, T, window.planes)


def _points(map: Map, camera: Camera, T_camera_world: F64, ids: I32) -> Keypoints:
    local = transform(T_camera_world, map.points.rows("position_m", ids))
    front = local[:, 2] > 0.1
    ids, local = ids[front], local[front]
    R = T_camera_world[:3, :3]
    covariance = matmul(R, inv_symmetric(map.points.rows("information", ids)), R.T)
    across = np.sqrt(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    descriptors = map.points.rows("descriptor", ids)
    pixels, sigma_px = camera.project(local).astype(np.float32), np.maximum(camera.fx * across / local[:, 2], 0.3).astype(np.float32)
    sigma_m, response = np.sqrt(covariance[:, 2, 2]).astype(np.float32), np.zeros(len(ids), np.float32)
    metric = "l2" if descriptors.shape[1] >= L2_BYTES else "hamming"
    octaves = map.points.rows("octave", ids)
    return Keypoints(map.index, map.stamp_ns, pixels, local.astype(np.float32), sigma_px, sigma_m, octaves, response, descriptors, metric)


def _lines(map: Map, camera: Camera, T_camera_world: F64, ids: I32) -> Segments:
    world = map.lines.rows("endpoints_m", ids)
    pixels, inside = clip_segments(world, T_camera_world, camera)
    ids, local, pixels = ids[inside], transform(T_camera_world, world[inside]), pixels[inside]
    R = T_camera_world[:3, :3]
    covariance = matmul(R, inv_symmetric(map.lines.rows("information", ids)), R.T)
    descriptors = map.lines.rows("descriptor", ids)
    return Segments(map.index, map.stamp_ns, pixels.astype(np.float32), local.astype(np.float32), covariance.astype(np.float32), descriptors)


def _planes(map: Map, T_camera_world: F64, ids: I32) -> Planes:
    world = map.planes.rows("coefficients", ids)
    local = transform_planes(T_camera_world, world)
    facing = local[:, 3] >= 0.0  # else the camera is behind it
    ids, world, local = ids[facing], world[facing], local[facing]
    covariance = transform_plane_covariance(T_camera_world, world, local, map.planes.rows("covariance", ids))
    moments = matmul(T_camera_world, map.planes.rows("moments", ids), T_camera_world.T)
    samples = transform(T_camera_world, map.planes.rows("samples_m", ids)).astype(np.float32)
    pixels = np.full(len(ids), PLANE_PX, np.int32)
    return Planes(map.index, map.stamp_ns, local, covariance, moments, pixels, samples, np.zeros((1, 1), np.uint8), 1)
