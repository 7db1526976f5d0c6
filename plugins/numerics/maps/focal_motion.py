"""What a frame says of the focal lengths it was told: turned by a degree, points a keyframe measured move otherwise under wrong ones.

A turn by θ moves a point at depth z by θ z across and by θ x in depth. Under focal lengths that are wrong by a factor the one is stretched and the
other squeezed, so that no rigid motion is both. The factor is one more unknown of the motion, found with its standard deviation: at first, before
the camera has turned, it is anything, and after some degrees it is known to a few per cent. Until then the motion is known only as well as the
factor is: its covariance is the marginal one over the factor, of which a camera's calibration says something beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import F64, U8, Frame, Keypoints, Map, Matches
from trihedron.plugins.numerics.algebra.small_linear import solve_positive, turn_left
from trihedron.plugins.numerics.maps.focal_check import FACTORS, KEYFRAMES, LEAST_POINTS
from trihedron.plugins.numerics.maps.keyframe_features import measured_points
from trihedron.plugins.numerics.maps.local_window import newest_keyframes

PRIOR = 0.5  # standard deviation of the factor's logarithm before anything is seen
CUT2 = 9.0  # squared standard deviations at which a point counts a quarter (Geman and McClure)
STEPS = 4  # of Gauss and Newton, from a pose that is nearly right


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


def focal_motion(map: Map, frame: Frame, keypoints: Keypoints, matches: Matches, agreed: U8, T_world_camera: F64) -> FocalMotion | None:
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
    camera = frame.camera
    seen = np.column_stack([keypoints.pixels[now], keypoints.points_m[now, 2]]).astype(np.float64)
    zoom = camera.fx / map.keyframes.rows("intrinsics", np.array([row]))[0, 0]  # 1 unless the resolution has changed
    noise_px = (zoom * sigma_px[at]) ** 2 + keypoints.sigma_px[now].astype(np.float64) ** 2
    noise_m = sigma_m[at] ** 2 + keypoints.sigma_m[now].astype(np.float64) ** 2
    T = invert(T_world_camera) @ map.keyframes.rows("T_world_camera", np.array([row]))[0]
    t = T[:3, 3].copy()
    factor, sigma, turned, shifted = _solve(places[at], seen, noise_px, noise_m, camera.intrinsics, T[:3, :3].copy(), t)
    return FocalMotion(factor, sigma, np.concatenate([np.cross(turned, t) - shifted, -turned]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(before: F64, seen: F64, noise_px: F64, noise_m: F64, told: F64, R: F64, t: F64) -> tuple[float, float, F64, F64]:
    """The factor, the deviation of its logarithm, and how that turns and shifts (3,) the motion, from places (n, 3) seen again at pixels and depths
    (n, 3) after the motion R, t, or nearly, which is made exact."""
    H, g, J, Jp, x = np.zeros((7, 7)), np.zeros(7), np.zeros((3, 7)), np.zeros((3, 3)), np.zeros(7)
    e, log_factor = np.zeros(3), 0.0
    for _ in range(STEPS):
        for a in range(7):
            g[a] = 0.0
            for b in range(7):
                H[a, b] = 0.0
        squeeze = np.exp(-log_factor)
        fx, fy = told[0] / squeeze, told[1] / squeeze
        for k in range(len(before)):
            a0, a1, a2 = squeeze * before[k, 0], squeeze * before[k, 1], before[k, 2]
            s0, s1, s2 = R[0, 0] * a0 + R[0, 1] * a1, R[1, 0] * a0 + R[1, 1] * a1, R[2, 0] * a0 + R[2, 1] * a1
            q0, q1, q2 = s0 + R[0, 2] * a2, s1 + R[1, 2] * a2, s2 + R[2, 2] * a2
            X, Y, z = q0 + t[0], q1 + t[1], q2 + t[2]
            u, v = fx * X / z, fy * Y / z
            e[0], e[1], e[2] = seen[k, 0] - told[2] - u, seen[k, 1] - told[3] - v, seen[k, 2] - z
            Jp[0, 0], Jp[0, 2], Jp[1, 1], Jp[1, 2], Jp[2, 2] = fx / z, -u / z, fy / z, -v / z, 1.0
            for i in range(3):
                J[i, 0] = Jp[i, 2] * q1 - Jp[i, 1] * q2  # phi × q
                J[i, 1] = Jp[i, 0] * q2 - Jp[i, 2] * q0
                J[i, 2] = Jp[i, 1] * q0 - Jp[i, 0] * q1
                J[i, 3], J[i, 4], J[i, 5] = Jp[i, 0], Jp[i, 1], Jp[i, 2]
                J[i, 6] = -(Jp[i, 0] * s0 + Jp[i, 1] * s1 + Jp[i, 2] * s2)
            J[0, 6] += u
            J[1, 6] += v
            px, m = 1.0 / noise_px[k], 1.0 / noise_m[k]
            distance = (e[0] * e[0] + e[1] * e[1]) * px + e[2] * e[2] * m
            w = (CUT2 / (CUT2 + distance)) ** 2
            for i in range(3):
                weight = w * (px if i < 2 else m)
                for a in range(7):
                    left = weight * J[i, a]
                    g[a] += left * e[i]
                    for b in range(a + 1):
                        H[a, b] += left * J[i, b]
        for a in range(7):
            for b in range(a):
                H[b, a] = H[a, b]
        H[6, 6] += 1.0 / PRIOR**2
        g[6] -= log_factor / PRIOR**2
        solve_positive(H, g, x)
        turn_left(x, R)
        for i in range(3):
            t[i] += x[3 + i]
        log_factor += x[6]
    for a in range(7):
        g[a] = 1.0 if a == 6 else 0.0
    turned, shifted = np.zeros(3), np.zeros(3)
    if not solve_positive(H, g, x):  # points that say nothing
        return np.exp(log_factor), PRIOR, turned, shifted
    for i in range(3):  # x is the covariance of all unknowns with the factor's logarithm
        turned[i], shifted[i] = x[i] / x[6], x[3 + i] / x[6]
    return np.exp(log_factor), np.sqrt(x[6]), turned, shifted
