"""Size of the patch that gives a normal of a wanted standard deviation, by depth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Camera


@lru_cache(maxsize=16)
def patch_sides(camera: Camera, noise_deg: float, least_px: float, most_px: float) -> F64:
    """(100,) side in px of the patch whose normal has a predicted standard deviation of `noise_deg`, for depths of 0.1, 0.2 … 10 m, within bounds;
    read-only.

    The tangents of n × n px with independent depth noise σ at z have gradients of σ f / z · √12 / n² (least squares, to 7 %)."""
    z = np.arange(1, 101) * 0.1
    slope = camera.depth_noise.sigma_m(z) * camera.fx / z
    side = np.asarray(np.clip(np.sqrt(np.sqrt(12.0) * slope / np.radians(noise_deg)), least_px, most_px))
    side.flags.writeable = False
    return side


@lru_cache(maxsize=16)
def patch_radii(camera: Camera, noise_deg: float, least_px: float, most_px: float, stride: int) -> I32:
    """(100,) half-widths of the patches of `patch_sides` in cells of `stride` pixels, at least 1; read-only."""
    radii = np.maximum(np.round((patch_sides(camera, noise_deg, least_px, most_px) / stride - 1.0) / 2.0), 1).astype(np.int32)
    radii.flags.writeable = False
    return radii
