"""Frames made from formulas, for the feature stages; features of a room seen from known poses, for the stages after them."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, tangent_basis, transform, transform_planes
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import EXACT_DEPTH, Camera, DepthNoise, Frame, Keypoints, ManhattanFrame, Planes, Segments
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE

sys.path.insert(0, str(Path(__file__).parent))
from direction_world import Directions

EXACT = Camera(640, 480, 525.0, 520.0, 319.5, 239.5, depth_noise=EXACT_DEPTH)
SENSOR = Camera(640, 480, 525.0, 520.0, 319.5, 239.5, depth_noise=DepthNoise())


class Analytic:
    """Depth of simple surfaces along every pixel's ray; 0 where none is hit."""

    exact, sensor = EXACT, SENSOR

    @staticmethod
    def rays(camera):
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)

    @classmethod
    def plane(cls, normal, d, camera=EXACT):
        """Depth of n·x + d = 0; n is normalised here."""
        n = np.asarray(normal, float) / np.linalg.norm(normal)
        with np.errstate(divide="ignore"):
            z = -d / (cls.rays(camera) @ n)
        return np.where((z > 0.05) & (z < 10.0), z, 0.0)

    @classmethod
    def cylinder(cls, x, z, radius, camera=EXACT):
        """Depth of an upright cylinder with its axis through (x, z)."""
        r = cls.rays(camera)[..., 0]
        a, b, c = r * r + 1.0, r * x + z, x * x + z * z - radius * radius
        root = b * b - a * c
        return np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.0)

    @staticmethod
    def nearest(*depths):
        stack = np.stack([np.where(z > 0.0, z, np.inf) for z in depths])
        return np.where(np.isfinite(stack.min(0)), stack.min(0), 0.0)

    @staticmethod
    def noisy(depth, camera=SENSOR, seed=0):
        """Independent Gaussian noise of the camera's own model."""
        noise = np.random.default_rng(seed).standard_normal(depth.shape) * camera.depth_noise.sigma_m(depth)
        return np.where(depth > 0.0, depth + noise, 0.0)

    @staticmethod
    def frame(depth, camera=EXACT, gray=None):
        gray = np.zeros(depth.shape, np.uint8) if gray is None else gray
        return Frame(7, 7_000, np.repeat(gray[..., None], 3, axis=2), depth.astype(np.float32), camera)


@pytest.fixture(scope="session")
def analytic():
    return Analytic


class Room:
    """Points, edges and walls with known places, and what a camera at a known pose sees of them."""

    camera = SENSOR

    def __init__(self, seed=0, points=300, edges=30, axes=None):
        rng = np.random.default_rng(seed)
        self.axes = np.eye(3) if axes is None else axes  # columns: R_world_manhattan
        self.points = rng.uniform([-1.8, -1.3, 2.0], [1.8, 1.3, 4.0], (points, 3))
        self.point_bits = rng.integers(0, 256, (points, 32), dtype=np.uint8)
        self.octaves = rng.integers(0, 4, points).astype(np.uint8)
        middle = rng.uniform([-1.0, -0.8, 2.5], [1.0, 0.8, 3.5], (edges, 3))
        along = self.axes.T[rng.integers(0, 3, edges)] * rng.uniform(0.3, 0.8, (edges, 1))
        self.edges = np.stack([middle - 0.5 * along, middle + 0.5 * along], axis=1)
        self.edge_bits = rng.integers(0, 256, (edges, 32), dtype=np.uint8)
        self.walls = np.stack([np.append(-self.axes[:, k], 3.0 + 0.3 * k) for k in (2, 0, 1)])
        spread = rng.uniform(-1.0, 1.0, (3, 32, 3))
        self.samples = spread - ((spread * self.walls[:, None, :3]).sum(-1) + self.walls[:, None, 3])[..., None] * self.walls[:, None, :3]

    def keypoints(self, T_world_camera, index, rng, noise=1.0, share=0.9):
        p = transform(invert(T_world_camera), self.points)
        pixels = self.camera.project(p) + rng.normal(0, 0.5 * noise, (len(p), 2))
        sigma = self.camera.depth_noise.sigma_m(p[:, 2])
        depth = p[:, 2] + rng.normal(0, 1, len(p)) * sigma * noise
        good = np.isfinite(pixels).all(axis=1) & (pixels > 0).all(axis=1) & (pixels < [640, 480]).all(axis=1) & (rng.random(len(p)) < share)
        keep = rng.permutation(np.flatnonzero(good))
        f32 = np.float32
        return Keypoints(
            index, index * 33_000_000, pixels[keep].astype(f32), self.camera.back_project(pixels, depth)[keep].astype(f32),
            np.ones(len(keep), f32), sigma[keep].astype(f32), self.octaves[keep], np.zeros(len(keep), f32), self.point_bits[keep],
        )  # fmt: skip

    def segments(self, T_world_camera, index, rng, noise=1.0):
        ends = transform(invert(T_world_camera), self.edges)
        pixels = self.camera.project(ends) + rng.normal(0, 0.5 * noise, (*ends.shape[:2], 2))
        ends = ends + rng.normal(0, 0.004 * noise, ends.shape)
        covariance = np.tile(np.eye(3) * 0.004**2, (len(ends), 2, 1, 1))
        keep = rng.permutation(np.flatnonzero(np.isfinite(pixels).all(axis=(1, 2))))
        f32 = np.float32
        return Segments(
            index, index * 33_000_000, pixels[keep].astype(f32), ends[keep].astype(f32), covariance[keep].astype(f32), self.edge_bits[keep]
        )

    def planes(self, T_world_camera, index, rng, noise=1.0, walls=(0, 1, 2)):
        walls = np.array(walls, int)
        T = invert(T_world_camera)
        moved = transform_planes(T, self.walls[walls])
        tilt = tangent_basis(moved[:, :3]) @ rng.normal(0, np.radians(0.2) * noise, (len(walls), 2, 1))
        n = moved[:, :3] + tilt[..., 0]
        d = moved[:, 3:] + rng.normal(0, 0.004 * noise, (len(walls), 1))
        n = n / np.linalg.norm(n, axis=1, keepdims=True)
        covariance = np.tile(np.diag([np.radians(0.2) ** 2, np.radians(0.2) ** 2, 0.004**2]), (len(walls), 1, 1))
        return Planes(
            index, index * 33_000_000, np.concatenate([n, d], axis=1), covariance, np.zeros((len(walls), 4, 4)), np.full(len(walls), 40000, np.int32),
            transform(T, self.samples[walls]).astype(np.float32), np.zeros((240, 320), np.uint8), 2,
        )  # fmt: skip

    def see(self, T_world_camera, index, rng, **kinds):
        """(keypoints, segments, planes); a kind given as False is empty, without `depth` they are pixels alone, and `share` of the points in view
        is detected."""
        share = kinds.get("share", 0.9)
        k = self.keypoints(T_world_camera, index, rng, share=share)
        s, p = self.segments(T_world_camera, index, rng), self.planes(T_world_camera, index, rng)
        if not kinds.get("points", True):
            k = self.keypoints(T_world_camera, index, rng, share=-1.0)
        if not kinds.get("lines", True):
            s = replace(s, **{name: getattr(s, name)[:0] for name in ("endpoints_px", "endpoints_m", "covariance_m2", "descriptors")})
        if not kinds.get("walls", True):
            p = self.planes(T_world_camera, index, rng, walls=())
        if not kinds.get("depth", True):
            k = replace(k, points_m=np.full_like(k.points_m, np.nan), sigma_m=np.full_like(k.sigma_m, np.nan))
            s = replace(s, endpoints_m=np.full_like(s.endpoints_m, np.nan), covariance_m2=np.full_like(s.covariance_m2, np.nan))
            p = self.planes(T_world_camera, index, rng, walls=())
        return k, s, p

    def manhattan(self, R_world_camera, index, rng, sigma_deg=0.3, axes=None, supported=True, turn=0):
        """The frame of `axes`, else of the room; `turn` picks one of its 24 names."""
        R = exp_so3(rng.normal(0, np.radians(sigma_deg), 3)) @ R_world_camera.T @ (self.axes if axes is None else axes) @ CUBE[turn]
        sigma = sigma_deg if supported else 30.0
        return ManhattanFrame(
            index, index * 33_000_000, R[None], np.zeros(1, np.int32), (np.eye(3) * np.radians(sigma) ** 2)[None],
            np.full((1, 3), 100, np.int32), np.full((1, 3), 0.05), supported,
        )  # fmt: skip


@pytest.fixture(scope="session")
def room():
    return Room


@pytest.fixture(scope="session")
def directions():
    return Directions
