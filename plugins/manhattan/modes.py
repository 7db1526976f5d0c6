"""Modes of directions on the unit sphere, their verification, and the Manhattan frame fitted to three of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol

import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share, check_increasing
from trihedron.pipeline.core.types import F64, Bool, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.axis_fit import fit_axes, fit_rules
from trihedron.plugins.manhattan.axis_fit_kernels import NOTHING_KNOWN, orthonormal
from trihedron.plugins.manhattan.directions import Directions, gather_directions
from trihedron.plugins.manhattan.mean_shift_kernels import ShiftLimits, track_modes_kernel
from trihedron.plugins.manhattan.mode_verification_kernels import (
    ModeLimits,
    find_peaks_kernel,
    perpendicular,
    surfaces_of_planes,
    verify_modes_kernel,
)

NO_PLANES = np.zeros((0, 5))


class Modes(NamedTuple):
    """Modes of directions on the sphere, with the statistics of the directions that belong to each."""

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


def mode_spread(modes: Modes) -> F64:
    """Return the standard deviation (3,) in rad of the directions about each axis; NaN of axes that are not seen."""
    return np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)


class ModeRules(Protocol):
    """Options of every plugin that seeks modes by mean shift."""

    @property
    def cone_deg(self) -> float:
        """Half-angle of the cone about an axis whose directions belong to it."""

    @property
    def bandwidth_deg(self) -> float:
        """Standard deviation of the Gaussian kernel."""

    @property
    def max_iterations(self) -> int:
        """Most iterations of mean shift."""

    @property
    def tolerance_deg(self) -> float:
        """Step of an axis below which mean shift has converged."""

    @property
    def use_planes(self) -> bool:
        """True if planes may verify a mode."""

    @property
    def min_share(self) -> float:
        """Share of all normals that an axis must gather."""

    @property
    def min_lines(self) -> int:
        """Number of lines that an axis without normals must gather."""

    @property
    def min_line_share(self) -> float:
        """Share of the lines' length that these must have."""

    @property
    def max_width(self) -> float:
        """Largest standard deviation of a mode, in cones."""

    @property
    def min_explained(self) -> float:
        """Share of all directions on the axes."""

    @property
    def max_skew_deg(self) -> float:
        """Largest deviation of two modes from a right angle."""


def mode_limits(rules: ModeRules) -> ModeLimits:
    """Convert the options of the verification to rad."""
    cone = np.radians(rules.cone_deg)
    widest = (rules.max_width * cone) ** 2
    return ModeLimits(cone, rules.min_share, rules.min_lines, rules.min_line_share, widest, rules.min_explained, np.radians(rules.max_skew_deg))


def shift_limits(rules: ModeRules) -> ShiftLimits:
    """Convert the options of mean shift to rad."""
    return ShiftLimits(np.radians(rules.cone_deg), np.radians(rules.bandwidth_deg), rules.max_iterations, np.radians(rules.tolerance_deg))


def track_modes(rules: ModeRules, directions: Directions, planes: Planes, start: F64) -> Modes:
    """Return the modes that mean shift reaches from three axes `start` (3, 3), verified; axes that are no modes stay where they started."""
    limits, used = mode_limits(rules), planes if rules.use_planes else None
    return Modes(*track_modes_kernel(*directions, np.array(start), shift_limits(rules), _surfaces(used, limits), limits))


def verify_modes(limits: ModeLimits, modes: Modes, directions: Directions, planes: Planes | None) -> Modes:
    """Return the modes with those `seen` that are peaks at right angles, and `supported` if these make a Manhattan frame."""
    seen, supported = verify_modes_kernel(*directions, modes.axes, modes.normals, modes.lines, _surfaces(planes, limits), limits)
    return modes._replace(seen=seen, supported=supported)


def find_peaks(limits: ModeLimits, modes: Modes, directions: Directions, planes: Planes | None) -> Bool:
    """Return True (m,) for each axis with a plane, enough normals or enough lines, the latter two denser than unordered directions would be."""
    return np.asarray(find_peaks_kernel(*directions, modes.axes, modes.normals, modes.lines, _surfaces(planes, limits), limits))


def perpendicular_modes(limits: ModeLimits, modes: Modes) -> Bool:
    """Return True (m, m) for each pair of modes at right angles, as far as their own uncertainty can tell."""
    return np.asarray(perpendicular(modes.axes, modes.normals, modes.lines, limits.max_skew))


def _surfaces(planes: Planes | None, limits: ModeLimits) -> F64:
    if planes is None or len(planes.pixels) == 0:
        return NO_PLANES
    image = float(planes.labels.size * planes.stride**2)
    return np.asarray(surfaces_of_planes(planes.coefficients, planes.covariance, planes.pixels, image, limits.cone))


@dataclass(frozen=True)
class ModeOptions:
    """Options of the plugins that gather directions, find three modes of them and fit a rotation to what lies on these."""

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


def directions_of(options: ModeOptions, normals: Normals, segments: Segments) -> Directions:
    """Gather the directions of the normals and lines that the options include."""
    surface, lines = normals.normals if options.use_normals else None, segments if options.use_lines else None
    return gather_directions(surface, lines, options.samples, options.line_weight_per_px)


def fit_modes(options: ModeOptions, modes: Modes, segments: Segments, planes: Planes) -> tuple[F64, F64]:
    """Fit a rotation to planes, lines and the modes of the normals near its axes; return it with the covariance of phi (3, 3)."""
    weights = np.where(modes.seen, modes.weights, 1e-6)
    R = orthonormal(modes.axes, weights / weights.max())
    taking_part = modes.seen | modes.supported
    rules = fit_rules(options, options.cone_deg, options.normals_floor_deg, options.gate, options.use_planes, options.use_lines)
    R, covariance = fit_axes(rules, R, modes.axes, modes.normals, taking_part, segments, planes)
    known = modes.supported or modes.seen.sum() < 2
    return R, covariance if known else np.eye(3) * NOTHING_KNOWN


def one_frame(modes: Modes, R: F64, covariance: F64, normals: Normals, gap: float = float("nan")) -> ManhattanFrame:
    """Convert the rotation R (3, 3) of three modes to the slot's value, with id 0."""
    counts = (modes.normals[:, 0] + modes.lines[:, 0]).astype(np.int32)
    return ManhattanFrame.single(normals, R, covariance, counts, mode_spread(modes), modes.supported, gap)
