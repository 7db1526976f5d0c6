"""A box of a room with points, edges and walls that are known, and what a camera in it measures: features without images."""

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix, tangent_basis, transform, transform_planes
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Camera, Frame, Keypoints, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.mapping.projection import clip_segments
from trihedron.plugins.shared.covariances import point_covariance

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 239.5)
SIZE = np.array([5.0, 3.0, 6.0])  # of the room; its axes are not the world's
SAMPLES = 40
INTO_CORNER = exp_se3(np.array([0.3, 0.1, -0.2, 0.35, -0.55, 0.1]))  # of the room before the first camera: three walls in view


@dataclass
class World:
    """n points on the walls, the 12 edges and some segments on the walls, 6 walls seen from inside. The world is the first camera's frame."""

    points: int = 600
    seed: int = 0
    noise: float = 1.0  # multiplies pixel and depth noise; 0 = exact
    marks: int = 60  # segments on the walls

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        half = SIZE / 2.0
        p = rng.uniform(-half, half, (self.points, 3))
        wall = rng.integers(0, 6, self.points)
        p[np.arange(self.points), wall % 3] = np.where(wall < 3, 1.0, -1.0) * half[wall % 3]
        self.position = p
        self.descriptor = rng.integers(0, 256, (self.points, 32), dtype=np.uint8)
        corners = [np.array([x, y, z]) * half for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        edges = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if np.count_nonzero(a != b) == 1]
        for _ in range(self.marks):
            a, axis = rng.uniform(-half, half), rng.permutation(3)
            a[axis[0]] = rng.choice([-1.0, 1.0]) * half[axis[0]]
            b = a.copy()
            b[axis[1]] = np.clip(a[axis[1]] + rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.5), -half[axis[1]], half[axis[1]])
            edges.append((a, b))
        self.lines = np.array(edges)
        self.line_descriptor = rng.integers(0, 256, (len(edges), 32), dtype=np.uint8)
        n = np.concatenate([-np.eye(3), np.eye(3)])
        self.planes = transform_planes(INTO_CORNER, np.concatenate([n, np.tile(half, 2)[:, None]], axis=1))  # normals into the room
        self.position, self.lines = transform(INTO_CORNER, self.position), transform(INTO_CORNER, self.lines)

    def frame(self, index):
        depth = np.full((CAMERA.height, CAMERA.width), 2.5, np.float32)
        return Frame(index, index * 33_000_000, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)

    def seen(self, T, index, farther=1.0):
        """The frame with the depth of the walls in every pixel, times `farther`."""
        u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
        local = transform_planes(invert(T), self.planes)
        with np.errstate(divide="ignore"):
            z = -local[:, 3] / (rays @ local[:, :3].T)
        depth = farther * np.where(z > 0.0, z, np.inf).min(axis=-1)
        return Frame(index, index * 33_000_000, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), CAMERA)

    def rng(self, index):
        return np.random.default_rng([self.seed, 1, index])

    def keypoints(self, T, index, keep=1.0):
        """Key points in the order of the world's points, and the world's row of each; a share `keep` of those in view."""
        rng = self.rng(index)
        local = transform(invert(T), self.position)
        px = CAMERA.project(local)
        with np.errstate(invalid="ignore"):
            seen = np.flatnonzero((px >= 2.0).all(1) & (px[:, 0] < 638) & (px[:, 1] < 478) & (local[:, 2] > 0.3) & (rng.random(len(px)) < keep))
        sigma = CAMERA.depth_noise.sigma_m(local[seen, 2])
        px = px[seen] + self.noise * rng.normal(size=(len(seen), 2))
        z = local[seen, 2] + self.noise * sigma * rng.normal(size=len(seen))
        z[rng.random(len(seen)) < 0.2] = np.nan
        return Keypoints(
            index, index * 33_000_000, px.astype(np.float32), CAMERA.back_project(px, z).astype(np.float32), np.ones(len(seen), np.float32),
            np.where(np.isfinite(z), sigma, np.nan).astype(np.float32), np.zeros(len(seen), np.uint8), np.zeros(len(seen), np.float32),
            self.descriptor[seen],
        ), seen  # fmt: skip

    def segments(self, T, index):
        """Segments in view, and the world's row of each."""
        rng = self.rng(index)
        local = transform(invert(T), self.lines)
        px, inside = clip_segments(self.lines, invert(T), CAMERA)
        seen = np.flatnonzero(inside & (np.linalg.norm(px[:, 1] - px[:, 0], axis=1) > 40.0))
        ends = np.array([[self._on_line(local[i], pixel) for pixel in px[i]] for i in seen]).reshape(-1, 2, 3)
        sigma = CAMERA.depth_noise.sigma_m(ends[..., 2])
        covariance = point_covariance(ends, np.ones(ends.shape[:2]), sigma, CAMERA)
        ends = ends * (1.0 + self.noise * sigma / ends[..., 2] * rng.normal(size=ends.shape[:2]))[..., None]
        px = px[seen] + self.noise * rng.normal(size=(len(seen), 2, 2))
        ends[rng.random(len(seen)) < 0.2] = np.nan
        return Segments(
            index, index * 33_000_000, px.astype(np.float32), ends.astype(np.float32), covariance.astype(np.float32), self.line_descriptor[seen]
        ), seen  # fmt: skip

    @staticmethod
    def _on_line(line, pixel):
        ray = np.array([(pixel[0] - CAMERA.cx) / CAMERA.fx, (pixel[1] - CAMERA.cy) / CAMERA.fy, 1.0])
        A = np.stack([line[1] - line[0], -ray], axis=1)
        s = np.linalg.lstsq(A, -line[0], rcond=None)[0][0]
        return line[0] + s * (line[1] - line[0])

    def plane_regions(self, T, index):
        """Walls in view as planes fitted to noisy depth, and the world's row of each; largest first."""
        rng = self.rng(index)
        u, v = np.meshgrid(np.arange(4, 640, 8.0), np.arange(4, 480, 8.0))
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)
        local = transform_planes(invert(T), self.planes)
        with np.errstate(divide="ignore"):
            z = -local[:, 3] / (rays @ local[:, :3].T)
        z[z <= 0.0] = np.inf
        hit, z = z.argmin(axis=1), z.min(axis=1)
        sigma = CAMERA.depth_noise.sigma_m(z)
        measured = z + self.noise * sigma * rng.normal(size=len(z))
        rows = [k for k in np.argsort(-np.bincount(hit, minlength=6), kind="stable") if np.count_nonzero(hit == k) > 60]
        fits = [self._fit(rays[hit == k], measured[hit == k], (sigma / z**2)[hit == k], rng) for k in rows]
        stacked = [np.array(part) for part in zip(*fits)]
        labels = np.zeros((60, 80), np.uint8)
        for i, k in enumerate(rows):
            labels[hit.reshape(60, 80) == k] = i + 1
        return Planes(
            index, index * 33_000_000, stacked[0], stacked[1], stacked[2], np.array([64 * np.count_nonzero(hit == k) for k in rows], np.int32),
            stacked[3].astype(np.float32), labels, 8,
        ), np.array(rows)  # fmt: skip

    @staticmethod
    def _fit(rays, z, sigma, rng):
        """Least squares of q in `q·ray = 1/z` (linear, without bias); n = -q/|q|, d = 1/|q|. Coefficients, covariance, moments, samples."""
        weighted = rays / sigma[:, None]
        A = weighted.T @ weighted
        q = np.linalg.solve(A, weighted.T @ (1.0 / z / sigma))
        d = 1.0 / np.linalg.norm(q)
        n = -q * d
        J = np.concatenate([-d * tangent_basis(n).T, d * d * n[None]])
        x = rays * z[:, None]
        h = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        return np.array([*n, d]), J @ np.linalg.inv(A) @ J.T, (h / (sigma * z**2)[:, None] ** 2).T @ h, x[rng.choice(len(x), SAMPLES, replace=False)]

    def features(self, T, index):
        return self.keypoints(T, index)[0], self.segments(T, index)[0], self.plane_regions(T, index)[0]


def rotation_of(T, index, sigma_deg=0.3, source="manhattan", off_deg=0.0):
    """A Rotation said with the given standard deviation, wrong by `off_deg` about an oblique axis."""
    R = T[:3, :3] @ exp_se3(np.array([0, 0, 0, 1, 1, 1]) / np.sqrt(3.0) * np.radians(off_deg))[:3, :3]
    none = np.empty((0, 3, 3))
    covariance = np.eye(3) * np.radians(sigma_deg) ** 2
    return Rotation(index, index * 33_000_000, R, covariance, none, none, np.empty(0, np.int32), np.empty(0), source)


def translation_of(T, index, off_m=(0.0, 0.0, 0.0), sigma_m=0.01, estimated=True):
    """A Translation wrong by `off_m`."""
    return Translation(
        index, index * 33_000_000, T[:3, 3] + off_m, np.eye(3) * sigma_m**2, np.empty((0, 3)), np.array([50, 5, 3], np.int32), estimated
    )


def camera_at(step):
    """A path through the middle of the room, 2 cm and 0.6° a step; the identity at 0."""
    return pose_matrix(exp_se3(np.radians([0, 0, 0, 0.2, 0.6, 0.1]) * step)[:3, :3], np.array([0.02, 0.004, 0.012]) * step)


def pose_of(T, index):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, "ok", "")


def tracks_of(world, before, now, depth=True, most=None):
    """Key points of two camera steps and the true tracks between them, without the previous depth unless `depth`."""
    (a, rows_a), (b, rows_b) = world.keypoints(camera_at(before), before), world.keypoints(camera_at(now), now)
    _, i, j = np.intersect1d(rows_a, rows_b, return_indices=True)
    pairs = np.stack([i, j], axis=1).astype(np.int32)[:most]
    points = a.points_m[pairs[:, 0]] if depth else np.full((len(pairs), 3), np.nan, np.float32)
    none, n3 = np.zeros((0, 2), np.int32), np.zeros((0, 3, 3))
    R = np.eye(3)
    tracks = Tracks(now, now, before, pairs, points, a.sigma_m[pairs[:, 0]], none, np.zeros((0, 2, 3), np.float32), none, np.zeros((0, 4)), n3, R)
    return tracks, a, b
