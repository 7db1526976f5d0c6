"""Bundle adjustment of points by COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, pose_matrix, transform_each, transform_planes
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import I32, Correction, Map
from trihedron.plugins.bundle.window import (
    BundleMeasurements,
    BundleOptions,
    BundleState,
    BundleWindow,
    WindowOptions,
    bundle_problem,
    bundle_window,
    free_poses,
)
from trihedron.plugins.mapping.covisibility_graph import newest_keyframes
from trihedron.plugins.mapping.landmarks import ENDPOINTS, POSITION
from trihedron.plugins.shared import libraries
from trihedron.plugins.shared.covariances import transform_plane_covariance


@register("bundle", "colmap")
@dataclass(frozen=True)
class Colmap(WindowOptions):
    """The window of `local_window` with COLMAP's own solver (Schönberger and Frahm, CVPR 2016): reprojected points alone, σ = 1 px.

    For comparison. Depth is not used, so two keyframes are fixed to keep the scale. Lines, planes and points observed once move rigidly with the
    newest keyframe that observed them. COLMAP returns no covariance here: each landmark retains that of the map."""

    iterations: PositiveInt = 20
    loss_px: PositiveFloat = 2.0  # beyond which Huber's cost is linear

    def __call__(self, map: Map) -> Correction | None:
        """Return the correction, or None when this version of the map has no new keyframe, or fewer than two to fix and one to adjust."""
        newest = newest_keyframes(map, 1)
        if not len(newest) or map.keyframes.rows("index", newest)[0] != map.index:
            return None
        window = bundle_window(self, map, least_fixed=2)
        if not len(window.free):
            return None
        state, seen = bundle_problem(BundleOptions(), map, window)
        return _correction(map, window, seen, solve_colmap(state, seen, self.iterations, self.loss_px))


def solve_colmap(state: BundleState, seen: BundleMeasurements, iterations: int, loss_px: float) -> BundleState:
    """Adjust the free keyframes and the points observed at least twice with COLMAP; a `loss_px` of 0 is least squares."""
    pycolmap = libraries.pycolmap()
    reconstruction, points = _reconstruction(state, seen)
    config = pycolmap.BundleAdjustmentConfig()
    for k in range(len(state.rotations)):
        config.add_image(k + 1)
        config.set_constant_cam_intrinsics(k + 1)
        if k >= seen.free:
            config.set_constant_rig_from_world_pose(k + 1)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.num_threads = 1
    if loss_px > 0.0:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
        options.ceres.loss_function_scale = loss_px
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    out = BundleState(state.rotations.copy(), state.positions.copy(), state.points.copy(), state.lines, state.planes)
    for k in range(seen.free):
        T = np.eye(4)
        T[:3] = reconstruction.image(k + 1).cam_from_world().matrix()
        out.rotations[k], out.positions[k] = T[:3, :3].T, invert(T)[:3, 3]
    for row, number in points.items():
        out.points[row] = reconstruction.point3D(number).xyz
    return out


def _reconstruction(state: BundleState, seen: BundleMeasurements) -> tuple[Any, dict[int, int]]:
    """Convert the problem to COLMAP's, keyframe k as image k + 1 with a camera of its own; also COLMAP's id of each point observed twice."""
    pycolmap = libraries.pycolmap()
    reconstruction, points = pycolmap.Reconstruction(), {}
    place = np.zeros(len(seen.pixels), np.int64)  # of each observation within its image
    for k, (R, t) in enumerate(zip(state.rotations, state.positions)):
        rows = np.flatnonzero(seen.point_keyframes == k)
        place[rows] = np.arange(len(rows))
        width, height = (2.0 * seen.intrinsics[k, 2:]).astype(int) + 1
        camera = pycolmap.Camera(model="PINHOLE", width=int(width), height=int(height), params=seen.intrinsics[k], camera_id=k + 1)
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(k), keypoints=seen.pixels[rows], camera_id=k + 1, image_id=k + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(pose_matrix(R, t))[:3]))
    for i, position in enumerate(state.points):
        rows = np.arange(seen.point_starts[i], seen.point_starts[i + 1])
        if len(np.unique(seen.point_keyframes[rows])) > 1:
            track = pycolmap.Track()
            for o in rows:
                track.add_element(int(seen.point_keyframes[o]) + 1, int(place[o]))
            points[i] = reconstruction.add_point3D(position, track)
    return reconstruction, points


def _correction(map: Map, window: BundleWindow, seen: BundleMeasurements, state: BundleState) -> Correction:
    """The state of the window's keyframes and points as a correction, with the map's covariances.

    Lines, planes and points that the state left in place move rigidly with the newest free keyframe that observed them."""
    free = len(window.free)
    poses = free_poses(state, free)
    motions = matmul(poses, invert(map.keyframes.rows("T_world_camera", window.free)))
    by = [np.repeat(np.arange(len(starts) - 1), np.diff(starts)) for starts in (seen.point_starts, seen.line_starts)]
    T_point, T_line, T_plane = (
        motions[_newest_free(rows, who, count, free)]
        for rows, who, count in (
            (by[0], seen.point_keyframes, len(window.points)),
            (by[1], seen.line_keyframes, len(window.lines)),
            (seen.plane_landmarks, seen.plane_keyframes, len(window.planes)),
        )
    )
    old = map.points.rows("position_m", window.points)
    still = (state.points == old).all(axis=1)
    points = np.where(still[:, None], transform_each(T_point, old[:, None])[:, 0], state.points)
    planes = map.planes.rows("coefficients", window.planes)
    moved = [transform_planes(T, plane[None])[0] for T, plane in zip(T_plane, planes)]
    covariance = map.planes.rows("covariance", window.planes)
    plane_covariance = [transform_plane_covariance(T, a[None], b[None], C[None])[0] for T, a, b, C in zip(T_plane, planes, moved, covariance)]
    R, Q = T_point[:, :3, :3], T_line[:, None, :3, :3]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=poses,
        point_ids=window.points,
        points_m=POSITION.rounded(points),
        point_information=matmul(R, map.points.rows("information", window.points), np.swapaxes(R, -1, -2)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDPOINTS.rounded(transform_each(T_line, map.lines.rows("endpoints_m", window.lines))),
        line_information=matmul(Q, map.lines.rows("information", window.lines), np.swapaxes(Q, -1, -2)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=np.array(moved, np.float64).reshape(-1, 4),
        plane_covariance=np.array(plane_covariance, np.float64).reshape(-1, 3, 3),
    )


def _newest_free(rows: NDArray[np.signedinteger], keyframes: I32, count: int, free: int) -> I32:
    """Newest free keyframe, (count,), that observed each landmark; `rows` and `keyframes` are the landmarks and observers of the observations."""
    newest = np.zeros(count, np.int32)
    known = keyframes < free
    np.maximum.at(newest, rows[known], keyframes[known])
    return newest
