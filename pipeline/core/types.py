"""The values that travel between stages.

Conventions. Camera frame: x right, y down, z forward, metres. Pixel centres at integers. Depth in metres, 0 = none.
`T_a_b` maps points of frame b into frame a: `p_a = T_a_b @ p_b`; `R_a_b`, `t_a_b` likewise. A plane is `n·x + d = 0` with `|n| = 1`;
in the camera frame `d >= 0`, so n points towards the camera. Angles are radians unless the name ends in `_deg`.
A pose covariance is that of `xi = (rho, phi)` in `T_world_camera = T_estimate · Exp(xi)` (camera frame, translation first),
in the map about it: relative to the keyframe that the pose names; how far that has drifted from the first frame is not in it.

Every value is a frozen dataclass with `index` (frame number in the data set) and `stamp_ns`. Array fields declare element type and shape
with `Shape`; a letter stands for a length that is the same wherever the letter appears in one value. They are checked, in O(1), when the
value is constructed, and the arrays become read-only.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core import conversions
from trihedron.pipeline.core.arrays import F32, F64, I32, U8, Bool, Shape, Value
from trihedron.pipeline.core.constraints import Columns, CoversImage, Finite, IndexInto, OneOf, Rotations, SameWidth, UnitNormals, Within
from trihedron.pipeline.core.described import Described
from trihedron.pipeline.core.table import Column, Table

__all__ = [
    "DEGRADED",
    "EXACT_DEPTH",
    "F32",
    "F64",
    "I32",
    "LOST",
    "OK",
    "OPENING_KINDS",
    "PLANE_KINDS",
    "U8",
    "Bool",
    "Building",
    "Camera",
    "Column",
    "Correction",
    "DepthNoise",
    "Effort",
    "Frame",
    "FrameReference",
    "Keypoints",
    "LineSegments",
    "ManhattanFrame",
    "Map",
    "Matches",
    "Normals",
    "PlaceCorrection",
    "Planes",
    "Pose",
    "PredictedView",
    "Rotation",
    "Segments",
    "Shape",
    "Surface",
    "Table",
    "Tracks",
    "Trajectory",
    "Translation",
    "Value",
]  # fmt: skip


@dataclass(frozen=True)
class Frame(Value):
    """One registered colour and depth image: RGB and metres (0 = none)."""

    dense: ClassVar[bool] = True
    color: Annotated[U8, Shape("h", "w", 3)]
    depth_m: Annotated[F32, Shape("h", "w")]
    camera: Camera

    @cached_property
    def gray(self) -> U8:
        """Return the (h, w) luminance."""
        import cv2

        return np.asarray(cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


@dataclass(frozen=True)
class FrameReference(Value):
    """A stand-in for a frame in a recording that does not embed it (topic `frames`)."""

    camera: Camera


@dataclass(frozen=True)
class Effort(Value):
    """Number of the words of `budget_order`, from the first, that hold at a frame to keep the run's budget of time (topic `effort`)."""

    level: Annotated[int, Within(0, 100)]


@dataclass(frozen=True)
class Normals(Value):
    """Unit surface normals towards the camera on a grid: cell (r, c) belongs to pixel (x = c·stride, y = r·stride); NaN = none."""

    dense: ClassVar[bool] = True

    normals: Annotated[F32, Shape("h", "w", 3), CoversImage()]
    stride: Annotated[int, Within(1, 1024)]


@dataclass(frozen=True)
class Keypoints(Value):
    """Points of interest. `points_m` is the back-projection (camera frame), NaN without a trustworthy depth; `sigma_px` grows with the octave and
    includes `blur_px`, by which the whole image is blurred beyond a sharp one (standard deviation)."""

    pixels: Annotated[F32, Shape("n", 2), Finite()]
    points_m: Annotated[F32, Shape("n", 3)]
    sigma_px: Annotated[F32, Shape("n")]
    sigma_m: Annotated[F32, Shape("n")]  # of the depth, NaN where points_m is
    octaves: Annotated[U8, Shape("n")]
    angles_deg: Annotated[F32, Shape("n")]
    descriptors: Annotated[U8, Shape("n", "b"), SameWidth(("previous_keypoints.descriptors", "map.points.descriptor"))]
    metric: Annotated[str, OneOf(("hamming", "l2"))] = "hamming"  # distance between descriptors: hamming | l2
    blur_px: Annotated[float, Within(0.0, 1e3)] = 0.0

    def to_numpy(self) -> F32:
        """Return the (k, 3) points that have depth, camera frame."""
        return self.points_m[np.isfinite(self.points_m).all(axis=1)]

    def to_open3d(self) -> Any:
        """Return the points that have depth as an `open3d.geometry.PointCloud`.

        Raises:
            LibraryError: Open3D is not installed, or does not load.
        """
        return conversions.points_to_open3d(self.to_numpy())

    def to_trimesh(self) -> Any:
        """Return the points that have depth as a `trimesh.PointCloud`."""
        return conversions.points_to_trimesh(self.to_numpy())


@dataclass(frozen=True)
class LineSegments(Value):
    """Straight edges of the image: end points (start, end) × (x, y), and binary descriptors."""

    endpoints_px: Annotated[F32, Shape("n", 2, 2), Finite()]
    descriptors: Annotated[U8, Shape("n", "b")]


@dataclass(frozen=True)
class Segments(Value):
    """The image's line segments lifted to 3D. `endpoints_m` are the extreme inliers along the fitted line, in the order of `endpoints_px`
    (camera frame); NaN where depth supports no line. `covariance_m2` is that of each 3D end point."""

    endpoints_px: Annotated[F32, Shape("n", 2, 2), Finite()]
    endpoints_m: Annotated[F32, Shape("n", 2, 3)]
    covariance_m2: Annotated[F32, Shape("n", 2, 3, 3)]
    descriptors: Annotated[U8, Shape("n", "b"), SameWidth(("previous_segments.descriptors", "map.lines.descriptor"))]


@dataclass(frozen=True)
class Planes(Value):
    """Planar regions, largest first. `covariance` is that of (a, b, d): the normal's tangent coordinates in `geometry.tangent_basis(n)` and d.
    `moments` is `Σ w [x;1][x;1]ᵀ` over the region's points with `w = 1/σ_z²`. `samples_m` spreads points over the region (NaN-padded), for overlap.
    `labels` is on the grid of the normals: 0 = none, i + 1 = plane i."""

    coefficients: Annotated[F64, Shape("n", 4), UnitNormals()]  # (n, d), d >= 0
    covariance: Annotated[F64, Shape("n", 3, 3), Finite()]
    moments: Annotated[F64, Shape("n", 4, 4), Finite()]
    pixels: Annotated[I32, Shape("n"), Within(0, 2**31)]  # image pixels covered
    samples_m: Annotated[F32, Shape("n", "s", 3)]
    labels: Annotated[U8, Shape("h", "w"), IndexInto(".coefficients+"), CoversImage()]
    stride: Annotated[int, Within(1, 1024)]

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """Return `coefficients` (n, 4), `points_m` (k, 3) spread over the planes, camera frame, and the `plane` (k,) of each."""
        finite = np.isfinite(self.samples_m[:, :, 0])
        return {"coefficients": self.coefficients, "points_m": self.samples_m[finite], "plane": np.nonzero(finite)[0].astype(np.int32)}

    def to_open3d(self) -> Any:
        """Return `points_m` of `to_numpy` as an `open3d.geometry.PointCloud`, a colour for each plane.

        Raises:
            LibraryError: Open3D is not installed, or does not load.
        """
        arrays = self.to_numpy()
        return conversions.points_to_open3d(arrays["points_m"], conversions.color_of_rows(arrays["plane"]))

    def to_trimesh(self) -> Any:
        """Return `points_m` of `to_numpy` as a `trimesh.PointCloud`, a colour for each plane."""
        arrays = self.to_numpy()
        return conversions.points_to_trimesh(arrays["points_m"], conversions.color_of_rows(arrays["plane"]))


@dataclass(frozen=True)
class ManhattanFrame(Value):
    """Orthogonal directions of the scene: k rotations `R_camera_manhattan` whose columns are the axes seen from the camera.

    `supported` is False where the scene shows no Manhattan frame; `ids` name the frames across time. `covariance` is that of the small
    rotation phi in `R = Exp(phi) R_estimate` (camera frame, rad²); `inliers` and `spread` (rad, NaN = axis not seen) are per axis;
    `gap` is the relative distance to a certified optimum (NaN without certificate)."""

    rotations: Annotated[F64, Shape("k", 3, 3), Rotations()]
    ids: Annotated[I32, Shape("k")]
    covariance: Annotated[F64, Shape("k", 3, 3), Finite()]
    inliers: Annotated[I32, Shape("k", 3)]
    spread: Annotated[F64, Shape("k", 3)]
    supported: bool
    gap: float = float("nan")

    @staticmethod
    def single(seen: Value, R: F64, covariance: F64, inliers: I32, spread: F64, supported: bool, gap: float = float("nan")) -> ManhattanFrame:
        """Return one Manhattan frame with the id 0.

        Args:
            seen: the value that it was seen in, which gives number and time.
            R: (3, 3) `R_camera_manhattan`.
            covariance: (3, 3), rad².
            inliers: (3,) per axis.
            spread: (3,) per axis, rad; NaN = not seen.
            supported: False where the scene shows no Manhattan frame.
            gap: relative distance to a certified optimum; NaN without a certificate.

        Returns:
            The value, with one row in each array.
        """
        ids = np.zeros(1, np.int32)
        return ManhattanFrame(seen.index, seen.stamp_ns, R[None], ids, covariance[None], inliers[None], spread[None], supported, gap)


@dataclass(frozen=True)
class Tracks(Value):
    """Features of this frame found in the previous one. Pairs are rows (previous, current).

    The previous geometry is copied, in the previous camera frame, so that motion can be solved from Tracks and the current features alone. Of a
    previous frame without any depth it is that of the frame before, moved as its features moved.
    `R_current_previous` is the rotation that predicted the search, corrected by the pairs found. `repeated` is the share of the pairs of key points
    whose pixel and descriptor are bit-identical in both images: hardly any, but most of them where colour repeats, wholly or in part."""

    version: ClassVar[int] = 2

    previous_index: int
    keypoints: Annotated[I32, Shape("n", 2), IndexInto("previous_keypoints", "keypoints")]
    points_m: Annotated[F32, Shape("n", 3)]  # previous; NaN without depth
    sigma_m: Annotated[F32, Shape("n")]  # of their depth
    segments: Annotated[I32, Shape("m", 2), IndexInto("previous_segments", "segments")]
    endpoints_m: Annotated[F32, Shape("m", 2, 3)]  # previous; NaN without depth
    planes: Annotated[I32, Shape("p", 2), IndexInto("previous_planes", "planes")]
    coefficients: Annotated[F64, Shape("p", 4), UnitNormals()]  # previous
    plane_covariance: Annotated[F64, Shape("p", 3, 3)]
    R_current_previous: Annotated[F64, Shape(3, 3), Rotations()]
    repeated: Annotated[float, Within(0.0, 1.0)] = 0.0


@dataclass(frozen=True)
class Rotation(Value):
    """The camera's rotation and the world–Manhattan rotations that it is estimated from. `source` is manhattan | tracks | prediction.

    `covariance` is that of phi in `R_world_camera = R_estimate · Exp(phi)` (camera frame, rad²); `R_world_manhattan[i]` belongs to Manhattan frame
    `ids[i]`, with `weights[i]` observations behind it, and `R_camera_manhattan[i]` is this frame's observation of it (NaN = not seen)."""

    R_world_camera: Annotated[F64, Shape(3, 3), Rotations()]
    covariance: Annotated[F64, Shape(3, 3), Finite()]
    R_world_manhattan: Annotated[F64, Shape("k", 3, 3), Rotations()]
    R_camera_manhattan: Annotated[F64, Shape("k", 3, 3), Rotations(or_none=True)]
    ids: Annotated[I32, Shape("k")]
    weights: Annotated[F64, Shape("k")]
    source: Annotated[str, OneOf(("manhattan", "tracks", "prediction"))]


@dataclass(frozen=True)
class Translation(Value):
    """The camera's position for the given rotation. `unobservable` holds unit vectors (world) along which the prediction was retained;
    `inliers` counts points, lines and planes; `estimated` is False when no measurement of this frame took part. Covariance in the world frame, m².
    A filter's state: planes (n, d) of the world, and the joint covariance of (t_world_camera, d of each)."""

    version: ClassVar[int] = 2

    t_world_camera: Annotated[F64, Shape(3), Finite()]
    covariance: Annotated[F64, Shape(3, 3), Finite()]
    unobservable: Annotated[F64, Shape("u", 3)]
    inliers: Annotated[I32, Shape(3)]
    estimated: bool
    filtered_planes: Annotated[F64, Shape("m", 4)] = field(default_factory=lambda: np.empty((0, 4)))
    filtered_covariance: Annotated[F64, Shape("s", "s")] = field(default_factory=lambda: np.empty((0, 0)))  # s = 3 + m, m²


@dataclass(frozen=True)
class Matches(Value):
    """This frame's features found in the map: pairs (row of the feature, id of the landmark). `parallel` and `perpendicular` pair plane rows
    with map planes that are not the same plane. `visible_*` are the landmarks that were expected in view, found or not."""

    map_revision: int
    keypoints: Annotated[I32, Shape("n", 2), IndexInto("keypoints", "map.points")]
    segments: Annotated[I32, Shape("m", 2), IndexInto("segments", "map.lines")]
    planes: Annotated[I32, Shape("p", 2), IndexInto("planes", "map.planes")]
    parallel: Annotated[I32, Shape("a", 2), IndexInto("planes", "map.planes")]
    perpendicular: Annotated[I32, Shape("b", 2), IndexInto("planes", "map.planes")]
    visible_points: Annotated[I32, Shape("v"), IndexInto("map.points")]
    visible_lines: Annotated[I32, Shape("w"), IndexInto("map.lines")]


OK, DEGRADED, LOST = "ok", "degraded", "lost"


CALIBRATION = 12  # parameters of a camera's calibration whose errors a pose's covariance counts
USUAL_TURN_DIFFERENCE = np.pi / 600.0  # 0.3°: what planes turn by more or less than the camera from frame to frame, before that is measured


@dataclass(frozen=True)
class Pose(Value):
    """The camera's pose. A frame counts as tracked only with status ok or degraded, which need measurements of that very frame.

    `reference` is the keyframe the pose is expressed against (-1: none yet) and `T_reference_camera` the pose relative to it. `inliers` counts
    points, lines and planes; `unobservable` the directions held at the prediction. `submap` is the part of the map whose world the pose is in (0: the
    first; others have a world of their own until they are merged), `unrecognised` the number of frames of a lost camera without relocalisation.

    `covariance` is that of the pose in the world: `noise_scale` times the covariance relative to the landmarks near it, plus `map_covariance`, that
    of these landmarks' common pose in the world, by drift and by an imperfect calibration; where the image repeats an earlier one, also how far the
    camera may have moved since. `noise_scale` is the variance of the residuals relative to the stated one. `keyframe_covariance` is that of the
    keyframes which created these landmarks where it is much more than the pose's own, else zero: landmarks made from this pose count it in their
    weights.

    `repeats` is the number of images in a row, up to this one, of which all or most repeats the one before bit for bit, in colour and depth, or in
    colour while planes disagree; `disagreement` the share of the matched points that do not agree with their frame's pose, as a moving average over
    ten frames; `depth_disagreement` the share, of those that the image shows where the map has them, whose depth is another, as a moving average over
    three frames, and `usual_depth_disagreement` over thirty. `jumps` is the number of frames in a row, up to this one, to which the camera moved as
    nothing does that is carried. `lost_from` is the number of the first frame of the latest loss, or of a later jump, 0 for none, and `missing` the
    share of the points mapped before it that should have been matched since the camera was found again and were not, as a moving average over a
    thousand of them; `confirmations` the number of frames in a row since, at most three, that would be ok but for the loss, and with which planes
    agree. `turn_difference` is the rotation (rad, camera frame) by which planes turned more than the pose, as a moving average over ten frames, and
    `usual_turn_difference` its usual size in one frame, 0.3° before the first; `turn_by_lag` what planes would turn by more if depth lagged colour by
    the standard deviation of that time, as the same average. `plane_offsets` are how far half of the area of the matched planes
    lies at least from where the map has them, as a share of its distance, less where the calibration explains it, as moving averages over ten images
    full of matched planes and over a hundred, and how many such images there were, at most a hundred. `usual_accelerations` are the number of frames,
    at most ten, whose linear (m/s²) and angular (rad/s²) acceleration is known, and the largest of these, less 1 % for each frame since.
    `scale_difference` is the logarithm of the ratio by which nine of ten distances between matched points are larger than in the map, or below 0
    smaller (0 where neither is so), as a moving average over three frames.

    Six fields are what the pose's error owes to an imperfect calibration (`plugins.shared.calibration_error`, which defines the parameters and their
    units): `sensitivity` is the derivative of the error by them, `relative_sensitivity` what it has more than that of the reference keyframe,
    `calibration_information` and `calibration_score` the information of the residuals on them so far. `twist` is the camera's velocity (m/s, rad/s)
    in its own frame, `reference_twist` that of the reference keyframe. `depth_scale_sigma` is the relative standard deviation of the scale of all
    depths, of which residuals tell nothing."""

    version: ClassVar[int] = 11  # a field that is added last, with a default, needs no other: recordings number the fields in their order

    T_world_camera: Annotated[F64, Shape(4, 4), Rotations()]
    covariance: Annotated[F64, Shape(6, 6), Finite()]
    T_reference_camera: Annotated[F64, Shape(4, 4), Rotations()]
    reference: Annotated[int, IndexInto("map.keyframes", least=-1)]
    inliers: Annotated[I32, Shape(3), Within(0, 2**31)]
    unobservable: int
    status: Annotated[str, OneOf((OK, DEGRADED, LOST))]  # ok | degraded | lost
    reason: str
    submap: Annotated[int, Within(0, 2**31)] = 0
    unrecognised: int = 0
    map_covariance: Annotated[F64, Shape(6, 6), Finite()] = field(default_factory=lambda: np.zeros((6, 6)))
    noise_scale: Annotated[float, Finite()] = 1.0
    repeats: int = 0
    sensitivity: Annotated[F64, Shape(6, CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros((6, CALIBRATION)))
    twist: Annotated[F64, Shape(6), Finite()] = field(default_factory=lambda: np.zeros(6))
    reference_twist: Annotated[F64, Shape(6), Finite()] = field(default_factory=lambda: np.zeros(6))
    calibration_information: Annotated[F64, Shape(CALIBRATION, CALIBRATION), Finite()] = field(
        default_factory=lambda: np.zeros((CALIBRATION, CALIBRATION))
    )
    calibration_score: Annotated[F64, Shape(CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros(CALIBRATION))
    disagreement: Annotated[float, Within(0.0, 1.0)] = 0.0
    keyframe_covariance: Annotated[F64, Shape(6, 6), Finite()] = field(default_factory=lambda: np.zeros((6, 6)))
    lost_from: Annotated[int, Within(0, 2**31)] = 0
    missing: Annotated[float, Within(0.0, 1.0)] = 0.0
    depth_scale_sigma: Annotated[float, Within(0.0, 1.0)] = 0.0
    turn_difference: Annotated[F64, Shape(3), Finite()] = field(default_factory=lambda: np.zeros(3))
    usual_turn_difference: Annotated[float, Within(0.0, np.pi)] = USUAL_TURN_DIFFERENCE
    plane_offsets: Annotated[F64, Shape(3), Finite()] = field(default_factory=lambda: np.zeros(3))
    confirmations: Annotated[int, Within(0, 2**31)] = 0
    jumps: int = 0
    usual_accelerations: Annotated[F64, Shape(3), Finite()] = field(default_factory=lambda: np.zeros(3))
    scale_difference: Annotated[float, Finite()] = 0.0
    depth_disagreement: Annotated[float, Within(0.0, 1.0)] = 0.0
    usual_depth_disagreement: Annotated[float, Within(0.0, 1.0)] = 0.0
    relative_sensitivity: Annotated[F64, Shape(6, CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros((6, CALIBRATION)))
    turn_by_lag: Annotated[F64, Shape(3), Finite()] = field(default_factory=lambda: np.zeros(3))

    @property
    def local_covariance(self) -> F64:
        """Covariance (6, 6) relative to the landmarks near the pose, by the stated noise of the measurements, with that of uncertain keyframes: what
        estimates that begin from this pose count."""
        return (self.covariance - self.map_covariance) / self.noise_scale + self.keyframe_covariance


@dataclass(frozen=True)
class PredictedView(Value):
    """The predicted view of a dense model from a pose: depth (0 = none), normals (camera frame, NaN = none) and colour (black where there is none),
    of the frame's camera at a whole fraction of its size. `model` is the model itself, from which its plugin renders the next view."""

    version: ClassVar[int] = 2
    dense: ClassVar[bool] = True

    T_world_camera: Annotated[F64, Shape(4, 4), Rotations()]
    depth_m: Annotated[F32, Shape("h", "w")]
    normals: Annotated[F32, Shape("h", "w", 3)]
    color: Annotated[U8, Shape("h", "w", 3)]
    model: Table


@dataclass(frozen=True)
class Trajectory(Described):
    """Poses over time: (n,) stamps in ns, strictly increasing, and (n, 4, 4) `T_world_camera`."""

    stamps_ns: NDArray[np.int64]
    poses: F64

    def __len__(self) -> int:
        return len(self.stamps_ns)


# The pinhole camera and its depth noise.


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth reading: `max(floor_m, a + b z + c z²)` metres at z metres. Belongs to the sensor, so to the data set."""

    a_m: float = -0.00058
    b: float = 0.00074
    c_per_m: float = 0.00273
    floor_m: float = 0.001

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Return (a, b, c, floor) as plain numbers, for kernels."""
        return float(self.a_m), float(self.b), float(self.c_per_m), float(self.floor_m)

    def sigma_m(self, depth_m: Any) -> Any:
        """Return the standard deviation of depths.

        Args:
            depth_m: a number or an array of any shape, m.

        Returns:
            The standard deviations, m, of the same shape.
        """
        return np.maximum(self.floor_m, self.a_m + self.b * depth_m + self.c_per_m * depth_m * depth_m)


EXACT_DEPTH = DepthNoise(a_m=0.0, b=0.0, c_per_m=0.0, floor_m=0.001)


@dataclass(frozen=True)
class CalibrationSigmas:
    """Standard deviations with which a camera's calibration is known; by default those of a camera of a kind, within half a percent of the focal
    lengths, a few pixels of registration, a percent of a depth. 0 of what is exact."""

    focal: Annotated[float, Within(0.0, 1.0)] = 0.003  # of fx and of fy, relative
    centre: Annotated[float, Within(0.0, 1.0)] = 0.0019  # of cx and of cy, of the image's width
    depth_focal: Annotated[float, Within(0.0, 1.0)] = 0.003  # of the focal length of depth, relative to that of colour
    registration: Annotated[float, Within(0.0, 1.0)] = 0.0022  # of depth to colour along x and along y, of the image's width
    inverse_depth: Annotated[float, Within(0.0, 1.0)] = 0.002  # 1/m, the same at each distance
    depth_radial: Annotated[float, Within(0.0, 1.0)] = 0.007  # of depth in the corners of the image, relative
    readout_s: Annotated[float, Within(0.0, 1.0)] = 0.02  # of colour, first row to last
    delay_s: Annotated[float, Within(0.0, 1.0)] = 0.012  # of depth relative to colour
    depth_readout_s: Annotated[float, Within(0.0, 1.0)] = 0.015
    depth_scale: Annotated[float, Within(0.0, 1.0)] = 0.005  # of all depths alike, relative


EXACT_CALIBRATION = CalibrationSigmas(*(0.0,) * len(fields(CalibrationSigmas)))


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole camera; readers undistort frames. `fps` is nominal."""

    width: Annotated[int, Within(1, 2**15)]
    height: Annotated[int, Within(1, 2**15)]
    fx: Annotated[float, Within(1e-3, 1e6)]
    fy: Annotated[float, Within(1e-3, 1e6)]
    cx: Annotated[float, Within(-1e6, 1e6)]
    cy: Annotated[float, Within(-1e6, 1e6)]
    fps: Annotated[float, Within(1e-6, 1e6)] = 30.0
    depth_noise: DepthNoise = field(default_factory=DepthNoise)
    sigmas: CalibrationSigmas = field(default_factory=CalibrationSigmas)

    @property
    def K(self) -> F64:
        """Return the (3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> F64:
        """Return (4,) fx, fy, cx, cy in pixels, for kernels and the map."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def project(self, points_m: F64) -> F64:
        """Project points in the camera frame to pixels.

        Args:
            points_m: (n, 3), camera frame, m.

        Returns:
            (n, 2) pixels (x, y); NaN for points that are not in front of the camera.
        """
        z = np.where(points_m[..., 2] > 1e-6, points_m[..., 2], np.nan)
        return np.stack([self.fx * points_m[..., 0] / z + self.cx, self.fy * points_m[..., 1] / z + self.cy], axis=-1)

    def back_project(self, pixels: NDArray[Any], depth_m: NDArray[Any]) -> NDArray[Any]:
        """Back-project pixels with depths to points in the camera frame.

        Args:
            pixels: (n, 2), (x, y).
            depth_m: (n,) along the optical axis, m.

        Returns:
            (n, 3) points, camera frame, m.
        """
        x = (pixels[..., 0] - self.cx) / self.fx * depth_m
        y = (pixels[..., 1] - self.cy) / self.fy * depth_m
        return np.stack([x, y, depth_m], axis=-1)


# The types of the topics `map`, `bundle` and `loop`: the map and its corrections.

# Columns that every map has: element type, shape of a row (None: any length), constraints. Indices refer to other tables of the map.
_ROW, _KEYFRAME = ("i4", ()), ("i4", (), IndexInto(".keyframes"))
_LIFE: dict[str, tuple[Any, ...]] = {
    "first": _KEYFRAME,
    "observers": ("i4", (None,), IndexInto(".keyframes", least=-1)),
    "found": _ROW,
    "visible": _ROW,
    "alive": ("?", ()),
}
KEYFRAMES = Columns(
    {
        "index": _ROW,
        "stamp_ns": ("i8", ()),
        "T_world_camera": ("f8", (4, 4), Rotations()),
        "covariance": ("f8", (6, 6), Finite()),
        "world_covariance": ("f8", (6, 6), Finite()),
        "sensitivity": ("f8", (6, CALIBRATION), Finite()),
        "aligned": ("f8", (6,), Finite()),
        "undone": ("f8", (6,), Finite()),
        "undone_sensitivity": ("f8", (6, CALIBRATION), Finite()),
        "twist": ("f8", (6,), Finite()),
        "intrinsics": ("f8", (4,), Finite()),
        "points": ("i4", (2,), IndexInto(".point_observations+")),
        "lines": ("i4", (2,), IndexInto(".line_observations+")),
        "planes": ("i4", (2,), IndexInto(".plane_observations+")),
        "submap": ("i4", (), Within(0, 2**31)),
        "alive": ("?", ()),
    }
)
POINTS = Columns(
    {
        "position_m": ("f8", (3,), Finite()),
        "information": ("f4", (3, 3), Finite()),
        "descriptor": ("u1", (None,)),
        "direction": ("f4", (3,)),
        "distance_m": ("f4", ()),
        "octave": ("u1", ()),
        **_LIFE,
    }
)
LINES = Columns({"endpoints_m": ("f8", (2, 3), Finite()), "information": ("f4", (2, 3, 3), Finite()), "descriptor": ("u1", (None,)), **_LIFE})
PLANES = Columns(
    {
        "coefficients": ("f8", (4,), UnitNormals()),
        "covariance": ("f8", (3, 3), Finite()),
        "moments": ("f8", (4, 4), Finite()),
        "samples_m": ("f4", (None, 3)),
        **_LIFE,
    }
)
POINT_OBSERVATIONS = Columns(
    {
        "keyframe": _KEYFRAME,
        "point": ("i4", (), IndexInto(".points")),
        "pixel": ("f4", (2,), Finite()),
        "depth_m": ("f4", ()),
        "sigma_px": ("f4", ()),
        "sigma_m": ("f4", ()),
    }
)
LINE_OBSERVATIONS = Columns(
    {
        "keyframe": _KEYFRAME,
        "line": ("i4", (), IndexInto(".lines")),
        "endpoints_px": ("f4", (2, 2), Finite()),
        "endpoints_m": ("f4", (2, 3)),
        "covariance_m2": ("f4", (2, 3, 3)),
    }
)
PLANE_OBSERVATIONS = Columns(
    {
        "keyframe": _KEYFRAME,
        "plane": ("i4", (), IndexInto(".planes")),
        "coefficients": ("f8", (4,), UnitNormals()),
        "covariance": ("f8", (3, 3), Finite()),
        "moments": ("f8", (4, 4), Finite()),
    }
)
PROPOSALS = Columns(
    {
        "index": _ROW,
        "keyframe": _KEYFRAME,
        "older_keyframe": _KEYFRAME,
        "T_keyframe_camera": ("f8", (4, 4), Rotations()),
        "T_older_camera": ("f8", (4, 4), Rotations()),
        "covariance": ("f8", (6, 6), Finite()),
    }
)


def _no_proposals() -> Table:
    return Table.empty({name: Column(kind, shape) for name, (kind, shape, *_) in PROPOSALS.columns.items()})


@dataclass(frozen=True)
class Map(Value):
    """Keyframes and landmarks; a row number is an id for good, dead rows have `alive` False. Columns are listed in `plugins.mapping.landmarks`.

    `revision` counts versions, `loop_closed` is that of the last one with a correction by `loop` or a merged sub-map; a row of `point_observations`
    and its siblings is a keyframe (row), a landmark, and its measurement. A row of `proposals` is a frame of one sub-map that was recognised in an
    older one: its pose relative to a keyframe of each, and the sum of both covariances (camera frame). Several that agree merge the two.
    `calibration_information` and `calibration_score` are those of the newest keyframe's pose, `calibration_errors` the errors of the calibration that
    the last alignment with the Manhattan frame has undone."""

    version: ClassVar[int] = 9
    revision: int
    keyframes: Annotated[Table, KEYFRAMES]
    points: Annotated[Table, POINTS]
    lines: Annotated[Table, LINES]
    planes: Annotated[Table, PLANES]
    point_observations: Annotated[Table, POINT_OBSERVATIONS]
    line_observations: Annotated[Table, LINE_OBSERVATIONS]
    plane_observations: Annotated[Table, PLANE_OBSERVATIONS]
    loop_closed: int = 0
    proposals: Annotated[Table, PROPOSALS] = field(default_factory=_no_proposals)
    calibration_information: Annotated[F64, Shape(CALIBRATION, CALIBRATION), Finite()] = field(
        default_factory=lambda: np.zeros((CALIBRATION, CALIBRATION))
    )
    calibration_score: Annotated[F64, Shape(CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros(CALIBRATION))
    calibration_errors: Annotated[F64, Shape(CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros(CALIBRATION))

    @cached_property
    def memo(self) -> dict[Hashable, Any]:
        """Return a cache for results derived from this version and needed frame after frame; it ends with it and is no part of the value."""
        return {}

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """Return `points_m` (n, 3), `endpoints_m` of lines (m, 2, 3) and `coefficients` of planes (p, 4) in use, world frame."""
        points, lines, planes = (table.column("alive") for table in (self.points, self.lines, self.planes))
        return {
            "points_m": self.points.column("position_m")[points],
            "endpoints_m": self.lines.column("endpoints_m")[lines],
            "coefficients": self.planes.column("coefficients")[planes],
        }

    def to_open3d(self) -> Any:
        """Return the points in use as an `open3d.geometry.PointCloud`, world frame.

        Raises:
            LibraryError: Open3D is not installed, or does not load.
        """
        return conversions.points_to_open3d(self.to_numpy()["points_m"])

    def to_trimesh(self) -> Any:
        """Return the points in use as a `trimesh.PointCloud`, world frame."""
        return conversions.points_to_trimesh(self.to_numpy()["points_m"])


@dataclass(frozen=True)
class Correction(Value):
    """New poses of keyframes and positions of landmarks, by id, from bundle adjustment or loop closing of revision `based_on`. `*_information`
    (world, 1/m²; of each end of a line) and `plane_covariance`, of (a, b, d), replace those of the map: no measurement is counted twice.
    `sensitivity`, `aligned`, `undone` and `undone_sensitivity` replace these columns of the corrected keyframes (`mapping.landmarks`); they are
    of no keyframe where these stay as they are. `calibration_errors` replace those of the map where `undone` is of keyframes."""

    version: ClassVar[int] = 3

    based_on: int
    keyframe_ids: Annotated[I32, Shape("k"), IndexInto("map.keyframes")]
    T_world_keyframe: Annotated[F64, Shape("k", 4, 4), Rotations()]
    point_ids: Annotated[I32, Shape("n"), IndexInto("map.points")]
    points_m: Annotated[F64, Shape("n", 3), Finite()]
    point_information: Annotated[F32, Shape("n", 3, 3)]
    line_ids: Annotated[I32, Shape("m"), IndexInto("map.lines")]
    endpoints_m: Annotated[F64, Shape("m", 2, 3), Finite()]
    line_information: Annotated[F32, Shape("m", 2, 3, 3)]
    plane_ids: Annotated[I32, Shape("p"), IndexInto("map.planes")]
    coefficients: Annotated[F64, Shape("p", 4), UnitNormals()]
    plane_covariance: Annotated[F64, Shape("p", 3, 3)]
    sensitivity: Annotated[F64, Shape("s", 6, CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros((0, 6, CALIBRATION)), kw_only=True)
    aligned: Annotated[F64, Shape("u", 6), Finite()] = field(default_factory=lambda: np.zeros((0, 6)), kw_only=True)
    undone: Annotated[F64, Shape("u", 6), Finite()] = field(default_factory=lambda: np.zeros((0, 6)), kw_only=True)
    undone_sensitivity: Annotated[F64, Shape("u", 6, CALIBRATION), Finite()] = field(
        default_factory=lambda: np.zeros((0, 6, CALIBRATION)), kw_only=True
    )
    calibration_errors: Annotated[F64, Shape(CALIBRATION), Finite()] = field(default_factory=lambda: np.zeros(CALIBRATION), kw_only=True)


PLACES = Columns({"keyframe": ("i4", (), IndexInto("map.keyframes")), "descriptor": ("f4", (None,), Finite())})


@dataclass(frozen=True)
class PlaceCorrection(Correction):
    """A correction by a stage that remembers places: `places` has the descriptor of each keyframe that it saw. It may correct nothing."""

    places: Annotated[Table, PLACES]


# The type of the topic `surface`: a triangle mesh with plane instances.

PLANE_KINDS = ("plane", "floor", "ceiling", "wall", "horizontal", "vertical")  # a plane is none of the others when it slants, or up is not known


@dataclass(frozen=True)
class Surface(Value):
    """A triangle mesh in the world frame, anticlockwise seen from where it was seen, and the plane instances in it.

    `instances` is the row of the plane a triangle lies in, -1 for none. Of plane i: `plane_ids` is its id in the map (beyond the map's if it is not
    there), `coefficients` n·x + d = 0 with n towards the camera, `kinds` a row of PLANE_KINDS, `areas_m2` that of its triangles, `plane_colors` its
    mean. Row k of `loops` is (plane, begin, end): `loop_vertices[begin:end]` go round it, anticlockwise about n; round a hole the other way.
    `atlas` (RGB) is the planes' texture: `texels` are the (x, y) of a triangle's corners in it, pixel centres at integers; NaN without one. `up`
    points up in the world, along an axis of the Manhattan frame; NaN where it is not known."""

    version: ClassVar[int] = 2

    vertices_m: Annotated[F32, Shape("v", 3), Finite()]
    colors: Annotated[U8, Shape("v", 3)]
    triangles: Annotated[I32, Shape("t", 3), IndexInto(".vertices_m")]
    instances: Annotated[I32, Shape("t"), IndexInto(".coefficients", least=-1)]
    plane_ids: Annotated[I32, Shape("p")]
    coefficients: Annotated[F64, Shape("p", 4)]
    kinds: Annotated[U8, Shape("p"), Within(0, len(PLANE_KINDS) - 1)]
    areas_m2: Annotated[F32, Shape("p")]
    plane_colors: Annotated[U8, Shape("p", 3)]
    loops: Annotated[I32, Shape("l", 3), IndexInto(".coefficients", ".loop_vertices+", ".loop_vertices+")]
    loop_vertices: Annotated[I32, Shape("k"), IndexInto(".vertices_m")]
    atlas: Annotated[U8, Shape("h", "w", 3)]
    texels: Annotated[F32, Shape("t", 3, 2)]
    up: Annotated[F64, Shape(3)]

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """Return `vertices_m` (v, 3), `colors` (v, 3) RGB, `triangles` (t, 3) and the `plane` (t,) of each, -1 for none."""
        return {"vertices_m": self.vertices_m, "colors": self.colors, "triangles": self.triangles, "plane": self.instances}

    def to_open3d(self) -> Any:
        """Return the mesh as an `open3d.geometry.TriangleMesh` with coloured vertices.

        Raises:
            LibraryError: Open3D is not installed, or does not load.
        """
        return conversions.mesh_to_open3d(self.vertices_m, self.triangles, self.colors)

    def to_trimesh(self) -> Any:
        """Return the mesh as a `trimesh.Trimesh` with coloured vertices."""
        return conversions.mesh_to_trimesh(self.vertices_m, self.triangles, self.colors)

    @staticmethod
    def empty(index: int, stamp_ns: int) -> Surface:
        """Make a mesh without triangles and planes.

        Args:
            index: the number of the frame.
            stamp_ns: its time, ns.

        Returns:
            The mesh, in which up is not known.
        """
        none, no_number, no_color = np.empty((0, 3), np.float32), np.empty(0, np.int32), np.empty((0, 3), np.uint8)
        atlas, texels = np.empty((0, 0, 3), np.uint8), np.empty((0, 3, 2), np.float32)
        return Surface(
            index, stamp_ns, none, no_color, np.empty((0, 3), np.int32), no_number, no_number.copy(), np.empty((0, 4)), np.empty(0, np.uint8),
            np.empty(0, np.float32), no_color.copy(), np.empty((0, 3), np.int32), no_number.copy(), atlas, texels, np.full(3, np.nan),
        )  # fmt: skip


# The type of the topic `building`: a plan with heights.

OPENING_KINDS = ("door", "passage", "window")  # a passage reaches the ceiling or is wider than a door; a window begins above the floor
ELEMENTS = ("storey", "wall", "room", "opening")
SUPPORTS = ("plane", "keyframe", "frame")


@dataclass(frozen=True)
class Building(Value):
    """Storeys, walls, rooms and openings, in the building's frame: z up, z = 0 at the lowest floor, y the horizontal axis nearest to the first
    camera's view, x to its right, the first camera above the origin; metres.

    Of storey i: `storeys` is its floor and ceiling height (NaN = not seen). Of wall i: `walls_m` are the ends of its face, with the side the face was
    seen from on the left; the other face is parallel, `thickness_m` behind it (NaN = not seen); `wall_covariance` is that of (offset of the face,
    thickness, direction in rad). Rows of `unseen` are (wall, begin, end): the stretches, in metres from the wall's start, that no reading shows.
    Of room i: row k of `loops` is (room, begin, end), `corners_m[begin:end]` go round it anticlockwise, round a hole the other way; corner j and its
    successor are the ends of an edge on wall `corner_walls[j]`, -1 where nothing bounds what was seen, whose offset has the standard deviation
    `edge_sigma_m[j]` relative to the room (NaN = not seen); `closed` is True if every edge is on a wall.
    Of opening i: its wall, its (left, right) in metres from the wall's start, its (bottom, top) above the floor, the covariance of these four, a row
    of OPENING_KINDS, and the rooms it joins (-1 = none). `furniture` are ids of the planes of the map that are none of the building's own. Rows of
    `support` are (row of ELEMENTS, the element, row of SUPPORTS, id or number). `note` names what is missing. Rows of
    `doubts` are (room, change, probability): by how much its area would change, m², if something is otherwise than the plan has it, beside what
    `area_variance` counts of its walls. `edits` are corrections by hand, with names and uses of elements, as JSON; empty without any."""

    version: ClassVar[int] = 2

    T_world_building: Annotated[F64, Shape(4, 4), Rotations()]
    note: str
    storeys: Annotated[F64, Shape("s", 2)]
    storey_covariance: Annotated[F64, Shape("s", 2, 2)]  # of (floor, ceiling), m²; NaN = not seen
    walls_m: Annotated[F64, Shape("w", 2, 2), Finite()]
    wall_storeys: Annotated[I32, Shape("w"), IndexInto(".storeys")]
    thickness_m: Annotated[F64, Shape("w")]
    wall_covariance: Annotated[F64, Shape("w", 3, 3)]
    unseen: Annotated[F64, Shape("u", 3), Finite()]
    room_storeys: Annotated[I32, Shape("r"), IndexInto(".storeys")]
    loops: Annotated[I32, Shape("l", 3), IndexInto(".room_storeys", ".corners_m+", ".corners_m+")]
    corners_m: Annotated[F64, Shape("c", 2), Finite()]
    corner_walls: Annotated[I32, Shape("c"), IndexInto(".walls_m", least=-1)]
    edge_sigma_m: Annotated[F64, Shape("c")]
    areas_m2: Annotated[F64, Shape("r"), Finite()]
    area_variance: Annotated[F64, Shape("r")]  # m⁴
    closed: Annotated[Bool, Shape("r")]
    opening_walls: Annotated[I32, Shape("o"), IndexInto(".walls_m")]
    opening_kinds: Annotated[U8, Shape("o"), Within(0, len(OPENING_KINDS) - 1)]
    spans_m: Annotated[F64, Shape("o", 2), Finite()]
    opening_heights_m: Annotated[F64, Shape("o", 2), Finite()]
    opening_covariance: Annotated[F64, Shape("o", 4, 4)]
    opening_rooms: Annotated[I32, Shape("o", 2), IndexInto(".room_storeys", least=-1)]
    furniture: Annotated[I32, Shape("f")]
    support: Annotated[I32, Shape("n", 4)]
    doubts: Annotated[F64, Shape("d", 3), Finite()]
    edits: str = ""

    @staticmethod
    def empty(index: int, stamp_ns: int, note: str, T_world_building: F64 | None = None) -> Building:
        """Make a plan without any element, with the reason.

        Args:
            index: the number of the frame.
            stamp_ns: its time, ns.
            note: the reason, a sentence.
            T_world_building: (4, 4); the identity by default.

        Returns:
            The plan.
        """
        T = np.eye(4) if T_world_building is None else T_world_building
        number, none, rows = np.empty(0, np.int32), np.empty(0), np.empty((0, 2))
        return Building(
            index, stamp_ns, T, note, rows, np.empty((0, 2, 2)), np.empty((0, 2, 2)), number, none, np.empty((0, 3, 3)), np.empty((0, 3)),
            number.copy(), np.empty((0, 3), np.int32), rows.copy(), number.copy(), none.copy(), none.copy(), none.copy(), np.empty(0, np.bool_),
            number.copy(),
            np.empty(0, np.uint8), rows.copy(), rows.copy(), np.empty((0, 4, 4)), np.empty((0, 2), np.int32), number.copy(),
            np.empty((0, 4), np.int32), np.empty((0, 3)),
        )  # fmt: skip
