"""Closed walks along way-points: where a walker with a hand-held camera is at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.datasets.simulation.motion import TREMOR_DEG, TREMOR_M, Sway, looking
from trihedron.pipeline.core.types import F64

STEP_M = 0.01  # between the samples of a path; its chords are within 0.05 mm of the curve
ROUNDING_M = 0.25  # standard deviation of the Gaussian that rounds the corners of the path
HEIGHT_M, PITCH_DEG = 1.45, -6.0
STEPS_M = Sway((0.03, 0.03, 0.012), (5.3, 4.1, 0.53))  # from the path: the walker's wavering and steps
GAZE_DEG = Sway((14.0, 5.0, 2.0), (7.3, 5.7, 4.9))  # yaw, pitch, roll


@dataclass(frozen=True)
class Walk:
    """Round and round along closed way-points (metres on the floor), looking where the path leads and a little about. `floors_m` are the heights of
    the floor at the way-points, none = 0."""

    points_m: tuple[tuple[float, float], ...]
    speed_m_s: float
    looking_ahead_m: float  # standard deviation of the Gaussian that smooths the heading along the path
    floors_m: tuple[float, ...] = ()
    gaze_deg: Sway = GAZE_DEG  # yaw, pitch, roll about that

    @property
    def duration_s(self) -> float:
        """Once round."""
        return self.length_m / self.speed_m_s

    @property
    def length_m(self) -> float:
        """Length of the way-points' polygon."""
        corners = np.array(self.points_m)
        return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum())

    def pose(self, seed: int, time_s: float) -> F64:
        """(4, 4) `T_world_camera` at a time. The seed sets the phases of what is not the path."""
        phases = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, size=(4, 3))
        x, y, yaw, floor = self._at(self.speed_m_s * time_s)
        position = np.array([x, y, HEIGHT_M + floor]) + STEPS_M.at(time_s, phases[0]) + TREMOR_M.at(time_s, phases[1])
        angles = np.array([0.0, PITCH_DEG, 0.0]) + self.gaze_deg.at(time_s, phases[2]) + TREMOR_DEG.at(time_s, phases[3])
        return looking(position, np.radians(angles) + np.array([yaw, 0.0, 0.0]))

    def _at(self, along_m: float) -> F64:
        """(x, y, yaw, floor) at an arc length of the polygon, interpolated."""
        samples, turns = self._samples
        rounds, place = divmod(along_m / self.length_m, 1.0)
        number = place * (len(samples) - 1)
        low = min(int(number), len(samples) - 2)
        found = samples[low] + (number - low) * (samples[low + 1] - samples[low])
        return np.asarray(found + np.array([0.0, 0.0, rounds * turns, 0.0]), np.float64)

    @cached_property
    def _samples(self) -> tuple[F64, float]:
        """(n + 1, 4) x, y, yaw (rad, continuous), height of the floor once round, the last row being the first again, and the yaw that a round
        adds."""
        corners = np.array((*self.points_m, self.points_m[0]))
        lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        count = round(self.length_m / STEP_M)
        along = (np.arange(count) + 0.5) * self.length_m / count
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        xy = np.stack([np.interp(along, ends, corners[:, k]) for k in (0, 1)], axis=1)
        side = np.minimum(np.searchsorted(ends, along, side="right") - 1, len(lengths) - 1)
        turning = np.angle(np.exp(1j * np.diff(np.arctan2(*np.diff(corners, axis=0).T[::-1]), append=0.0)))
        first = float(np.arctan2(*(corners[1] - corners[0])[::-1]))
        turning[-1] = np.angle(np.exp(1j * (first - np.arctan2(*(corners[-1] - corners[-2])[::-1]))))
        turns = float(turning.sum())
        yaw = first + np.concatenate([[0.0], np.cumsum(turning[:-1])])[side]
        ramp = turns * along / self.length_m  # what is left of the yaw without it is periodic
        step = self.length_m / count
        heading = _blur_values((yaw - ramp)[:, None], self.looking_ahead_m / step) + ramp[:, None]
        floor = np.interp(along, ends, [*self.floors_m, self.floors_m[0]])[:, None] if self.floors_m else np.zeros((count, 1))
        smooth = np.column_stack([_blur_values(xy, ROUNDING_M / step), heading, _blur_values(floor, ROUNDING_M / step)])
        return np.concatenate([smooth, smooth[:1] + np.array([0.0, 0.0, turns, 0.0])]), turns


def _blur_values(values: F64, sigma: float) -> F64:
    """(n, k) periodic values under a Gaussian of `sigma` samples."""
    frequency = np.fft.rfftfreq(len(values))
    return np.asarray(np.fft.irfft(np.fft.rfft(values, axis=0) * np.exp(-2.0 * (np.pi * sigma * frequency) ** 2)[:, None], len(values), axis=0))
