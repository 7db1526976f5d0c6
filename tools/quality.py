"""Quality of a run without ground truth: the error that it states, and how well its own depth images agree under the estimated trajectory.

Four kinds of figure, all in metres but the entropy:

- `sigma_m`: median σ of the positions of the `ok` poses, as their covariances state it.
- `warped_1_m`, `warped_10_m`, `warped_30_m`: the depth image of frame i is moved into frame i + 1, i + 10 and i + 30 by the estimate; median of the
  absolute difference to the depth measured there, mean over pairs. The sensor's noise is in it. `shifted_30_m` is without: the RMS over TILES × TILES
  parts of the image of the median difference, signed.
- `map_entropy` and `plane_sigma_m`: mean map entropy (Droeschel and Behnke, 2018), `½ ln det(2π e Σ)` of the points in a ball, and the square
  root of the median smallest eigenvalue of Σ over points on mutually orthogonal planes (MOM; Kornilova and Ferrer, "Be your own benchmark:
  no-reference trajectory metric on registered point clouds", ECMR 2021, who take the mean: a ball that holds furniture, too, would decide it).
- `wall_thickness_m`: on planar parts that several frames have seen, the standard deviation of the positions at which the frames saw them, along the
  normal, median over the parts. A mean over the points of a frame has little noise: drift remains, and what is wrong with the sensor's depth.

A ground truth is judged by the same figures, without σ. They hold the errors of the sensor's depth as well as those of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import F64, Frame

if TYPE_CHECKING:
    from trihedron.pipeline.record.reader import Recording

Rows = NDArray[np.int64]
APART = (1, 10, 30)  # frames between those that are compared
PAIRS = 10  # for each distance
WARP_STRIDE_PX, TILES, LEAST_PIXELS = 8, 4, 8  # sampled pixels; parts of the image a side; pixels of a part that is judged
VIEWS, VIEW_STRIDE_PX, FARTHEST_M = 30, 8, 5.0  # frames of the point cloud, their sampled pixels and range
QUERIES, BALL_M, LEAST_POINTS = 1500, 0.2, 30  # balls, their radius, and the points that one holds at least
FLAT = 0.15  # of the second eigenvalue: the smallest of a planar part is less
AXIS_DEG, LEAST_SHARE = 10.0, 0.03  # normals of one direction; share of the planar parts that a direction has at least
LEAST_VIEWS, LEAST_OF_VIEW = 3, 5  # frames that saw a part, and their points in it
CACHED = 16  # frames


@dataclass(frozen=True)
class Quality:
    """Figures of a run; None where there was too little to judge. `frames` and `posed` count those of the recording, `parts` the planar balls."""

    frames: int
    posed: int
    sigma_m: float | None
    warped_1_m: float | None
    warped_10_m: float | None
    warped_30_m: float | None
    shifted_30_m: float | None
    map_entropy: float | None
    plane_sigma_m: float | None
    wall_thickness_m: float | None
    parts: int

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class PosedFrames:
    """The posed frames of a run: their numbers in order, (n, 4, 4) poses, and access to their images by row."""

    numbers: Rows
    poses: F64
    read: Callable[[int], Frame | None]


@dataclass(frozen=True)
class Parts:
    """Balls of points: (n, 3) ascending eigenvalues of their covariances, (n, 3) normals and (n,) whether they are flat as the frames that saw them
    show each by itself, and the rows of the points in each."""

    eigenvalues: F64
    normals: F64
    planar: NDArray[np.bool_]
    members: list[Rows]


def quality_of_run(recording: Recording) -> Quality:
    """Judge the recording of a run. Raises DataError where its frames are gone, or fewer than two are posed."""
    from trihedron.pipeline.core.types import Pose
    from trihedron.pipeline.run.stated_sigma import stated_sigma

    frames, _, count = _posed_frames(recording)
    stated = stated_sigma([pose for pose in recording.values("pose") if isinstance(pose, Pose)] if "pose" in recording.topics else [], [])
    return quality_of(frames, count, stated.median_m if stated is not None else None)


def quality_of_truth(recording: Recording) -> Quality | None:
    """Judge the ground truth of a run by the same frames; None where fewer than two of them have one. Raises as `quality_of_run`."""
    from trihedron.pipeline.record.trajectories import attached_truth
    from trihedron.pipeline.run.metrics import associate

    truth = attached_truth(recording.attachments, str(recording.path))
    if truth is None:
        return None
    frames, stamps_ns, count = _posed_frames(recording)
    pairs = associate(stamps_ns, truth.stamps_ns)
    if len(pairs) < 2:
        return None
    rows = pairs[:, 0].tolist()
    return quality_of(PosedFrames(frames.numbers[rows], truth.poses[pairs[:, 1]], lambda row: frames.read(rows[row])), count)


def _posed_frames(recording: Recording) -> tuple[PosedFrames, Rows, int]:
    """Return the posed frames of a recording, their stamps (n,), and the number of all frames. Raises DataError for fewer than two."""
    from trihedron.pipeline.app.recorded_values import frames_of, references_of, trajectory_of

    references = {reference.stamp_ns: reference for reference in references_of(recording).values()}
    trajectory, frame_of = trajectory_of(recording), frames_of(recording)
    posed = [row for row, stamp in enumerate(trajectory.stamps_ns.tolist()) if stamp in references]
    if len(posed) < 2:
        raise DataError(str(recording.path), "has fewer than two posed frames", "judge a run that tracked its camera")
    known = [references[int(trajectory.stamps_ns[row])] for row in posed]

    @lru_cache(CACHED)
    def read(row: int) -> Frame | None:
        return frame_of(known[row])

    frames = PosedFrames(np.array([reference.index for reference in known]), trajectory.poses[posed], read)
    return frames, trajectory.stamps_ns[posed], len(references)


def quality_of(frames: PosedFrames, count: int, sigma_m: float | None = None) -> Quality:
    """Judge posed frames; `count` is the number of all frames, `sigma_m` the σ that the run states."""
    warped = {apart: _warp_errors(frames, apart) for apart in APART}
    medians = {apart: float(np.mean([m for m, _ in found])) if found else None for apart, found in warped.items()}
    shifts = [shift for _, shift in warped[APART[-1]] if np.isfinite(shift)]
    points, views = point_cloud(frames)
    parts = parts_of(points, views)
    flat = np.flatnonzero(parts.planar)
    entropy = 0.5 * np.log(np.maximum(np.prod(2.0 * np.pi * np.e * parts.eigenvalues, axis=1), 1e-300))
    orthogonal = flat[_orthogonal(parts.normals[flat])]
    thickness = wall_thickness(points, views, parts, flat)
    return Quality(
        frames=count,
        posed=len(frames.numbers),
        sigma_m=sigma_m,
        warped_1_m=medians[1],
        warped_10_m=medians[10],
        warped_30_m=medians[30],
        shifted_30_m=float(np.mean(shifts)) if shifts else None,
        map_entropy=float(entropy.mean()) if len(entropy) else None,
        plane_sigma_m=float(np.sqrt(np.median(parts.eigenvalues[orthogonal, 0]))) if len(orthogonal) else None,
        wall_thickness_m=thickness,
        parts=len(flat),
    )


def _warp_errors(frames: PosedFrames, apart: int) -> list[tuple[float, float]]:
    """Compare up to PAIRS pairs of frames: median absolute difference of depth, and RMS over parts of the image of the signed one, in metres."""
    second = np.searchsorted(frames.numbers, frames.numbers + apart)
    first = np.flatnonzero(second < len(frames.numbers))
    first = first[frames.numbers[second[first]] == frames.numbers[first] + apart]
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(PAIRS, len(first))).round().astype(int))] if len(first) else first
    found = []
    for row in chosen.tolist():
        a, b = frames.read(row), frames.read(int(second[row]))
        compared = None if a is None or b is None else warped_depth(a, b, invert(frames.poses[second[row]]) @ frames.poses[row])
        found += [compared] if compared is not None else []
    return found


def warped_depth(a: Frame, b: Frame, T_b_a: F64) -> tuple[float, float] | None:
    """Compare the depth of frame `a`, moved into frame `b`, with the depth measured there: median absolute difference, and RMS over parts of the
    image of the median difference. None where too few pixels have both."""
    points, _ = _points_of(a, WARP_STRIDE_PX, np.inf)
    moved = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    pixels = np.nan_to_num(b.camera.project(moved), nan=-1.0)
    x, y = np.rint(np.clip(pixels, -1.0, 1e6)).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < b.camera.width) & (y < b.camera.height)
    measured = np.zeros(len(moved))
    measured[inside] = b.depth_m[y[inside], x[inside]]
    seen = measured > 0.0
    if seen.sum() < LEAST_PIXELS:
        return None
    difference = (measured - moved[:, 2])[seen]
    tile = (y[seen] * TILES // b.camera.height) * TILES + x[seen] * TILES // b.camera.width
    medians = [float(np.median(difference[tile == k])) for k in range(TILES * TILES) if (tile == k).sum() >= LEAST_PIXELS]
    return float(np.median(np.abs(difference))), float(np.sqrt(np.mean(np.square(medians)))) if medians else float("nan")


def point_cloud(frames: PosedFrames) -> tuple[F64, Rows]:
    """Collect (n, 3) points in the world from frames spread over the run, and (n,) the rows of the frames that saw them."""
    chosen = np.unique(np.linspace(0, len(frames.numbers) - 1, VIEWS).round().astype(int))
    points, views = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for row in chosen.tolist():
        frame = frames.read(row)
        if frame is not None:
            seen, _ = _points_of(frame, VIEW_STRIDE_PX, FARTHEST_M)
            T = frames.poses[row]
            points.append(seen @ T[:3, :3].T + T[:3, 3])
            views.append(np.full(len(seen), row))
    return np.concatenate(points), np.concatenate(views)


def _points_of(frame: Frame, stride: int, farthest_m: float) -> tuple[F64, Rows]:
    """Back-project every `stride`th pixel with depth: (n, 3) points in the camera frame, (n, 2) pixels."""
    y, x = np.mgrid[stride // 2 : frame.camera.height : stride, stride // 2 : frame.camera.width : stride]
    depth = frame.depth_m[y, x].astype(np.float64)
    seen = (depth > 0.0) & (depth < farthest_m) & np.isfinite(depth)
    pixels = np.stack([x[seen], y[seen]], axis=1)
    return frame.camera.back_project(pixels.astype(np.float64), depth[seen]), pixels


def parts_of(points: F64, views: Rows) -> Parts:
    """Gather the points in balls about points spread over the cloud (n, 3); `views` (n,) are the frames that saw them."""
    if not len(points):
        return Parts(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool), [])
    tree = cKDTree(points)
    queries = points[np.unique(np.linspace(0, len(points) - 1, QUERIES).astype(int))]
    members = [np.asarray(rows) for rows in tree.query_ball_point(queries, BALL_M) if len(rows) >= LEAST_POINTS]
    covariances = np.array([np.cov(points[rows].T) for rows in members]).reshape(-1, 3, 3)
    within, vectors = np.linalg.eigh(np.array([_covariance_within(points[rows], views[rows]) for rows in members]).reshape(-1, 3, 3))
    planar = within[:, 0] < FLAT * within[:, 1]
    return Parts(np.maximum(np.linalg.eigvalsh(covariances), 1e-12), vectors[:, :, 0], planar, members)


def _covariance_within(points: F64, views: Rows) -> F64:
    """Return the (3, 3) covariance of points about the mean of the frame that saw them."""
    _, group, counts = np.unique(views, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    means = np.stack([np.bincount(group, points[:, k]) for k in range(3)], axis=1) / counts[:, None]
    apart = points - means[group]
    return np.asarray(apart.T @ apart / max(len(points) - len(counts), 1), np.float64)


def _orthogonal(normals: F64) -> Rows:
    """Select the rows of normals (n, 3) along the commonest direction and those that are at right angles to it and to each other; none where there
    is no second one."""
    if len(normals) < 2:
        return np.zeros(0, np.int64)
    along, across = np.cos(np.radians(AXIS_DEG)), np.sin(np.radians(AXIS_DEG))
    cosines = np.abs(normals @ normals.T)
    alike, right = cosines > along, cosines < across
    first = int(alike.sum(axis=1).argmax())
    candidates = np.flatnonzero(right[first])
    axes = [first]
    if len(candidates):
        axes.append(int(candidates[alike[candidates].sum(axis=1).argmax()]))
        third = np.flatnonzero(right[first] & right[axes[1]])
        axes += [int(third[alike[third].sum(axis=1).argmax()])] if len(third) else []
    axes = [axis for axis in axes if alike[axis].sum() >= LEAST_SHARE * len(normals)]
    return np.flatnonzero(alike[axes].any(axis=0)) if len(axes) > 1 else np.zeros(0, np.int64)


def wall_thickness(points: F64, views: Rows, parts: Parts, flat: Sequence[int] | Rows) -> float | None:
    """Return the median over planar parts of the standard deviation between the frames that saw a part, along its normal; None without any."""
    variances = []
    for part in flat:
        rows = parts.members[part]
        offsets, seen_by = points[rows] @ parts.normals[part], views[rows]
        means = [offsets[seen_by == view].mean() for view in np.unique(seen_by) if (seen_by == view).sum() >= LEAST_OF_VIEW]
        variances += [float(np.var(means, ddof=1))] if len(means) >= LEAST_VIEWS else []
    return float(np.sqrt(np.median(variances))) if variances else None
