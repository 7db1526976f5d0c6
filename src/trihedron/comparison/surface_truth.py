"""The true surface of a run: the scene's own where the data set ships it, else the data set's rendered depth; and the part of it that was seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from trihedron.comparison.mesh_distance import FAR_M, NearestTriangle
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F64, Bool, Camera, Trajectory

VIEWS = 100  # frames, evenly chosen, whose pixels say what was seen
PIXEL_STEP = 4
CELL_M = 0.02  # of the seen surface; each stands for one point, however often it was seen
SMOOTH_M = 0.02  # neighbouring pixels of rendered depth on one surface differ by less, and by less than a share of the depth
SMOOTH = 0.02


class Distance(Protocol):
    """Distances (n,) of points (n, 3) to the truth, and for each whether the truth is curved there (False where that is not known)."""

    def __call__(self, points: F64) -> tuple[F64, Bool]: ...


@dataclass(frozen=True)
class Truth:
    """In the world of the ground truth: `distance` to the whole surface, the points that were seen, and whether each is on a curved part.
    `labelled` is False where the truth does not tell planar from curved."""

    distance: Distance
    seen_m: F64
    curved: Bool
    labelled: bool


def truth_of(dataset: Any, trajectory: Trajectory) -> Truth:
    """The truth of a data set with its ground truth poses. Raises DataError when it has neither a surface nor exact depth."""
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(VIEWS, len(dataset))).round().astype(int))
    if hasattr(dataset, "surface"):
        return _of_scene(dataset, trajectory, chosen)
    return _of_depth(dataset, trajectory, chosen)


def _of_scene(dataset: Any, trajectory: Trajectory, chosen: Any) -> Truth:
    surface = dataset.surface()
    nearest = NearestTriangle(surface.vertices_m, surface.triangles)

    def distance(points: F64) -> tuple[F64, Bool]:
        found, triangle = nearest.query(points)
        return found, np.append(surface.curved, False)[triangle]

    points, curved = [], []
    for position in chosen:
        frame = dataset(int(position))
        depth, bent = dataset.true_view(int(position))
        seen, rows = _world(np.where(frame.depth_m > 0.0, depth, 0.0), frame.camera, _pose(trajectory, frame.stamp_ns))
        points.append(seen)
        curved.append(bent[PIXEL_STEP // 2 :: PIXEL_STEP, PIXEL_STEP // 2 :: PIXEL_STEP].ravel()[rows])
    seen, first = _downsample_points(np.concatenate(points))
    return Truth(distance, seen, np.concatenate(curved)[first], True)


def _of_depth(dataset: Any, trajectory: Trajectory, chosen: Any) -> Truth:
    """The union of the views' points with normals: the distance is to the plane of the nearest."""
    from scipy.spatial import cKDTree

    points, normals = [], []
    for position in chosen:
        frame = dataset(int(position))
        if frame is None or np.abs(trajectory.stamps_ns - frame.stamp_ns).min() != 0:
            continue
        seen, directions = _with_normals(frame.depth_m.astype(np.float64), frame.camera, _pose(trajectory, frame.stamp_ns))
        points.append(seen)
        normals.append(directions)
    if not points:
        raise DataError("the data set", "has no frame with a true pose of its very stamp, so its depth is no truth", "give a rendered data set")
    cloud, first = _downsample_points(np.concatenate(points), CELL_M / 2.0)
    about = np.concatenate(normals)[first]
    tree = cKDTree(cloud)

    def distance(points: F64) -> tuple[F64, Bool]:
        found, row = tree.query(points, distance_upper_bound=FAR_M)
        near = found < 2.0 * CELL_M
        offset = points[near] - cloud[row[near]]
        found = np.minimum(found, FAR_M)
        found[near] = np.abs(np.einsum("ij,ij->i", offset, about[row[near]]))
        return found, np.zeros(len(points), np.bool_)

    seen, _ = _downsample_points(cloud)
    return Truth(distance, seen, np.zeros(len(seen), np.bool_), False)


def _pose(trajectory: Trajectory, stamp_ns: int) -> F64:
    return np.asarray(trajectory.poses[int(np.argmin(np.abs(trajectory.stamps_ns - stamp_ns)))])


def _world(depth: F64, camera: Camera, T: F64) -> tuple[F64, Any]:
    """Every PIXEL_STEP-th reading as a point in the world, and its place in the thinned image."""
    v, u = np.mgrid[PIXEL_STEP // 2 : depth.shape[0] : PIXEL_STEP, PIXEL_STEP // 2 : depth.shape[1] : PIXEL_STEP].reshape(2, -1)
    rows = np.flatnonzero(depth[v, u] > 0.0)
    u, v = u[rows], v[rows]
    return camera.back_project(np.stack([u, v], axis=1), depth[v, u]) @ T[:3, :3].T + T[:3, 3], rows


def _with_normals(depth: F64, camera: Camera, T: F64) -> tuple[F64, F64]:
    """Points and unit normals, where the depth is smooth, in the world."""
    v, u = np.mgrid[1 : depth.shape[0] - 1 : PIXEL_STEP, 1 : depth.shape[1] - 1 : PIXEL_STEP].reshape(2, -1)
    z, right, down = depth[v, u], depth[v, u + 1], depth[v + 1, u]
    limit = SMOOTH_M + SMOOTH * z
    good = (z > 0.0) & (right > 0.0) & (down > 0.0) & (np.abs(right - z) < limit) & (np.abs(down - z) < limit)
    u, v, z, right, down = u[good], v[good], z[good], right[good], down[good]
    points = camera.back_project(np.stack([u, v], axis=1), z)
    across = camera.back_project(np.stack([u + 1, v], axis=1), right) - points
    along = camera.back_project(np.stack([u, v + 1], axis=1), down) - points
    normals = np.cross(across, along)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    return points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T


def _downsample_points(points: F64, cell_m: float = CELL_M) -> tuple[F64, Any]:
    """The first point of each cell, and its row."""
    _, first = np.unique(np.floor(points / cell_m).astype(np.int64), axis=0, return_index=True)
    return points[first], first
