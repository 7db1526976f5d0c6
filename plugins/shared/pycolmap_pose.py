"""The pose of a camera from points that are known and their pixels, by COLMAP."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F64, Bool, Camera
from trihedron.plugins.shared.libraries import RANDOM, pycolmap

LEAST = 4  # points, of which a pose can be checked


class AbsolutePose(NamedTuple):
    """`p_camera = R p_world + t`, and which points agree (n,)."""

    R: F64
    t: F64
    inliers: Bool


def absolute_pose(
    points_m: NDArray[np.floating], pixels: NDArray[np.floating], camera: Camera, max_error_px: float, seed: int
) -> AbsolutePose | None:  # fmt: skip
    """`pycolmap.estimate_and_refine_absolute_pose`: LO-RANSAC (Chum, Matas, Kittler, DAGM 2003) over P3P, then least squares over the inliers.

    Args: points (n, 3) and pixels (n, 2). None with fewer than four points or when COLMAP finds none."""
    if len(points_m) < LEAST:
        return None
    library = pycolmap()
    centre = camera.cx + 0.5, camera.cy + 0.5  # COLMAP's pixel centres are at halves
    model = library.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=[camera.fx, camera.fy, *centre])
    estimation = library.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error, estimation.ransac.random_seed, estimation.ransac.num_threads = max_error_px, seed, 1
    centres = np.asarray(pixels, np.float64) + 0.5
    with RANDOM:
        found = library.estimate_and_refine_absolute_pose(centres, np.asarray(points_m, np.float64), model, estimation)
    if found is None:
        return None
    matrix = np.asarray(found["cam_from_world"].matrix(), np.float64)
    return AbsolutePose(matrix[:, :3].copy(), matrix[:, 3].copy(), np.asarray(found["inlier_mask"], np.bool_))
