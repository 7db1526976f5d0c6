"""Camera paths through the synthetic room: smooth, hand-held, a closed formula of time.

Positions and angles are sums of sines, so a path may be as long as one likes and stays in the free middle of the room. The walker steps back from
what is looked at. With the amplitudes and periods below the speed stays under 0.5 m/s and 40 °/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.types import F64


class Motion(Enum):
    """Motion of the camera: a walk looking around, the same with a hasty hand, not at all, or turning on the spot."""

    walk = "walk"
    fast = "fast"
    still = "still"
    pan = "pan"


CENTRE_M = (2.5, 2.0, 1.35)  # free space around it: 1.5 m in x, 1.2 m in y
STEP_BACK_M = (0.75, 0.45, 0.0)
START_YAW_DEG = 20.0  # towards a corner: two walls in view
PITCH_DEG = -6.0
TURN_DEG_PER_S = 6.0  # of the walk; a whole turn a minute
PAN_DEG_PER_S = 20.0
HASTE = 2.5  # a fast walk is the walk this much sooner, its tremor included: up to 1.25 m/s and 100 °/s


@dataclass(frozen=True)
class Sway:
    """amplitude · sin(2π t / period + phase) for each row."""

    amplitude: tuple[float, ...]
    period_s: tuple[float, ...]

    def at(self, time_s: float, phase: F64) -> F64:
        """(n,) values at a time."""
        return np.array(self.amplitude) * np.sin(2.0 * np.pi * time_s / np.array(self.period_s) + phase)


POSITION_M = Sway((0.32, 0.22, 0.06), (9.0, 7.0, 5.0))  # x, y, height
ANGLES_DEG = Sway((20.0, 6.0, 2.5), (7.3, 5.7, 4.9))  # yaw, pitch, roll
TREMOR_M = Sway((0.0012, 0.0012, 0.0012), (0.31, 0.37, 0.29))  # a hand's: a few hertz, millimetres, tenths of a degree
TREMOR_DEG = Sway((0.10, 0.10, 0.10), (0.27, 0.33, 0.41))


def camera_pose(motion: Motion, seed: int, time_s: float) -> F64:
    """(4, 4) `T_world_camera` at a time; the world is the room: origin in a corner of the floor, z up. The seed sets the phases."""
    phases = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, size=(4, 3))
    moving = 0.0 if motion is Motion.still else time_s
    if motion is Motion.fast:
        moving *= HASTE
    position = np.array(CENTRE_M)
    yaw, pitch, roll = START_YAW_DEG, PITCH_DEG, 0.0
    if motion is Motion.pan:
        return looking(position, np.radians([yaw + PAN_DEG_PER_S * moving, pitch, roll]))
    turned = np.radians(yaw + TURN_DEG_PER_S * moving)
    position = position - np.array(STEP_BACK_M) * np.array([np.cos(turned), np.sin(turned), 0.0])
    position = position + POSITION_M.at(moving, phases[0]) + TREMOR_M.at(moving, phases[1])
    angles = np.array([yaw + TURN_DEG_PER_S * moving, pitch, roll]) + ANGLES_DEG.at(moving, phases[2]) + TREMOR_DEG.at(moving, phases[3])
    return looking(position, np.radians(angles))


def looking(position_m: F64, angles: F64) -> F64:
    """Yaw about the vertical (0 = along x), pitch up, roll about the viewing direction (rad) -> (4, 4) pose of a camera with y down."""
    yaw, pitch, roll = angles
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return pose_matrix(np.stack([c * right + s * down, c * down - s * right, forward], axis=-1), position_m)
