"""Bundle adjustment of points by COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Map
from trihedron.plugins.bundle.common import bundle_problem, bundle_window, carried_correction
from trihedron.plugins.bundle.common_kernels import BundleMeasurements, BundleState
from trihedron.plugins.mapping.covisibility_graph import newest_keyframes


@register("bundle", "colmap")
@dataclass(frozen=True)
class Colmap:
    """The window of `local_window` with COLMAP's own solver (Schönberger and Frahm, CVPR 2016): reprojected points alone, a pixel each.

    For comparison. Depth has no part in it, so two keyframes are held to keep the scale. Lines, planes and points seen once go with the newest
    keyframe that saw them. COLMAP says nothing of what is left uncertain: each landmark stays known as well as the map knew it."""

    keyframes: PositiveInt = 8  # at most, that may move: the newest and those that share most landmarks with it
    fixed: NonNegativeInt = 8  # at most, that are held
    iterations: PositiveInt = 20
    loss_px: PositiveFloat = 2.0  # beyond which Huber's cost is linear

    def __call__(self, map: Map) -> Correction | None:
        """The correction, or None when this version of the map has no new keyframe, or fewer than two to hold and one to move."""
        newest = newest_keyframes(map, 1)
        if not len(newest) or map.keyframes.rows("index", newest)[0] != map.index:
            return None
        window = bundle_window(map, self.keyframes, self.fixed, least_fixed=2)
        if not len(window.free):
            return None
        state, seen = bundle_problem(map, window)
        return carried_correction(map, window, seen, solve_colmap(state, seen, self.iterations, self.loss_px))


def solve_colmap(state: BundleState, seen: BundleMeasurements, iterations: int, loss_px: float) -> BundleState:
    """The state with the free keyframes, and the points seen at least twice, where COLMAP's adjustment puts them; a `loss_px` of 0 is least
    squares."""
    import pycolmap

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
    """The problem as COLMAP knows it, keyframe k as image k + 1 with a camera of its own, and COLMAP's number of each point that is seen twice."""
    import pycolmap

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
