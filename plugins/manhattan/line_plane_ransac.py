"""The Manhattan frame from a single line and a single plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, PositiveShare, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Bool, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.axis_fit import fit_axes, fit_rules
from trihedron.plugins.manhattan.directions import gather_directions
from trihedron.plugins.shared.manhattan_frames_kernels import assign_axes, best_frame, frames_through, inliers_and_spread, procrustes, square_angles


@register("manhattan", "line_plane_ransac")
@dataclass(frozen=True)
class LinePlaneRansac:
    """RANSAC over the least that fixes a Manhattan frame: a plane and a line on it, two planes, or two lines (Kim, Coltin and Kim, "Indoor RGB-D
    Compass from a Single Line and Plane", CVPR 2018).

    The plane's normal n is one axis; the second is where the line's interpretation plane, of normal m, meets the wall: `v = m × n`, which takes
    the line's bearing and not its noisy depth; the third is `n × v`. Hypotheses are scored over all planes, lines and normals, and the best is
    fitted to its inliers by their covariances."""

    hypotheses: PositiveInt = 100  # drawn; half of them right leaves no chance to miss
    reach_deg: Annotated[float, Range(0.5, 20)] = 5.0  # a plane or line this near to an axis belongs to it
    normals_reach_deg: Annotated[float, Range(0.5, 30)] = 12.0  # and a normal
    samples: NonNegativeInt = 300  # most normals scored
    min_share: PositiveShare = 0.05  # of the image that a plane must cover
    min_line_px: NonNegativeFloat = 20.0  # of lines that an axis must show beside a plane
    min_lines: Annotated[int, Range(2)] = 6  # on the axes when there is no plane
    max_line_share: Share = 0.6  # of the lines' length on the axes is always enough; with many lines, what chance does not give
    min_plane_share: Share = 0.4  # of the planes' area
    loyalty: Annotated[float, Range(1)] = 1.2  # a frame with other axes than the previous must score so many times more
    plane_floor_deg: PositiveFloat = 0.3  # a wall's deviation from the axis
    line_floor_deg: PositiveFloat = 0.5  # an edge's
    floor_deg: PositiveFloat = 0.05  # of the whole rotation
    gate: PositiveFloat = 2.0  # σ at which a plane or line counts half

    def __call__(
        self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None, rng: np.random.Generator
    ) -> ManhattanFrame:
        """One rotation with id 0; `inliers` counts planes and lines. `supported` is False where no plane has a line along it and lines are few or
        without order; a single plane still determines two of the three angles."""
        start = np.eye(3) if previous is None else previous.rotations[0]
        features, reach = _features(planes, segments), np.radians(self.reach_deg)
        R, seen, supported = self._consensus(features, normals, start, previous is not None and previous.supported, rng)
        rules = fit_rules(self, self.reach_deg, self.plane_floor_deg, self.gate)  # of normals, which take no part, the floor is that of planes
        R, covariance = fit_axes(rules, R, R, np.zeros((3, 4)), seen, segments, planes)
        axes = assign_axes(features.vectors, R, reach)
        axes[(axes >= 0) & ~seen[axes]] = -1
        inliers, spread = inliers_and_spread(square_angles(features.vectors, axes, R), axes, features.share)
        return ManhattanFrame.single(normals, R, covariance, inliers, spread, supported)

    def _consensus(self, features: Features, normals: Normals, start: F64, loyal: bool, rng: np.random.Generator) -> tuple[F64, Bool, bool]:
        """The frame with most on its axes, named as is nearest to `start`, the axes (3,) that are seen and whether that is enough. Without a frame
        `start`, turned to the wall when there is one."""
        frames = self._hypotheses(features, rng)
        if len(frames):
            surface = gather_directions(normals.normals, None, self.samples, 0.0).vectors
            vectors = np.concatenate([features.vectors, surface])
            reach = np.radians(np.repeat([self.reach_deg, self.normals_reach_deg], [len(features.vectors), len(surface)]))
            weights = np.concatenate([features.share, np.full(len(surface), 1.0 / max(len(surface), 1))])
            R = best_frame(frames, vectors, weights, reach, start, self.loyalty if loyal else 1.0)
            seen, supported = self._seen_axes(features, R)
            if supported:
                return R, seen, True
        walls = features.vectors[: features.planes][features.share[: features.planes] >= self.min_share]
        seen = np.zeros(3, np.bool_)
        if len(walls) != 1:
            return start, seen, False
        axis = assign_axes(walls, start, np.pi)
        seen[axis] = True
        return procrustes(walls, np.ones(1), axis, start, 1e-6), seen, False

    def _hypotheses(self, features: Features, rng: np.random.Generator) -> F64:
        """(m, 3, 3) rotations through drawn pairs of perpendicular features, each as likely as it is large, planes and lines half of the draws."""
        vectors, line = features.vectors, np.arange(len(features.vectors)) >= features.planes
        likely = features.share / np.where(line, max(features.share[line].sum(), 1e-12), max(features.share[~line].sum(), 1e-12))
        partners = np.cumsum(likely * (np.abs(matmul(vectors, vectors.T)) < np.sin(np.radians(self.reach_deg))), axis=1)
        total = np.cumsum(likely * (partners[:, -1] > 0.0)) if len(vectors) else np.zeros(1)
        if total[-1] <= 0.0:
            return np.zeros((0, 3, 3))
        u = rng.random((self.hypotheses, 2))
        i = np.searchsorted(total, u[:, 0] * total[-1], side="right")
        j = (partners[i] <= u[:, 1:] * partners[i, -1:]).sum(axis=1)
        i, j = np.minimum(i, j), np.maximum(i, j)  # the plane first
        second = vectors[j].copy()
        on_wall = line[j] & ~line[i]
        second[on_wall] = _on_wall(vectors[i[on_wall]], vectors[j[on_wall]], features.across[j[on_wall]], np.cos(np.radians(self.reach_deg)))
        return frames_through(vectors[i], second)

    def _seen_axes(self, features: Features, R: F64) -> tuple[Bool, bool]:
        """Return the axes (3,) with a plane or enough lines, and True if they make a Manhattan frame."""
        axes = assign_axes(features.vectors, R, np.radians(self.reach_deg)) + 1
        p, share = features.planes, features.share
        walls, lines = np.bincount(axes[:p], share[:p], 4)[1:], np.bincount(axes[p:], share[p:], 4)[1:]
        counts = np.bincount(axes[p:], minlength=4)[1:]
        # of lines drawn any way on one wall two axes gather four times their reach of 180°; the best of many hypotheses 4 sigma more
        chance = 4.0 * np.radians(self.reach_deg) / np.pi
        chance += 4.0 * np.sqrt(chance * (1.0 - chance) * (share[p:] ** 2).sum())
        ordered = lines.sum() >= min(chance, self.max_line_share)
        by_planes = walls >= self.min_share
        wanted = 1 if by_planes.any() else (self.min_lines + 1) // 2
        seen = by_planes | ((counts >= wanted) & (lines * features.length_px >= self.min_line_px) & ordered)
        return seen, bool(seen.sum() >= 2 and walls.sum() >= self.min_plane_share * share[:p].sum())


class Features(NamedTuple):
    """n directions: the normals of planes, then from row `planes` on those of 3D lines."""

    vectors: F64  # (n, 3)
    across: F64  # (n, 3) normals of the lines' interpretation planes
    share: F64  # (n,) of the image, and of the length of all lines
    planes: int
    length_px: float  # of all lines


def _features(planes: Planes, segments: Segments) -> Features:
    """The planes and lines whose directions are known."""
    good = np.isfinite(planes.coefficients).all(axis=1) & (planes.pixels > 0)
    area = planes.pixels[good] / max(planes.labels.size * planes.stride**2, 1)
    finite = np.isfinite(segments.endpoints_m).all(axis=(1, 2)) & np.isfinite(segments.endpoints_px).all(axis=(1, 2))
    start, end = np.moveaxis(segments.endpoints_m[finite].astype(np.float64), 1, 0)
    begin_px, end_px = np.moveaxis(segments.endpoints_px[finite].astype(np.float64), 1, 0)
    length, pixels = np.linalg.norm(end - start, axis=1), np.linalg.norm(end_px - begin_px, axis=1)
    solid = (length > 1e-6) & (pixels > 0.0)
    start, end, total = start[solid], end[solid], float(pixels[solid].sum())
    across = np.cross(start, end)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = (end - start) / length[solid, None]
    normals = planes.coefficients[good, :3]
    return Features(
        np.concatenate([normals, along]), np.concatenate([normals, across]), np.concatenate([area, pixels[solid] / total]), len(normals), total
    )


def _on_wall(normals: F64, along: F64, across: F64, agreement: float) -> F64:
    """(m, 3) `m × n`: directions on walls with `normals` of lines with interpretation planes `across`; the line's own direction `along` where the
    two are further apart than `agreement` (cosine), as when the camera looks along the wall."""
    met = np.cross(across, normals)
    met /= np.maximum(np.linalg.norm(met, axis=1, keepdims=True), 1e-12)
    return np.where(np.abs(np.einsum("ij,ij->i", met, along))[:, None] > agreement, met, along)
