"""Tracked key points as pairs of places."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Keypoints, Tracks

RAD_PER_PX = 0.002  # of a pixel, about: 1/fx of a common camera


def tracked_places(tracks: Tracks, now: Keypoints) -> tuple[F64, F64, F64]:
    """Places (n, 3) before and now, each in its camera's axes, and their standard deviation together (n,), of the tracks with depth in both
    frames."""
    rows = tracks.keypoints[:, 1]
    both = np.isfinite(tracks.points_m[:, 2]) & np.isfinite(now.points_m[rows, 2])
    before, after = tracks.points_m[both].astype(np.float64), now.points_m[rows[both]].astype(np.float64)
    return before, after, place_sigma(before, after, tracks.sigma_m[both], now.sigma_m[rows[both]], now.sigma_px[rows[both]])


def place_sigma(before: F64, after: F64, sigma_before: F64 | F32, sigma_after: F64 | F32, sigma_px: F64 | F32) -> F64:
    """(n,) m, of pairs of places (n, 3) with depths known to `sigma_before` and `sigma_after`, on pixels known to `sigma_px`."""
    depth = np.hypot(sigma_before.astype(np.float64), sigma_after)
    return np.asarray(np.hypot(depth, RAD_PER_PX * sigma_px * np.maximum(before[:, 2], after[:, 2])))


def rows_with_depth(keypoints: Keypoints) -> I32:
    """Rows of the key points whose depth is known."""
    return np.flatnonzero(np.isfinite(keypoints.points_m[:, 2])).astype(np.int32)
