"""Directions without surfaces: what the estimators of the Manhattan frame read."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.pipeline.core.registry import parameters_of_method
from trihedron.pipeline.core.types import ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent


class Directions:
    """Normals, segments and planes made from directions, without any surfaces: what the estimators of the Manhattan frame read."""

    rows, cols, stride = 60, 80, 8

    @staticmethod
    def rotation(rng):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        return exp_so3(2.0 * np.arccos(min(abs(q[3]), 1.0)) * q[:3] / max(np.linalg.norm(q[:3]), 1e-12))

    @staticmethod
    def spherical(rng, n):
        v = rng.normal(size=(n, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True)

    @staticmethod
    def circle(R, angles_deg, about=2):
        """Directions at right angles to column `about` of R, counted from the next one."""
        a, u, v = np.radians(np.atleast_1d(angles_deg))[:, None], R[:, (about + 1) % 3], R[:, (about + 2) % 3]
        return np.cos(a) * u + np.sin(a) * v

    @staticmethod
    def tilted(rng, directions, sigma_deg):
        """Directions (n, 3), either way round, with Gaussian noise of `sigma_deg`, one or (n,), in each tangent coordinate."""
        directions = np.asarray(directions, float).reshape(-1, 3) * rng.choice([-1.0, 1.0], (len(directions), 1))
        tilt = np.radians(sigma_deg) * rng.normal(size=(2, len(directions)))
        out = directions + (tangent_basis(directions) @ tilt.T[..., None])[..., 0]
        return out / np.linalg.norm(out, axis=1, keepdims=True)

    @classmethod
    def normals(cls, rng, surfaces=(), shares=(), noise_deg=3.0, index=0, clutter=True):
        """A grid: share i of the cells shows surface i with noise_deg (one, or one a surface), the rest no order (or nothing); 5 % are holes."""
        count = cls.rows * cls.cols
        which = np.full(count, -1)
        which[: int(count * sum(shares) + 0.5)] = np.repeat(np.arange(len(shares)), np.diff(np.round(np.cumsum([0, *shares]) * count)).astype(int))
        grid = cls.spherical(rng, count) if clutter else np.full((count, 3), np.nan)
        seen = which >= 0
        noise = np.broadcast_to(noise_deg, len(surfaces))[which[seen]] if len(surfaces) else 0.0
        grid[seen] = cls.tilted(rng, np.asarray(surfaces).reshape(-1, 3)[which[seen]], noise)
        grid = grid[rng.permutation(count)]
        grid[rng.random(count) < 0.05] = np.nan
        return Normals(index, index * 33_000_000, grid.reshape(cls.rows, cls.cols, 3).astype(np.float32), cls.stride)

    @classmethod
    def planes(cls, rng, surfaces=(), shares=(), sigma_deg=0.36, index=0):
        """One plane a surface, its normal off by `sigma_deg` (the estimators expect 0.2 of its covariance and 0.3 of walls that are not true)."""
        n = cls.tilted(rng, surfaces, sigma_deg)
        pixels = np.array([share * cls.rows * cls.cols * cls.stride**2 for share in shares], np.int32)
        covariance = np.tile(np.diag([np.radians(0.2) ** 2, np.radians(0.2) ** 2, 1e-5]), (len(n), 1, 1))
        return Planes(
            index, index * 33_000_000, np.concatenate([n, np.full((len(n), 1), 2.0)], axis=1), covariance, np.zeros((len(n), 4, 4)), pixels,
            np.zeros((len(n), 8, 3), np.float32), np.zeros((cls.rows, cls.cols), np.uint8), cls.stride,
        )  # fmt: skip

    @classmethod
    def segments(cls, rng, directions=(), tilt_deg=0.5, sigma_m=0.002, index=0):
        """Segments of 0.4 to 1.2 m about 3 m away."""
        n = len(directions)
        along = cls.tilted(rng, directions, tilt_deg) * rng.uniform(0.4, 1.2, (n, 1))
        middle = rng.uniform([-1, -1, 2.5], [1, 1, 3.5], (n, 3))
        ends = np.stack([middle - 0.5 * along, middle + 0.5 * along], axis=1)
        pixels = 500.0 * ends[..., :2] / ends[..., 2:] + [320, 240]
        ends = ends + rng.normal(0, sigma_m, ends.shape)
        covariance = np.tile(np.eye(3, dtype=np.float32) * sigma_m**2, (n, 2, 1, 1))
        f32 = np.float32
        return Segments(index, index * 33_000_000, pixels.astype(f32), ends.astype(f32), covariance, np.zeros((n, 32), np.uint8))

    @classmethod
    def room(cls, rng, R, axes=(0, 1, 2), shares=(0.3, 0.3, 0.3), lines=(5, 5, 5), noise_deg=3.0, index=0, strays=0):
        """(normals, segments, planes) of walls on `axes` of R, with `lines[k]` segments along axis k, `strays` of them and strays / 5 small planes
        any way."""
        walls = R.T[list(axes)]
        along = np.concatenate([np.repeat(R.T, lines, axis=0), cls.spherical(rng, strays)])
        planes = cls.planes(rng, [*walls, *cls.spherical(rng, strays // 5)], [*shares, *[0.03] * (strays // 5)], index=index)
        return cls.normals(rng, walls, shares, noise_deg, index, clutter=len(walls) > 0), cls.segments(rng, along, index=index), planes

    @classmethod
    def kinds(cls):
        """Name -> arguments of `room`: what a room may show."""
        return {
            "three planes, clean": {"noise_deg": 1.0, "lines": (0, 0, 0)},
            "three planes, noisy": {"noise_deg": 5.0, "lines": (0, 0, 0)},
            "two planes": {"axes": (0, 2), "shares": (0.45, 0.45), "lines": (0, 0, 0)},
            "one plane and lines": {"axes": (1,), "shares": (0.9,), "lines": (6, 0, 6)},
            "lines only": {"axes": (), "shares": (), "lines": (8, 8, 8)},
            "half clutter": {"shares": (0.2, 0.15, 0.15), "lines": (5, 5, 5), "strays": 15},
        }

    @classmethod
    def without_frame(cls, rng, R):
        """Name -> (normals, segments, planes) of scenes without two directions at right angles, or with every direction alike."""
        slanted, skewed = cls.circle(R, [0, 70]), cls.circle(R, [0, 82])
        tower = [R[:, 2], *cls.circle(R, np.arange(0, 360, 5))]
        bare = cls.segments(rng)
        return {
            "slanted walls": (cls.normals(rng, slanted, (0.45, 0.45)), bare, cls.planes(rng, slanted, (0.45, 0.45))),
            "8 degrees off": (cls.normals(rng, skewed, (0.45, 0.45)), bare, cls.planes(rng, skewed, (0.45, 0.45))),
            "no order": (cls.normals(rng), cls.segments(rng, cls.spherical(rng, 40)), cls.planes(rng)),
            "one wall": (cls.normals(rng, R.T[:1], (0.97,)), bare, cls.planes(rng, R.T[:1], (0.97,))),
            "lines any way on a wall": (
                cls.normals(rng, R.T[2:], (0.9,)), cls.segments(rng, cls.circle(R, 180 * rng.random(40))), cls.planes(rng, R.T[2:], (0.9,)),
            ),
            "round tower": (cls.normals(rng, tower, (0.3,) + (0.65 / 72,) * 72, 2.0), bare, cls.planes(rng, R.T[2:], (0.3,))),
            "nothing": (cls.normals(rng, clutter=False), bare, cls.planes(rng)),
        }  # fmt: skip

    @classmethod
    def awkward(cls, data):
        """Draws (normals, segments, planes, previous) that are empty, degenerate or not finite; `data` is hypothesis' `st.data()`."""
        rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1), label="seed"))
        R, draw = cls.rotation(rng), lambda label, *values: data.draw(st.sampled_from(values), label=label)
        small = type("Small", (cls,), {"rows": 12, "cols": 16, "stride": 40})
        surfaces, shares = draw("surfaces", ((), ()), ((0,), (1.0,)), ((0, 1), (0.5, 0.5)), ((2, 2), (0.6, 0.4)), ((0, 1, 2), (0.3, 0.3, 0.3)))
        normals = small.normals(rng, R.T[list(surfaces)], shares, draw("noise", 0.0, 3.0, 40.0), clutter=draw("clutter", True, False))
        grid = normals.normals.copy()
        grid[rng.random(grid.shape) < draw("broken", 0.0, 0.3, 1.0)] = draw("with", np.nan, np.inf, 0.0)
        lines = small.segments(rng, R.T[list(draw("lines", (), (0,), (0, 0), (0, 1), (0, 1, 2), (0, 1, 2) * 8))])
        ends, pixels, spread = (getattr(lines, name).copy() for name in ("endpoints_m", "endpoints_px", "covariance_m2"))
        ends[rng.random(len(ends)) < draw("lines broken", 0.0, 0.5, 1.0)] = draw("lines with", np.nan, np.inf, 0.0)
        pixels[rng.random(len(ends)) < draw("pixels broken", 0.0, 0.5)] = np.nan
        spread *= draw("line covariance", 1.0, 0.0, np.float32(np.nan))
        rows = list(draw("planes", (), (0,), (0, 0), (0, 1), (0, 1, 2), (0, 1, 2, 0, 1)))
        planes = small.planes(rng, R.T[rows], [0.2] * len(rows), draw("tilt", 0.0, 0.4, 20.0))
        coefficients, covariance = planes.coefficients.copy(), planes.covariance.copy()
        coefficients[rng.random(len(rows)) < draw("planes broken", 0.0, 0.5, 1.0)] = draw("planes with", np.nan, np.inf)
        covariance *= draw("plane covariance", 1.0, 0.0, np.nan, -1.0)
        pixels_of_planes = (planes.pixels * draw("size", 0, 1)).astype(np.int32)
        previous = draw("previous", None, True, False)
        return (
            replace(normals, normals=grid),
            replace(lines, endpoints_m=ends, endpoints_px=pixels, covariance_m2=spread),
            replace(planes, coefficients=coefficients, covariance=covariance, pixels=pixels_of_planes),
            None if previous is None else cls.frame(cls.rotation(rng), previous),
        )

    @staticmethod
    def frame(R, supported=True, ids=(0,)):
        """What an estimator may have said before: R (3, 3) or (k, 3, 3)."""
        R = np.asarray(R).reshape(-1, 3, 3)
        k, sigma = len(R), np.radians(0.5 if supported else 30.0)
        return ManhattanFrame(
            0,
            0,
            R,
            np.array(ids, np.int32),
            np.tile(np.eye(3) * sigma**2, (k, 1, 1)),
            np.full((k, 3), 100, np.int32),
            np.full((k, 3), 0.05),
            supported,
        )

    @staticmethod
    def estimate(estimator, value, previous=None):
        """What the estimator says of (normals, segments, planes), given those of them it asks for."""
        normals, segments, planes = value
        inputs = {"normals": normals, "segments": segments, "planes": planes, "previous": previous, "rng": np.random.default_rng(normals.index)}
        return estimator(**{name: inputs[name] for name in parameters_of_method("manhattan", type(estimator))})

    @classmethod
    def figures(cls, estimator, kind, count=200, seed=1):
        """Of `count` rooms of the kind, any way round, from nothing: share supported and within 1°, median error (deg), and the mean of the squared
        error in units of the covariance, 1 when that is right."""
        rng, errors, squares = np.random.default_rng(seed), [], []
        for _ in range(count):
            R = cls.rotation(rng)
            found = cls.estimate(estimator, cls.room(rng, R, **cls.kinds()[kind]))
            phi = log_so3(R @ nearest_equivalent(found.rotations[0], R).T)
            errors.append(cls.error_deg(found, R) if found.supported else 90.0)
            squares.append(phi @ np.linalg.solve(found.covariance[0], phi) / 3.0)
        return float(np.mean(np.array(errors) < 1.0)), float(np.median(errors)), float(np.mean(squares))

    @classmethod
    def claims(cls, estimator, count=15, seed=7):
        """Name of a scene without a Manhattan frame -> share of claims that there is one, half of them after a frame that had one."""
        rng, claims = np.random.default_rng(seed), {}
        for _ in range(count):
            R = cls.rotation(rng)
            previous = cls.estimate(estimator, cls.room(rng, R))
            for name, value in cls.without_frame(rng, R).items():
                found = [cls.estimate(estimator, value, before) for before in (None, previous)]
                for one in found:
                    cls.check(one)
                    assert one.supported or np.degrees(np.sqrt(np.linalg.eigvalsh(one.covariance[0])[-1])) > 15.0
                claims[name] = claims.get(name, 0.0) + sum(one.supported for one in found) / (2.0 * count)
        return claims

    @classmethod
    def turned(cls, estimator, scene, frames=61, step_deg=2.0, seed=5):
        """Errors (deg) of the naming of the first frame carried through a turn of `frames` × `step_deg` in the scene `scene(rng, R, k)`."""
        rng = np.random.default_rng(seed)
        start, axis, previous, errors, name = cls.rotation(rng), cls.spherical(rng, 1)[0], None, [], np.eye(3)
        for k in range(frames):
            R = exp_so3(axis * np.radians(step_deg * k)) @ start
            previous = cls.estimate(estimator, scene(rng, R, k), previous)
            if k == 0:
                name = R.T @ nearest_equivalent(R, previous.rotations[0])
            errors.append(rotation_angle_deg(previous.rotations[0].T @ R @ name))
        return errors

    @staticmethod
    def error_deg(found, R, row=0):
        """Angle between a rotation found and R under any of its 24 names."""
        return rotation_angle_deg(R.T @ nearest_equivalent(found.rotations[row], R))

    @staticmethod
    def check(found):
        """Whatever the input: rotations, finite covariances, ids of their own."""
        k = len(found.rotations)
        assert k >= 1 and len(set(found.ids.tolist())) == k
        assert np.allclose(found.rotations @ np.swapaxes(found.rotations, 1, 2), np.eye(3), atol=1e-9)
        assert np.allclose(np.linalg.det(found.rotations), 1.0)
        assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0) and np.all(np.isfinite(found.covariance))
        assert np.all(found.inliers >= 0) and not np.any(np.isinf(found.spread))
