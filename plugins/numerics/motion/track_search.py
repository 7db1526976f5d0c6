"""The features of the previous frame looked for around a motion, and those found that agree with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8, Camera, Tracks
from trihedron.plugins.numerics.algebra.constant_arrays import constant
from trihedron.plugins.numerics.images.descriptors import U64, line_matches, near_matches, words_of
from trihedron.plugins.numerics.images.flow import moved_pixel
from trihedron.plugins.numerics.motion.relative_motion import Motion
from trihedron.plugins.numerics.motion.track_pairs import Features, rows_of_pairs, tracks_value
from trihedron.plugins.numerics.planes.plane_association import associated, moved_planes

Intrinsics = tuple[float, float, float, float]


class Places(NamedTuple):
    """Where a frame shows its points and lines, as kernels read it."""

    pixels: F32  # (n, 2)
    points_m: F32  # (n, 3)
    sigma_px: F32  # (n,)
    endpoints_px: F32  # (m, 2, 2)
    endpoints_m: F32  # (m, 2, 3)


class Gates(NamedTuple):
    """How much the features of a pair may differ, apart from their place; see `match_near`, `match_lines` and `associate_planes`."""

    octave_step: int
    compared_by: int
    distance: float  # of descriptors
    ratio: float
    line_sine: float
    line_overlap: float
    lines_compared_by: int
    line_bits: float
    plane_cosine: float


@dataclass(frozen=True)
class Search:
    """Looks for the features of one frame in the next."""

    before: Features
    now: Features
    camera: Camera
    gates: Gates

    def __call__(self, R: F64, t: F64, radius_px: float, plane_m: float) -> Tracks:
        """All pairs found around the motion `p_current = R p_previous + t`: points and lines within `radius_px`, planes within `plane_m`."""
        gates, walls, seen, found = self.gates, self.before.planes, self.now.planes, self._now
        motion = constant(R, np.float64), constant(t, np.float64)
        pixels, ends, planes, samples = _moved(self._before, walls.coefficients, walls.samples_m, self._camera, *motion)
        (words, line_words), (words_now, line_words_now) = self._words
        points = near_matches(
            pixels, *words, self.before.keypoints.octaves, found.pixels, *words_now, self.now.keypoints.octaves,
            np.full(len(pixels), radius_px, np.float32), gates.octave_step, gates.compared_by, gates.distance, gates.ratio,
        )  # fmt: skip
        lines = line_matches(
            ends, line_words, found.endpoints_px, line_words_now,
            gates.line_sine, float(radius_px), gates.line_overlap, gates.lines_compared_by, gates.line_bits, gates.ratio,
        )  # fmt: skip
        same = associated(seen.coefficients, seen.samples_m, planes, samples, gates.plane_cosine, plane_m, True)
        return tracks_value(self.now, self.before, (rows_of_pairs(points), rows_of_pairs(lines), np.ascontiguousarray(same[:, ::-1])), R)

    def agreeing(self, tracks: Tracks, motion: Motion, error_px: float) -> Tracks:
        """Without the key points and lines that the motion puts elsewhere than they were found, by more than `error_px` σ, and key points that never
        had a depth."""
        R, t = constant(motion.R, np.float64), constant(motion.t, np.float64)
        unsure_px = float(self.camera.fx * np.sqrt(np.linalg.eigvalsh(motion.covariance[3:, 3:])[-1]))
        points, lines = _agreeing(tracks.keypoints, tracks.segments, self._before, self._now, self._camera, R, t, unsure_px, error_px)
        return tracks_value(self.now, self.before, (points, lines, tracks.planes), motion.R)

    @cached_property
    def _camera(self) -> Intrinsics:
        return float(self.camera.fx), float(self.camera.fy), float(self.camera.cx), float(self.camera.cy)

    @cached_property
    def _before(self) -> Places:
        return _places(self.before)

    @cached_property
    def _now(self) -> Places:
        return _places(self.now)

    @cached_property
    def _words(self) -> tuple[tuple[tuple[U64, U8], U64], tuple[tuple[U64, U8], U64]]:
        """Of both frames the descriptors of points, as words and bytes, and of lines, as words."""
        before, now = ((words_of(of.keypoints.descriptors), words_of(of.segments.descriptors)[0]) for of in (self.before, self.now))
        return before, now


def _places(features: Features) -> Places:
    points, lines = features.keypoints, features.segments
    return Places(points.pixels, points.points_m, points.sigma_px, lines.endpoints_px, lines.endpoints_m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved(before: Places, planes: F64, samples_m: F32, camera: Intrinsics, R: F64, t: F64) -> tuple[F32, F32, F64, F32]:
    """Pixels (n, 2) and ends of lines (m, 2, 2) of the previous frame, its planes (p, 4) and points on them (p, s, 3), where the motion puts them."""
    pixels, ends = np.empty((len(before.pixels), 2), np.float32), np.empty((len(before.endpoints_px), 2, 2), np.float32)
    for i in range(len(pixels)):
        pixels[i, 0], pixels[i, 1] = _there(before.pixels, before.points_m, i, camera, R, t)
    for i in range(len(ends)):
        for e in range(2):
            ends[i, e, 0], ends[i, e, 1] = _end_there(before, i, e, camera, R, t)
    coefficients, samples = moved_planes(planes, samples_m, R, t)
    return pixels, ends, coefficients, samples


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _there(pixels: F32, points_m: F32, i: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """Row i of key points where the motion puts it."""
    return moved_pixel(pixels[i, 0], pixels[i, 1], points_m[i, 0], points_m[i, 1], points_m[i, 2], camera, R, t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _end_there(shown: Places, i: int, end: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """An end of line i where the motion puts it."""
    px, m = shown.endpoints_px, shown.endpoints_m
    return moved_pixel(px[i, end, 0], px[i, end, 1], m[i, end, 0], m[i, end, 1], m[i, end, 2], camera, R, t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _agreeing(
    points: I32, lines: I32, before: Places, now: Places, camera: Intrinsics, R: F64, t: F64, unsure_px: float, error_px: float
) -> tuple[I32, I32]:
    """The pairs (previous, current) of points and lines that agree with a motion, which leaves `unsure_px` open of what is at depth 1."""
    good_points, good_lines, n, m = np.empty((len(points), 2), np.int32), np.empty((len(lines), 2), np.int32), 0, 0
    R_back, t_back = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        t_back[a] = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
        for b in range(3):
            R_back[a, b] = R[b, a]
    for k in range(len(points)):
        i, j = points[k, 0], points[k, 1]
        then, since = float(before.points_m[i, 2]), float(now.points_m[j, 2])
        if np.isfinite(then):
            u, v = _there(before.pixels, before.points_m, i, camera, R, t)
            x, y = u - now.pixels[j, 0], v - now.pixels[j, 1]
            depth = since if since < then else then
        elif np.isfinite(since):
            u, v = _there(now.pixels, now.points_m, j, camera, R_back, t_back)
            x, y, depth = u - before.pixels[i, 0], v - before.pixels[i, 1], since
        else:
            continue
        if np.sqrt(x * x + y * y) <= error_px * (now.sigma_px[j] + (unsure_px / depth if depth > 0.0 else 0.0)):
            good_points[n, 0], good_points[n, 1] = i, j
            n += 1
    for k in range(len(lines)):
        i, j = lines[k, 0], lines[k, 1]
        x, y = float(now.endpoints_px[j, 0, 0]), float(now.endpoints_px[j, 0, 1])
        along_x, along_y = now.endpoints_px[j, 1, 0] - x, now.endpoints_px[j, 1, 1] - y
        length, off = max(np.sqrt(along_x * along_x + along_y * along_y), 1e-9), 0.0
        for e in range(2):
            u, v = _end_there(before, i, e, camera, R, t)
            off += 0.5 * abs((v - y) * along_x - (u - x) * along_y) / length
        depth = min(float(before.endpoints_m[i, 0, 2]), float(before.endpoints_m[i, 1, 2]))
        if off <= error_px * (1.0 + unsure_px / (depth if depth > 0.0 else 1.0)):
            good_lines[m, 0], good_lines[m, 1] = i, j
            m += 1
    return good_points[:n], good_lines[:m]
