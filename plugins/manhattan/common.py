"""Functions of all estimators that end with the modes of the sphere: their options, and the way from modes to a Manhattan frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share, check_increasing
from trihedron.pipeline.core.types import F32, F64, I32, Bool, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.common_kernels import (
    NOTHING_KNOWN,
    FitOptions,
    ModeLimits,
    fitted,
    followed,
    gathered,
    judged,
    measured_kernel,
    orthonormal,
    peaks_kernel,
    perpendicular,
    surfaces_kernel,
)
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE


@dataclass(frozen=True)
class ModeOptions:
    """Options of the plugins that gather directions, find their modes and fit a rotation to what stands on these."""

    cone_deg: Annotated[float, Range(1, 30)] = 12.0  # half-angle of the cone gathered around each axis, 10–15 in MVO, OPVO and LPVO
    bandwidth_deg: Annotated[float, Range(0.1, 30)] = 4.0  # of the Gaussian kernel
    max_iterations: PositiveInt = 20
    tolerance_deg: PositiveFloat = 1e-3
    samples: Annotated[int, Range(10)] = 3000  # most normals used
    use_normals: bool = True
    use_lines: bool = True
    use_planes: bool = True
    line_weight_per_px: NonNegativeFloat = 0.1  # a line weighs like this many normals per pixel of its length
    min_share: Share = 0.05  # of all normals that an axis must gather, MVO: 1/20
    min_lines: PositiveInt = 4  # or this many lines,
    min_line_share: Share = 0.15  # with this share of the lines' length
    max_width: Share = 0.44  # cones, standard deviation of a mode; 0.5 and 0.58 are the directions' without order, in space and in a plane
    min_explained: Share = 0.3  # share of all directions on the axes; directions without order have 0.07
    max_skew_deg: PositiveFloat = 3.0  # two modes further from a right angle do not belong to one Manhattan frame
    normals_floor_deg: PositiveFloat = 0.5  # error of an axis however many normals it has
    plane_floor_deg: PositiveFloat = 0.3  # a wall's deviation from the axis
    line_floor_deg: PositiveFloat = 0.5  # an edge's
    floor_deg: PositiveFloat = 0.05  # of the whole rotation
    gate: PositiveFloat = 2.0  # σ at which a plane or line counts half

    def __post_init__(self) -> None:
        check_increasing(self, "bandwidth_deg", "cone_deg")
        if not (self.use_normals or self.use_lines):
            raise ValueError("use_normals, use_lines: at least one must be true")

    @cached_property
    def finder(self) -> ModeFinder:
        """Mean shift with these options."""
        return ModeFinder(
            np.radians(self.cone_deg),
            np.radians(self.bandwidth_deg),
            self.max_iterations,
            np.radians(self.tolerance_deg),
            self.min_share,
            self.min_lines,
            self.min_line_share,
            self.max_width,
            self.min_explained,
            np.radians(self.max_skew_deg),
            self.use_planes,
        )

    @cached_property
    def fit(self) -> AxisFit:
        """The fit of a rotation with these options."""
        return AxisFit(
            self.cone_deg,
            self.normals_floor_deg,
            self.plane_floor_deg,
            self.line_floor_deg,
            self.floor_deg,
            self.gate,
            self.use_planes,
            self.use_lines,
        )


def directions_of(options: ModeOptions, normals: Normals, segments: Segments) -> Directions:
    """Directions of the normals and lines that the options include."""
    surface, lines = normals.normals if options.use_normals else None, segments if options.use_lines else None
    return gather_directions(surface, lines, options.samples, options.line_weight_per_px)


def fit_modes(options: ModeOptions, modes: Modes, segments: Segments, planes: Planes) -> tuple[F64, F64]:
    """The rotation fitted to planes, lines and the modes of the normals near its axes, and the covariance of phi (3, 3)."""
    weights = np.where(modes.seen, modes.weights, 1e-6)
    R = orthonormal(modes.axes, weights / weights.max())
    taking_part = modes.seen | modes.supported
    R, covariance = options.fit(R, modes.axes, modes.normals, taking_part, segments, planes)
    known = modes.supported or modes.seen.sum() < 2
    return R, covariance if known else np.eye(3) * NOTHING_KNOWN


def one_frame(modes: Modes, R: F64, covariance: F64, normals: Normals, gap: float = float("nan")) -> ManhattanFrame:
    """The one rotation R (3, 3) with id 0, and what its modes say of it."""
    counts = (modes.normals[:, 0] + modes.lines[:, 0]).astype(np.int32)
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=R[None],
        ids=np.zeros(1, np.int32),
        covariance=covariance[None],
        inliers=counts[None],
        spread=np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)[None],
        supported=modes.supported,
        gap=gap,
    )


NO_NORMALS, NO_LINES_M, NO_LINES_PX = (np.zeros(shape, np.float32) for shape in ((0, 0, 3), (0, 2, 3), (0, 2, 2)))


def gather_directions(normals: F32 | None, segments: Segments | None, samples: int, line_weight_per_px: float) -> Directions:
    """At most `samples` of a grid of normals (h, w, 3), each of weight 1, and the directions of the 3D lines, weighted by their image length."""
    grid = NO_NORMALS if normals is None else normals
    ends_m, ends_px = (NO_LINES_M, NO_LINES_PX) if segments is None else (segments.endpoints_m, segments.endpoints_px)
    return Directions(*gathered(grid, ends_m, ends_px, samples, line_weight_per_px))


@dataclass(frozen=True)
class AxisFit:
    """Fits a rotation to the planes and lines near its axes by their covariances, the mean of the normals on an axis counting like one more plane."""

    cone_deg: float = 12.0  # half-angle about the axes within which planes and lines take part
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    floor_deg: float = 0.05  # of the whole rotation
    gate: float = 2.0  # σ at which a plane or line counts half
    use_planes: bool = True
    use_lines: bool = True

    def __call__(self, R: F64, axes: F64, normals: F64, taking_part: Bool, segments: Segments, planes: Planes) -> tuple[F64, F64]:
        """The rotation fitted from R (3, 3), and the covariance of phi (3, 3).

        `axes` (3, 3) are the means of the normals on each axis, `normals` (3, 4) their statistics about these (`mode_statistics`); only the axes
        `taking_part` (3,) are fitted."""
        features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
        return fitted(R, axes, normals, taking_part, *features, self._rules, self.gate, float(np.radians(self.floor_deg)))

    def measured(self, R: F64, axes: F64, normals: F64, segments: Segments, planes: Planes) -> tuple[F64, F64, I32]:
        """Directions (n, 3) of planes, lines and the means of the normals, their information (n, 3, 3) and the column of R (3, m) that each
        belongs to (-1: none). `axes` (3, m) and `normals` (m, 4) as above."""
        features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
        return measured_kernel(R, axes, normals, *features, self._rules)

    @cached_property
    def _rules(self) -> FitOptions:
        angles = self.cone_deg, self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg
        cone, normals, planes, lines = (float(np.radians(angle)) for angle in angles)
        return FitOptions(cone, normals, planes, lines, self.use_planes, self.use_lines)


def _half_sphere(count: int) -> F64:
    k = np.arange(count) + 0.5
    z, turn = 1.0 - k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions.flags.writeable = False
    return directions


HALF_SPHERE = _half_sphere(256)  # (256, 3) directions about 9° apart over half the sphere (Fibonacci)


# Results of an estimator of several frames: of those it sees, and of those it knows but does not see.


def lost_frames(modes: Modes, fit: AxisFit, segments: Segments, planes: Planes, normals: Normals, known: F64, ids: I32) -> ManhattanFrame:
    """Manhattan frames that are not supported: a single axis of the first still rotates all that are known (k, 3, 3), and measures two of its three
    angles."""
    R, covariance = known[0], np.eye(3) * NOTHING_KNOWN
    if modes.seen.sum() == 1:
        turned = orthonormal(modes.axes, np.where(modes.seen, 1.0, 1e-6))
        R, covariance = fit(turned, modes.axes, modes.normals, modes.seen, segments, planes)
    count, spread = len(known), np.full((len(known), 3), np.nan)
    spread[0] = mode_spread(modes)
    inliers = np.zeros((count, 3), np.int32)
    inliers[0] = np.where(modes.seen, modes.normals[:, 0] + modes.lines[:, 0], 0)
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=matmul(R, known[0].T, known),
        ids=ids,
        covariance=np.concatenate([covariance[None], np.tile(np.eye(3) * NOTHING_KNOWN, (count - 1, 1, 1))]),
        inliers=inliers,
        spread=spread,
        supported=False,
    )


def seen_frames(
    normals: Normals, rotations: F64, covariance: F64, inliers: F64, spread: F64, rows: I32, ids: I32, unseen: I32, expected: F64
) -> ManhattanFrame:
    """The frames seen, (k, 3, 3) with their covariances, inliers (k, 3) and spread (k, 3), then those out of sight, where they are `expected`
    (u, 3, 3): without inliers, with an uninformative covariance.

    `rows` (k,) and `unseen` (u,) say which of the known frames, with `ids`, they are; -1 is a new one and gets a number of its own."""
    nothing = np.zeros((len(unseen), 3))
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=np.concatenate([rotations, expected.reshape(-1, 3, 3)]),
        ids=np.concatenate([np.where(rows >= 0, ids[rows], ids.max() + np.cumsum(rows < 0)), ids[unseen]]).astype(np.int32),
        covariance=np.concatenate([covariance, np.tile(np.eye(3) * NOTHING_KNOWN, (len(unseen), 1, 1))]),
        inliers=np.concatenate([inliers, nothing]).astype(np.int32),
        spread=np.concatenate([spread, nothing * np.nan]),
        supported=True,
    )


def mode_spread(modes: Modes) -> F64:
    """(3,) rad; NaN of axes that are not seen."""
    return np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)


# When three modes of the sphere are a Manhattan frame, and when they are not.

NO_PLANES = np.zeros((0, 5))


class Directions(NamedTuple):
    """Unit directions (n, 3) with weights (n,): normals first, lines from row `first_line`."""

    vectors: F64
    weights: F64
    first_line: int

    def thinned(self, most: int) -> Directions:
        """Keep about `most` of the normals at most, with larger weights, and all lines."""
        step = max(-(-self.first_line // most), 1)
        normals, lines = self.vectors[: self.first_line : step], self.vectors[self.first_line :]
        weights = np.concatenate([step * self.weights[: self.first_line : step], self.weights[self.first_line :]])
        return Directions(np.concatenate([normals, lines]), weights, len(normals))


class Modes(NamedTuple):
    """Three modes of the sphere and what stands behind them."""

    axes: F64  # (3, 3) columns, unit, at right angles only as far as the scene is
    normals: F64  # (3, 4) statistics of the normals about them, see `mode_statistics`
    lines: F64  # (3, 4) of the line directions
    seen: Bool  # (3,) modes that are peaks, at right angles to each other
    supported: bool

    @property
    def weights(self) -> F64:
        """(3,) of the directions on each axis."""
        return self.normals[:, 1] + self.lines[:, 1]

    @property
    def mean_squares(self) -> F64:
        """(3,) squared angle (rad²) of the directions on each axis."""
        return np.asarray((self.normals[:, 1] * self.normals[:, 2] + self.lines[:, 1] * self.lines[:, 2]) / np.maximum(self.weights, 1e-9))


@dataclass(frozen=True)
class ModeFinder:
    """Mean shift and the rules of `mode_options.ModeOptions`, whose fields these are; angles in rad."""

    cone: float
    bandwidth: float
    max_iterations: int
    tolerance: float
    min_share: float
    min_lines: int
    min_line_share: float
    max_width: float
    min_explained: float
    max_skew: float
    use_planes: bool

    def follow(self, directions: Directions, planes: Planes, start: F64) -> Modes:
        """Mean shift from three starting axes (3, 3), and what it found; axes that are no modes stay where they started."""
        shift = (self.cone, self.bandwidth, self.max_iterations, self.tolerance)
        return Modes(*followed(*directions, np.array(start), shift, self._surfaces(planes), self._rules))

    def judged(self, modes: Modes, directions: Directions, planes: Planes | None) -> Modes:
        """The modes with those `seen` that are peaks at right angles, and whether these make a Manhattan frame; `planes` where they may take part."""
        seen, supported = judged(*directions, modes.axes, modes.normals, modes.lines, self._surfaces(planes), self._rules)
        return modes._replace(seen=seen, supported=supported)

    def peaks(self, modes: Modes, directions: Directions, planes: Planes | None) -> Bool:
        """(m,) whether a plane, enough normals or enough lines stand on each axis, the latter two denser than directions without order would."""
        return np.asarray(peaks_kernel(*directions, modes.axes, modes.normals, modes.lines, self._surfaces(planes), self._rules))

    def perpendicular(self, modes: Modes) -> Bool:
        """(m, m) whether two modes are at right angles, as far as their own uncertainty can tell."""
        return np.asarray(perpendicular(modes.axes, modes.normals, modes.lines, self.max_skew))

    def _surfaces(self, planes: Planes | None) -> F64:
        """(p, 5) of the planes that may take part, for `surface_peaks`: normal, cosine of the reach, share of the image. They reach half a cone, and
        as much further as they are uncertain, but no further than it."""
        if planes is None or not self.use_planes or len(planes.pixels) == 0:
            return NO_PLANES
        image = float(planes.labels.size * planes.stride**2)
        return np.asarray(surfaces_kernel(planes.coefficients, planes.covariance, planes.pixels, image, self.cone))

    @cached_property
    def _rules(self) -> ModeLimits:
        widest = (self.max_width * self.cone) ** 2
        return ModeLimits(self.cone, self.min_share, self.min_lines, self.min_line_share, widest, self.min_explained, self.max_skew)


# Which Manhattan frame is which from image to image.

FURTHEST = np.cos(np.radians(63.0))  # two frames are at most 62.8° apart under the nearest of their names


def symmetric_angles(found: F64, known: F64) -> F64:
    """(f, k) angles (rad) between rotations (f, 3, 3) and (k, 3, 3), each pair under the nearest of its 24 names."""
    between = np.einsum("fji,kjl->fkil", found, known)
    trace = np.einsum("fkij,nji->fkn", between, CUBE).max(axis=2)
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def identified(found: F64, expected: F64, limit: float) -> I32:
    """(f,) row of the expected frame (k, 3, 3) that each found one (f, 3, 3) is, -1 for none; nearest pairs first, none further than `limit` rad."""
    rows = np.full(len(found), -1, np.int32)
    angles = symmetric_angles(found, expected)
    while angles.size and angles.min() <= limit:
        f, k = np.unravel_index(int(np.argmin(angles)), angles.shape)
        rows[f] = k
        angles[f], angles[:, k] = np.inf, np.inf
    return rows


def turn_between(found: F64, before: F64, limit: float) -> F64:
    """(3, 3) turn Q of the camera after which most of the frames `before` (k, 3, 3) are found (f, 3, 3) again within `limit` rad, the smallest of
    these turns: frames keep their angles to each other when the camera jumps. The identity when there are none."""
    best, turn = (0, -1.0), np.eye(3)
    for one in found:
        for known in before:
            for name in CUBE:
                Q = matmul(one, name, known.T)
                cosine = 0.5 * (np.trace(Q) - 1.0)
                if cosine < FURTHEST:  # some name is nearer
                    continue
                rank = (int((identified(found, matmul(Q, before), limit) >= 0).sum()), cosine)
                if rank > best:
                    best, turn = rank, Q
    return turn


def missing(rows: I32, count: int) -> I32:
    """Rows of `count` that are not among `rows`."""
    left = np.ones(count, np.bool_)
    left[rows[rows >= 0]] = False
    return np.flatnonzero(left).astype(np.int32)


def remembered(unseen: I32, ids: I32, room: int) -> I32:
    """Rows of frames out of sight for which there is room: seen last, and the one with the highest id, so that no id is given twice."""
    if len(unseen) <= max(room, 0):
        return unseen
    newest = unseen[ids[unseen] == ids.max()]
    return np.sort(np.concatenate([unseen[ids[unseen] != ids.max()][: max(room - len(newest), 0)], newest]))
