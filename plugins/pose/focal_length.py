"""What is said of poses under focal lengths that may be wrong, which squeeze the world: nothing is known as well as it seems then."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, rotation_angle_deg
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.types import DEGRADED, F32, F64, I32, U8, Camera, Keypoints, Map, Matches
from trihedron.plugins.mapping.covisibility_graph import current_submap, keyframes_of, newest_keyframes
from trihedron.plugins.mapping.keyframe_features import measured_points
from trihedron.plugins.pose.focal_length_kernels import (
    KEYFRAMES,
    LEAST_PAIRS,
    LEAST_POINTS,
    PRIOR,
    ROW_BITS,
    VIEW_BITS,
    places_kernel,
    solve,
    totals_kernel,
)
from trihedron.plugins.pose.map_alignment import MapAlignment, Verdict
from trihedron.plugins.shared.pose_optimizer import PoseSolution


@dataclass(frozen=True)
class FocalLengths:
    """How wrong focal lengths may be, by what keyframes say (`focal_check`) and, while these are few, the frame's motion (`focal_motion`)."""

    focal_off: PositiveFloat = 0.1  # share by which the focal lengths are off, beyond which a pose is called degraded, if the map's newest keyframes
    focal_worse: PositiveFloat = 0.2  # fit by this share worse for it
    focal_sure: PositiveFloat = 2.0  # or, while these are few, standard deviations by which the points that move tell so

    def judged_by_focal_lengths(self, found: PoseSolution, problem: MapAlignment, said: Verdict) -> Verdict:
        """What is said of a pose; degraded where the focal lengths are wrong, and less well known while the data do not say yet that they are
        right."""
        map, keypoints, matches = problem.map, problem.keypoints, problem.matches
        if (check := focal_check(map)) is not None and (doubt := check.doubt(self.focal_off, self.focal_worse)):
            first = map.keyframes.rows("T_world_camera", keyframes_of(map, current_submap(map))[:1])[0]
            depths_m = keypoints.points_m[matches.keypoints[:, 0], 2]
            return Verdict(DEGRADED, doubt, said.covariance + check.covariance(invert(first) @ found.T_world_camera, depths_m))
        motion = focal_motion(map, problem.camera, keypoints, matches, found.points, found.T_world_camera)
        if motion is None or motion.verified(self.focal_off, self.focal_sure):
            return said
        doubt = motion.doubt(self.focal_off, self.focal_sure)
        if not doubt and len(map.keyframes) > 1:  # keyframes would hand it on to landmarks, as if it were the error of each
            return said
        covariance = said.covariance + motion.covariance(self.focal_off)
        return Verdict(DEGRADED, doubt, covariance) if doubt else replace(said, covariance=covariance)


FACTORS = np.exp(np.linspace(np.log(0.7), -np.log(0.7), 5))


@dataclass(frozen=True)
class FocalCheck:
    """The factor under which the keyframes fit best, and how many times worse they fit under those they were told."""

    factor: float
    worse: float

    def doubt(self, off: float, worse: float) -> str:
        """Why to doubt, where the keyframes fit by a share `worse` worse under the focal lengths told than under others, a share `off` away;
        else ''."""
        if abs(np.log(self.factor)) <= np.log1p(off) or self.worse <= 1.0 + worse:
            return ""
        return f"keyframes fit each other with focal lengths {self.factor:.2f} times as long; is the camera right?"

    def covariance(self, T_first_camera: F64, depths_m: F32) -> F64:
        """(6, 6) about what the factor does to a pose T_first_camera (4, 4) from the first keyframe that sees points at these depths (NaN: none): a
        turn is wrong by that share of it, and so is a shift, which at a distance a turn is mistaken for."""
        seen = depths_m[np.isfinite(depths_m)]
        wrong, angle = np.log(self.factor), np.radians(rotation_angle_deg(T_first_camera[:3, :3]))
        shift_m = float(np.linalg.norm(T_first_camera[:3, 3])) + (float(np.median(seen)) if len(seen) else 0.0) * angle
        return np.diag(np.repeat([(wrong * shift_m) ** 2, (wrong * angle) ** 2], 3))


def focal_check(map: Map) -> FocalCheck | None:
    """What the newest keyframes say; None while they are too few, share too little, or see it all from one place."""
    if "focal" not in map.memo:
        map.memo["focal"] = _checked(map)
    found: FocalCheck | None = map.memo["focal"]
    return found


def _checked(map: Map) -> FocalCheck | None:
    keyframes = newest_keyframes(map, KEYFRAMES)
    if not len(keyframes):
        return None
    seen, middle = _measured(map, keyframes), len(FACTORS) // 2
    total = np.full(len(FACTORS), np.inf)
    total[middle - 1 : middle + 2], pairs = totals_kernel(*seen, FACTORS[middle - 1 : middle + 2].copy())
    if pairs < LEAST_PAIRS:
        return None
    if np.argmin(total) != middle:  # rarely; the farther ones are needed then
        total[[0, -1]] = totals_kernel(*seen, FACTORS[[0, -1]])[0]
    best = int(np.argmin(total))
    if not 0 < best < len(FACTORS) - 1:  # no least one: views from one place say nothing, and noise the rest
        return None
    a, b, c = total[best - 1 : best + 2]
    step = 0.5 * (a - c) / max(a - 2.0 * b + c, 1e-9)  # of the parabola through the least and its neighbours
    factor = float(FACTORS[best] * (FACTORS[1] / FACTORS[0]) ** step)
    return FocalCheck(factor, float(total[middle] / total[best]))


def _measured(map: Map, keyframes: I32) -> tuple[NDArray[np.int64], I32, F64]:
    """What the keyframes (k,) saw, n rows in all: which rows are which points, a number of keyframe, id and row each (`ROW_BITS`), sorted; the ids
    (n,); and (n, 5) x, y, z, and the σ of depth and of a pixel there, m, NaN without depth."""
    ranges, intrinsics = map.keyframes.gathered(keyframes, "points", "intrinsics")
    rows, views = np.concatenate([np.arange(first, end) for first, end in ranges]), np.repeat(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0])
    ids, pixels, depths_m, sigmas_m = map.point_observations.gathered(rows, "point", "pixel", "depth_m", "sigma_m")
    order = np.sort((views << VIEW_BITS) + (ids.astype(np.int64) << ROW_BITS) + np.arange(len(ids)))
    return order, ids, places_kernel(views, pixels, depths_m, sigmas_m, intrinsics)


@dataclass(frozen=True)
class FocalMotion:
    """By which factor the focal lengths told are too short, the standard deviation of its logarithm, and the effect (6,) of that logarithm: how xi of
    the pose changes with it."""

    factor: float
    sigma: float
    effect: F64

    def doubt(self, off: float, sure: float) -> str:
        """Why to doubt, where the factor is more than a share `off` away from one by `sure` standard deviations; else ''. No camera is told focal
        lengths as wrong as `FACTORS` end; a factor beyond is of a scene that moves."""
        if abs(np.log(self.factor)) - np.log1p(off) <= sure * self.sigma:
            return ""
        if not FACTORS[0] < self.factor < FACTORS[-1]:
            return "what is seen does not move as one thing at rest"
        return f"what is seen moves as under focal lengths {self.factor:.2f} times as long; is the camera right?"

    def verified(self, off: float, sure: float) -> bool:
        """Whether the factor is less than a share `off` away from one by `sure` standard deviations."""
        return float(abs(np.log(self.factor))) + sure * self.sigma < np.log1p(off)

    def covariance(self, off: float) -> F64:
        """(6, 6) what the factor adds to that of the pose found under the focal lengths told, which are off by about a share `off` beforehand: the
        second moment of its logarithm, since the pose stays where it is."""
        data = self.sigma**-2 - PRIOR**-2
        variance = 1.0 / (data + np.log1p(off) ** -2)
        mean = variance * np.log(self.factor) * self.sigma**-2
        return np.asarray((variance + mean**2) * np.outer(self.effect, self.effect))


def focal_motion(map: Map, camera: Camera, keypoints: Keypoints, matches: Matches, agreed: U8, T_world_camera: F64) -> FocalMotion | None:
    """What the points (flags `agreed`) say that the first keyframe measured as well. None where they are too few, and once there are enough keyframes
    to tell by themselves (`focal_check`)."""
    keyframes = newest_keyframes(map, KEYFRAMES)
    if not 0 < len(keyframes) < KEYFRAMES:
        return None
    row = int(keyframes[0])
    if "focal_first" not in map.memo:
        map.memo["focal_first"] = measured_points(map, row)
    ids, places, sigma_m, sigma_px = map.memo["focal_first"]
    pairs = matches.keypoints[(agreed > 0) & np.isfinite(keypoints.points_m[matches.keypoints[:, 0], 2])]
    at = np.minimum(np.searchsorted(ids, pairs[:, 1]), max(len(ids) - 1, 0))
    same = ids[at] == pairs[:, 1] if len(ids) else np.zeros(len(pairs), np.bool_)
    now, at = pairs[same, 0], at[same]
    if len(now) < LEAST_POINTS:
        return None
    seen = np.column_stack([keypoints.pixels[now], keypoints.points_m[now, 2]]).astype(np.float64)
    zoom = camera.fx / map.keyframes.rows("intrinsics", np.array([row]))[0, 0]  # 1 unless the resolution has changed
    noise_px = (zoom * sigma_px[at]) ** 2 + keypoints.sigma_px[now].astype(np.float64) ** 2
    noise_m = sigma_m[at] ** 2 + keypoints.sigma_m[now].astype(np.float64) ** 2
    T = invert(T_world_camera) @ map.keyframes.rows("T_world_camera", np.array([row]))[0]
    t = T[:3, 3].copy()
    factor, sigma, turned, shifted = solve(places[at], seen, noise_px, noise_m, camera.intrinsics, T[:3, :3].copy(), t)
    return FocalMotion(factor, sigma, np.concatenate([np.cross(turned, t) - shifted, -turned]))
