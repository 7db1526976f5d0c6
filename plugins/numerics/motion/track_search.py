"""The features of the previous frame looked for around a motion, and those found that agree with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, U8, Camera, Tracks
from trihedron.plugins.numerics.algebra.constant_arrays import constant
from trihedron.plugins.numerics.images.descriptors import U64, line_matches, near_matches, words_of
from trihedron.plugins.numerics.images.flow import moved_pixel
from trihedron.plugins.numerics.motion.relative_motion import Motion
from trihedron.plugins.numerics.motion.track_pairs import Features, tracks_value
from trihedron.plugins.numerics.planes.plane_association import associated

Intrinsics = tuple[float, float, float, float]


class Shown(NamedTuple):
    """What kernels read of the `Features` of a frame."""

    pixels: F32  # (n, 2)
    points_m: F32  # (n, 3)
    sigma_px: F32  # (n,)
    octaves: U8  # (n,)
    words: U64  # (n, w) descriptors
    bytes: U8  # (n, b)
    endpoints_px: F32  # (m, 2, 2)
    endpoints_m: F32  # (m, 2, 3)
    line_words: U64  # (m, v)
    planes: F64  # (p, 4)
    samples_m: F32  # (p, s, 3)


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
        pairs = _found_near(*self._shown, constant(R, np.float64), constant(t, np.float64), float(radius_px), plane_m, self.gates)
        return tracks_value(self.now, self.before, pairs, R)

    def agreeing(self, tracks: Tracks, motion: Motion, error_px: float) -> Tracks:
        """Without the key points and lines that the motion puts elsewhere than they were found, by more than `error_px` σ, and key points that never
        had a depth."""
        R, t = constant(motion.R, np.float64), constant(motion.t, np.float64)
        unsure_px = float(self.camera.fx * np.sqrt(np.linalg.eigvalsh(motion.covariance[3:, 3:])[-1]))
        points, lines = _agreeing(tracks.keypoints, tracks.segments, *self._shown, R, t, unsure_px, error_px)
        return tracks_value(self.now, self.before, (points, lines, tracks.planes), motion.R)

    @cached_property
    def _shown(self) -> tuple[Shown, Shown, Intrinsics]:
        camera = self.camera
        return _shown(self.before), _shown(self.now), (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


def _shown(features: Features) -> Shown:
    points, lines, planes = features.keypoints, features.segments, features.planes
    return Shown(
        points.pixels, points.points_m, points.sigma_px, points.octaves, *words_of(points.descriptors),
        lines.endpoints_px, lines.endpoints_m, words_of(lines.descriptors)[0], planes.coefficients, planes.samples_m,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _found_near(
    before: Shown, now: Shown, camera: Intrinsics, R: F64, t: F64, radius_px: float, plane_m: float, gates: Gates
) -> tuple[I32, I32, I32]:
    """Pairs of points, lines and planes, rows (previous, current), around the motion `p_current = R p_previous + t`."""
    step, by, distance, ratio, sine, overlap, lines_by, line_bits, cosine = gates
    pixels, radius = np.empty((len(before.pixels), 2), np.float32), np.empty(len(before.pixels), np.float32)
    for i in range(len(pixels)):
        pixels[i, 0], pixels[i, 1] = _there(before.pixels, before.points_m, i, camera, R, t)
        radius[i] = radius_px
    points = near_matches(
        pixels, before.words, before.bytes, before.octaves, now.pixels, now.words, now.bytes, now.octaves, radius, step, by, distance, ratio
    )
    ends = np.empty((len(before.endpoints_px), 2, 2), np.float32)
    for i in range(len(ends)):
        for e in range(2):
            ends[i, e, 0], ends[i, e, 1] = _end_there(before, i, e, camera, R, t)
    lines = line_matches(ends, before.line_words, now.endpoints_px, now.line_words, sine, radius_px, overlap, lines_by, line_bits, ratio)
    planes, samples = _moved_planes(before.planes, before.samples_m, R, t)
    same = associated(now.planes, now.samples_m, planes, samples, cosine, plane_m, True)
    for k in range(len(same)):
        same[k, 0], same[k, 1] = same[k, 1], same[k, 0]
    return _rows(points), _rows(lines), same


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _there(pixels: F32, points_m: F32, i: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """Row i of key points where the motion puts it."""
    return moved_pixel(pixels[i, 0], pixels[i, 1], points_m[i, 0], points_m[i, 1], points_m[i, 2], camera, R, t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _end_there(shown: Shown, i: int, end: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """An end of line i where the motion puts it."""
    px, m = shown.endpoints_px, shown.endpoints_m
    return moved_pixel(px[i, end, 0], px[i, end, 1], m[i, end, 0], m[i, end, 1], m[i, end, 2], camera, R, t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved_planes(planes: F64, samples_m: F32, R: F64, t: F64) -> tuple[F64, F32]:
    """Planes (p, 4) and points on them (p, s, 3) in the current frame."""
    coefficients, samples = np.empty(planes.shape), np.empty(samples_m.shape, np.float32)
    for i in range(len(planes)):
        coefficients[i, 3] = planes[i, 3]
        for a in range(3):
            coefficients[i, a] = R[a, 0] * planes[i, 0] + R[a, 1] * planes[i, 1] + R[a, 2] * planes[i, 2]
            coefficients[i, 3] -= coefficients[i, a] * t[a]
            for k in range(samples_m.shape[1]):
                samples[i, k, a] = R[a, 0] * samples_m[i, k, 0] + R[a, 1] * samples_m[i, k, 1] + R[a, 2] * samples_m[i, k, 2] + t[a]
    return coefficients, samples


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(found: I32) -> I32:
    """(n,) row of the current frame for each previous one, or -1 -> (k, 2)."""
    out, k = np.empty((len(found), 2), np.int32), 0
    for i in range(len(found)):
        if found[i] >= 0:
            out[k, 0], out[k, 1] = i, found[i]
            k += 1
    return out[:k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _agreeing(
    points: I32, lines: I32, before: Shown, now: Shown, camera: Intrinsics, R: F64, t: F64, unsure_px: float, error_px: float
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
