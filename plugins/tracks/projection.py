"""Tracking by projection with a predicted rotation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.pipeline.core.linalg import eigvalsh, matmul
from trihedron.pipeline.core.options import AcuteDeg, NonNegativeInt, PositiveFloat, PositiveInt, PositiveShare, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, U8, Camera, Keypoints, ManhattanFrame, Planes, Segments, Tracks
from trihedron.plugins.shared.feature_matching import compared_by, mutual_matches, words_of
from trihedron.plugins.shared.feature_matching_kernels import U64, associate_planes_kernel, line_matches, near_matches
from trihedron.plugins.shared.relative_motion import Motion, solve_motion
from trihedron.plugins.shared.rigid_alignment import consensus, tracked_point_pairs
from trihedron.plugins.tracks.feature_pairs import NO_PAIRS, Features, tracks_value, with_carried_depth
from trihedron.plugins.tracks.feature_pairs_kernels import pairs_of_matches
from trihedron.plugins.tracks.projection_kernels import FeaturePositions, Intrinsics, consistent_pairs, predict_features

NOT_MOVED = np.zeros(3)


@register("tracks", "projection")
@dataclass(frozen=True)
class Projection:
    """Project the previous features with the predicted rotation, match by descriptor near there, estimate the motion, and match again in a smaller
    radius about its prediction. Pairs that contradict the motion are rejected. Deterministic.

    The rotation is predicted from the Manhattan frames of the two images, else from the last motion, else as none; where the two differ, that with
    more matches is selected. `R_current_previous` is the rotation estimated from the pairs."""

    radius_px: PositiveFloat = 25.0  # of the first search: the translation is unknown
    near_px: PositiveFloat = 8.0  # of the second search, about the estimated motion
    enough: NonNegativeInt = 30  # key points; with fewer the first search is repeated with twice the radius
    max_bits: int = 64  # of 256, descriptor distance of key points
    max_l2: int = 250  # the same for descriptors compared by Euclidean distance
    ratio: PositiveShare = 0.9  # best to second best descriptor
    octave_step: NonNegativeInt = 1
    line_deg: AcuteDeg = 8.0  # direction of a segment
    line_overlap: Share = 0.4  # of the shorter segment
    line_bits: int = 80  # of 256
    plane_deg: AcuteDeg = 8.0
    plane_m: PositiveFloat = 0.15  # distance at first
    plane_near_m: PositiveFloat = 0.05  # about the estimated motion
    max_age: PositiveInt = 10  # frames; older features are not matched
    error_px: PositiveFloat = 4.0  # standard deviations between a key point and its prediction
    prior_deg: PositiveFloat = 2.0  # of the predicted rotation
    prior_m: PositiveFloat = 0.1  # of no translation, per frame
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    plane_floor_deg: PositiveFloat = 0.3
    wide_below: NonNegativeInt = 60  # key points; with fewer tracks the previous frame is matched without a prediction, for wide baselines
    wide_inliers: PositiveInt = 12  # pairs that must agree on a rigid motion for that
    wide_gate: PositiveFloat = 3.0  # standard deviations within which a pair agrees
    wide_rounds: PositiveInt = 500  # samples of three pairs

    def __post_init__(self) -> None:
        check_increasing(self, "near_px", "radius_px")
        check_increasing(self, "plane_near_m", "plane_m")

    def __call__(
        self,
        camera: Camera,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_segments: Segments | None,
        previous_planes: Planes | None,
        manhattan: ManhattanFrame | None,
        previous_manhattan: ManhattanFrame | None,
        previous: Tracks | None,
        rng: np.random.Generator,
    ) -> Tracks | None:
        """Return the pairs with the previous frame; None for the first frame, no pairs when the previous features are too old."""
        if previous_keypoints is None or previous_segments is None or previous_planes is None:
            return None
        now = Features(keypoints, segments, planes)
        before = with_carried_depth(Features(previous_keypoints, previous_segments, previous_planes), previous, self, camera)
        gap = keypoints.index - previous_keypoints.index
        rotations = self._predictions(gap, before.keypoints.index, manhattan, previous_manhattan, previous)
        if gap > self.max_age:
            return tracks_value(now, before, (NO_PAIRS, NO_PAIRS, NO_PAIRS), rotations[0])
        search = Search(self, before, now, camera)
        radius = self.radius_px * min(gap, 3)
        first = max((search(R, NOT_MOVED, radius, self.plane_m) for R in rotations), key=_count)
        if len(first.keypoints) < min(self.enough, len(keypoints.pixels)):
            first = search(first.R_current_previous, NOT_MOVED, 2.0 * radius, self.plane_m)
        motion = search.motion(first)
        again = search(motion.R, motion.t, self.near_px, self.plane_near_m)
        again = again if _count(again) >= 0.7 * _count(first) else first
        found = search.consistent(again, search.motion(again))
        if len(found.keypoints) >= min(self.wide_below, len(keypoints.pixels)):
            return found
        wide = self._wide_baseline(search, now, before, rng)
        return wide if wide is not None and len(wide.keypoints) > len(found.keypoints) else found

    def _wide_baseline(self, search: Search, now: Features, before: Features, rng: np.random.Generator) -> Tracks | None:
        """Track without a prediction: mutual nearest descriptors, the rigid motion that most of them agree on (RANSAC), then all features around it.
        None when fewer than `wide_inliers` agree."""
        pairs = mutual_matches(before.keypoints.descriptors, now.keypoints.descriptors, now.keypoints.metric, self.ratio)
        unguided = tracks_value(now, before, (pairs, NO_PAIRS, NO_PAIRS), np.eye(3))
        rigid = consensus(*tracked_point_pairs(unguided, now.keypoints), self.wide_gate, self.wide_rounds, rng)
        if np.count_nonzero(rigid.agree) < self.wide_inliers:
            return None
        motion = search.motion(search(rigid.R, rigid.t, self.radius_px, self.plane_m))
        again = search(motion.R, motion.t, self.near_px, self.plane_near_m)
        return search.consistent(again, search.motion(again))

    def _predictions(
        self, gap: int, previous_index: int, manhattan: ManhattanFrame | None, previous_manhattan: ManhattanFrame | None, previous: Tracks | None
    ) -> list[F64]:
        """Predicted rotations R_current_previous to try, at least one, all different."""
        found = []
        if previous is not None and previous.index == previous_index and previous.index > previous.previous_index:
            share = gap / (previous.index - previous.previous_index)
            found.append(exp_so3(share * log_so3(previous.R_current_previous)))
        if manhattan is not None and previous_manhattan is not None and previous_manhattan.index == previous_index:
            relative = _manhattan_rotation(manhattan, previous_manhattan)
            if relative is not None and all(rotation_angle_deg(matmul(relative, R.T)) > self.prior_deg for R in found):
                found.append(relative)
        return found or [np.eye(3)]


def _manhattan_rotation(now: ManhattanFrame, before: ManhattanFrame) -> F64 | None:
    """R_current_previous (3, 3) by the best supported Manhattan frame that both frames observe under the same id; None without one."""
    if not (now.supported and before.supported):
        return None
    seen = {int(before.ids[k]): k for k in np.flatnonzero(before.inliers.any(axis=1))}
    both = [k for k in np.flatnonzero(now.inliers.any(axis=1)) if int(now.ids[k]) in seen]
    return matmul(now.rotations[both[0]], before.rotations[seen[int(now.ids[both[0]])]].T) if both else None


def _count(tracks: Tracks) -> int:
    return len(tracks.keypoints) + len(tracks.segments) + len(tracks.planes)


@dataclass(frozen=True)
class Search:
    """Matches the features of one frame with the next."""

    options: Projection
    before: Features
    now: Features
    camera: Camera

    def __call__(self, R: F64, t: F64, radius_px: float, plane_m: float) -> Tracks:
        """Match near the prediction by `p_current = R p_previous + t`: points and lines within `radius_px`, planes within `plane_m`."""
        options, walls, seen, found = self.options, self.before.planes, self.now.planes, self._now
        motion = constant(R, np.float64), constant(t, np.float64)
        pixels, ends, planes, samples = predict_features(self._before, walls.coefficients, walls.samples_m, self._camera, *motion)
        (words, line_words), (words_now, line_words_now) = self._words
        compared, limit, lines_compared = self._comparison
        sine, cosine = float(np.sin(np.radians(options.line_deg))), float(np.cos(np.radians(options.plane_deg)))
        points = near_matches(
            pixels, *words, self.before.keypoints.octaves, found.pixels, *words_now, self.now.keypoints.octaves,
            np.full(len(pixels), radius_px, np.float32), options.octave_step, compared, limit, options.ratio,
        )  # fmt: skip
        lines = line_matches(
            ends, line_words, found.endpoints_px, line_words_now,
            sine, float(radius_px), options.line_overlap, lines_compared, float(options.line_bits), options.ratio,
        )  # fmt: skip
        same = associate_planes_kernel(seen.coefficients, seen.samples_m, planes, samples, cosine, plane_m, True)
        return tracks_value(self.now, self.before, (pairs_of_matches(points), pairs_of_matches(lines), np.ascontiguousarray(same[:, ::-1])), R)

    def motion(self, tracks: Tracks) -> Motion:
        """Return the motion that most of the pairs agree on."""
        now = self.now
        return solve_motion(self.options, self.camera, tracks, now.keypoints, now.segments, now.planes, tracks.index - tracks.previous_index)

    def consistent(self, tracks: Tracks, motion: Motion) -> Tracks:
        """Reject the key points and lines farther than `error_px` σ from their prediction by the motion, and key points without depth in both."""
        R, t = constant(motion.R, np.float64), constant(motion.t, np.float64)
        unsure_px = float(self.camera.fx * np.sqrt(eigvalsh(motion.covariance[3:, 3:])[-1]))
        features = tracks.keypoints, tracks.segments, self._before, self._now
        points, lines = consistent_pairs(*features, self._camera, R, t, unsure_px, self.options.error_px)
        return tracks_value(self.now, self.before, (points, lines, tracks.planes), motion.R)

    @cached_property
    def _camera(self) -> Intrinsics:
        return float(self.camera.fx), float(self.camera.fy), float(self.camera.cx), float(self.camera.cy)

    @cached_property
    def _before(self) -> FeaturePositions:
        return _positions(self.before)

    @cached_property
    def _now(self) -> FeaturePositions:
        return _positions(self.now)

    @cached_property
    def _comparison(self) -> tuple[int, float, int]:
        """Kinds of comparison of the descriptors of points, with their largest distance, and of lines; see `compared_by`."""
        before, now, options = self.before, self.now, self.options
        limit = options.max_bits if now.keypoints.metric == "hamming" else options.max_l2
        points = compared_by(before.keypoints.descriptors, now.keypoints.descriptors, limit, now.keypoints.metric)
        return points, float(limit), compared_by(before.segments.descriptors, now.segments.descriptors, options.line_bits, "hamming")

    @cached_property
    def _words(self) -> tuple[tuple[tuple[U64, U8], U64], tuple[tuple[U64, U8], U64]]:
        """Descriptors of both frames: of points as words and bytes, of lines as words."""
        before, now = ((words_of(of.keypoints.descriptors), words_of(of.segments.descriptors)[0]) for of in (self.before, self.now))
        return before, now


def _positions(features: Features) -> FeaturePositions:
    points, lines = features.keypoints, features.segments
    return FeaturePositions(points.pixels, points.points_m, points.sigma_px, lines.endpoints_px, lines.endpoints_m)
