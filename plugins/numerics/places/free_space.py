"""What the camera would see through, were it at a supposed place."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import F64, Frame, Map
from trihedron.plugins.numerics.maps.local_window import LocalWindow
from trihedron.plugins.numerics.maps.visibility import NEAR_M, in_image

TOLERANCE_M, TOLERANCE_SIGMAS = 0.1, 5.0  # of depth, before a surface is not where it should be


def seen_through(T_world_camera: F64, frame: Frame, map: Map, seen: LocalWindow) -> float:
    """Share of the known points and samples of planes in view of a camera at (4, 4) that would hang in free space: the frame's depth lies beyond
    them. What something hides says nothing, nor does a pixel without depth. 0 where nothing is in view."""
    samples = map.planes.rows("samples_m", seen.planes).reshape(-1, 3).astype(np.float64)
    world = np.concatenate([map.points.rows("position_m", seen.points), samples[np.isfinite(samples[:, 0])]])
    local = transform(invert(T_world_camera), world)
    local = local[local[:, 2] > NEAR_M]
    pixels = frame.camera.project(local)
    inside = in_image(pixels, frame.camera)
    x, y = np.rint(pixels[inside]).astype(int).T
    depth, z = frame.depth_m[y, x].astype(np.float64), local[inside, 2]
    tolerance = TOLERANCE_M + TOLERANCE_SIGMAS * frame.camera.depth_noise.sigma_m(depth)
    through = int(np.count_nonzero((depth > 0.0) & (z < depth - tolerance)))
    met = int(np.count_nonzero((depth > 0.0) & (np.abs(z - depth) <= tolerance)))
    return through / max(through + met, 1)
