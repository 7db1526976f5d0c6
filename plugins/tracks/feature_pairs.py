"""Pairs of features of two frames: lines and planes matched by a known motion, and the value of the topic `tracks`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix, transform_planes
from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.feature_matching import associate_planes, match_lines
from trihedron.plugins.shared.relative_motion import MotionOptions, solve_motion
from trihedron.plugins.tracks.feature_pairs_kernels import pairs_of_matches, predict_pixels_kernel

NO_PAIRS = np.zeros((0, 2), np.int32)


@dataclass(frozen=True)
class Features:
    """The features of one frame."""

    keypoints: Keypoints
    segments: Segments
    planes: Planes


@dataclass(frozen=True)
class StructureGates:
    """Gates on lines and planes about their predicted positions."""

    line_deg: float = 8.0
    line_px: float = 8.0
    line_overlap: float = 0.4  # of the shorter segment
    line_bits: int = 80  # of 256
    ratio: float = 0.9
    plane_deg: float = 8.0
    plane_m: float = 0.05

    def pairs(self, now: Features, before: Features, camera: Camera, R: F64, t: F64) -> tuple[I32, I32]:
        """Match lines (m, 2) and planes (p, 2), rows (previous, current), near their prediction by `p_current = R p_previous + t`."""
        predicted = predict_pixels(before.segments.endpoints_px, before.segments.endpoints_m, camera, R, t).astype(np.float32)
        described, found = before.segments.descriptors, now.segments
        lines = match_lines(
            predicted, described, found.endpoints_px, found.descriptors, self.line_deg, self.line_px, self.line_overlap, self.line_bits, self.ratio
        )
        known = transform_planes(pose_matrix(R, t), before.planes.coefficients)
        samples = (matmul(before.planes.samples_m, R.T) + t).astype(np.float32)
        planes = associate_planes(now.planes.coefficients, now.planes.samples_m, known, samples, self.plane_deg, self.plane_m, many_to_one=True)
        return pairs_of_matches(lines), np.ascontiguousarray(planes[:, ::-1])


def with_carried_depth(before: Features, tracks: Tracks | None, options: MotionOptions, camera: Camera) -> Features:
    """Return the features of a previous frame; those of one without any depth at the positions that its `tracks` have in the frame before, moved by
    the motion of these tracks: key points on the rays of their pixels, lines where their ends come to. So frames without depth, one or several in a
    row, do not interrupt tracking."""
    points, lines = before.keypoints, before.segments
    if tracks is None or tracks.index != points.index or np.isfinite(points.points_m[:, 2]).any():
        return before
    motion = solve_motion(options, camera, tracks, points, lines, before.planes, max(tracks.index - tracks.previous_index, 1))
    positions, sigmas, ends = points.points_m.copy(), points.sigma_m.copy(), lines.endpoints_m.copy()
    row, depth = tracks.keypoints[:, 1], matmul(tracks.points_m, motion.R[2]) + motion.t[2]
    positions[row] = camera.back_project(points.pixels[row], np.where(depth > 0.0, depth, np.nan))
    sigmas[row] = np.hypot(tracks.sigma_m, np.sqrt(motion.covariance[5, 5]))
    ends[tracks.segments[:, 1]] = matmul(tracks.endpoints_m, motion.R.T) + motion.t
    return replace(before, keypoints=replace(points, points_m=positions, sigma_m=sigmas), segments=replace(lines, endpoints_m=ends))


def tracks_value(now: Features, before: Features, pairs: tuple[I32, I32, I32], R_current_previous: F64) -> Tracks:
    """The pairs of points, lines and planes, rows (previous, current), with the previous geometry."""
    points, lines, planes = pairs
    of_points, of_lines, of_planes = (kind[:, 0] for kind in pairs)  # `take` gathers rows in a third of the time of an index
    return Tracks(
        index=now.keypoints.index,
        stamp_ns=now.keypoints.stamp_ns,
        previous_index=before.keypoints.index,
        keypoints=points,
        points_m=before.keypoints.points_m.take(of_points, 0),
        sigma_m=before.keypoints.sigma_m.take(of_points, 0),
        segments=lines,
        endpoints_m=before.segments.endpoints_m.take(of_lines, 0),
        planes=planes,
        coefficients=before.planes.coefficients.take(of_planes, 0),
        plane_covariance=before.planes.covariance.take(of_planes, 0),
        R_current_previous=R_current_previous,
        repeated=_repeated(now.keypoints, before.keypoints, points),
    )


def _repeated(now: Keypoints, before: Keypoints, pairs: I32) -> float:
    """Share of the pairs (n, 2) of key points, rows (previous, current), whose pixel and descriptor are bit-identical."""
    x_and_y = before.pixels.take(pairs[:, 0], 0) == now.pixels.take(pairs[:, 1], 0)
    same = np.flatnonzero(x_and_y[:, 0] & x_and_y[:, 1])
    if not len(same):
        return 0.0
    alike = before.descriptors[pairs[same, 0]] == now.descriptors[pairs[same, 1]]
    return float(np.count_nonzero(alike.all(axis=1)) / len(pairs))


def predict_pixels(pixels: F32, points_m: F32, camera: Camera, R: F64, t: F64) -> F64:
    """Project pixels (..., 2) of the previous image by the motion (R, t), NaN behind the camera; those without a 3D point (..., 3) as points at
    infinity."""
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    flat = constant(pixels.reshape(-1, 2), np.float32), constant(points_m.reshape(-1, 3), np.float32)
    return np.asarray(predict_pixels_kernel(*flat, intrinsics, constant(R, np.float64), constant(t, np.float64)).reshape(pixels.shape))
