"""Pairs of features of two frames as the topic `tracks`."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix, transform_planes
from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.numerics.images.descriptors import match_lines
from trihedron.plugins.numerics.images.flow import predict_pixels
from trihedron.plugins.numerics.planes.plane_association import associate_planes

NO_PAIRS = np.zeros((0, 2), np.int32)


@dataclass(frozen=True)
class Features:
    """What one frame shows."""

    keypoints: Keypoints
    segments: Segments
    planes: Planes


@dataclass(frozen=True)
class StructureGates:
    """How far lines and planes may be from where a known motion puts them."""

    line_deg: float = 8.0
    line_px: float = 8.0
    line_overlap: float = 0.4  # of the shorter segment
    line_bits: int = 80  # of 256
    ratio: float = 0.9
    plane_deg: float = 8.0
    plane_m: float = 0.05

    def pairs(self, now: Features, before: Features, camera: Camera, R: F64, t: F64) -> tuple[I32, I32]:
        """(m, 2) lines and (p, 2) planes, rows (previous, current), found around the motion `p_current = R p_previous + t`."""
        predicted = predict_pixels(before.segments.endpoints_px, before.segments.endpoints_m, camera, R, t).astype(np.float32)
        known, found = before.segments.descriptors, now.segments
        lines = match_lines(
            predicted, known, found.endpoints_px, found.descriptors, self.line_deg, self.line_px, self.line_overlap, self.line_bits, self.ratio
        )
        moved = transform_planes(pose_matrix(R, t), before.planes.coefficients)
        samples = (before.planes.samples_m @ R.T + t).astype(np.float32)
        planes = associate_planes(now.planes.coefficients, now.planes.samples_m, moved, samples, self.plane_deg, self.plane_m, many_to_one=True)
        return rows_of_pairs(lines), np.ascontiguousarray(planes[:, ::-1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rows_of_pairs(found: I32) -> I32:
    """(n,) row of the current frame for each previous one, or -1 -> (k, 2)."""
    out, k = np.empty((len(found), 2), np.int32), 0
    for i in range(len(found)):
        if found[i] >= 0:
            out[k, 0], out[k, 1] = i, found[i]
            k += 1
    return out[:k]


def tracks_value(now: Features, before: Features, pairs: tuple[I32, I32, I32], R_current_previous: F64) -> Tracks:
    """The pairs of points, lines and planes, rows (previous, current), with the previous geometry."""
    points, lines, planes = pairs
    return Tracks(
        index=now.keypoints.index,
        stamp_ns=now.keypoints.stamp_ns,
        previous_index=before.keypoints.index,
        keypoints=points,
        points_m=before.keypoints.points_m[points[:, 0]],
        sigma_m=before.keypoints.sigma_m[points[:, 0]],
        segments=lines,
        endpoints_m=before.segments.endpoints_m[lines[:, 0]],
        planes=planes,
        coefficients=before.planes.coefficients[planes[:, 0]],
        plane_covariance=before.planes.covariance[planes[:, 0]],
        R_current_previous=R_current_previous,
    )
