"""Notice depth images that were taken at another time than their colour images, by the motion of the camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import log_se3
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import F64, LOST, Frame, Pose
from trihedron.pipeline.run.registration_check import color_gradient, depth_edges

OFFSETS_S, SHIFTS_PX = np.arange(-15, 16) * 0.01, np.arange(-8, 9, 4)  # searched; shifts along rows and columns, at 640 a line
UNSHIFTED = len(OFFSETS_S) // 2
BLUR_PX = 2.0  # at 640 a line
MIN_EDGES, SAMPLED_EDGES = 150, 200  # of a frame that is judged: pixels
EVERY, MIN_FRAMES, MAX_FRAMES = 3, 16, 24  # judged: every third, so many at least and at most
LONGEST_GAP_S = 0.3  # between two frames that a velocity is taken from
MIN_MOTION_PX, AT_M = 3.0, 2.0  # motion of the image in a tenth of a second, at 640 a line, of what is so far away
MIN_OFFSET_S, MIN_RATIO, MIN_T = 0.025, 1.2, 2.5  # of the best offset: of the scores with and without, and Student's t: see docs/decisions.md


@dataclass
class TimeOffsetCheck:
    """Compare where depth jumps with where colour does, as it is and with the camera moved on by its velocity for a time.

    A shift of depth that is common to all frames is free: depth that is not registered is another fault, and motion in one direction alone shows
    nothing. `_scores` holds one (offsets, rows, columns) mean colour gradient at the near side of the depth edges for each judged frame."""

    _scores: list[F64] = field(default_factory=list)
    _remaining: int = MAX_FRAMES
    _previous: Pose | None = None

    def __call__(self, frame: Frame, pose: Pose) -> str | None:
        """Add a frame and its pose. Returns, once, what is wrong and its cure."""
        previous, self._previous = self._previous, pose
        if previous is None or not self._remaining or frame.index % EVERY:
            return None
        seconds = 1e-9 * (pose.stamp_ns - previous.stamp_ns)
        if LOST in (previous.status, pose.status) or previous.submap != pose.submap or not 0.0 < seconds <= LONGEST_GAP_S:
            return None
        twist = log_se3(matmul(invert(previous.T_world_camera), pose.T_world_camera)) / seconds
        if frame.camera.fx * 0.1 * (norm(twist[3:]) + norm(twist[:3]) / AT_M) < MIN_MOTION_PX * frame.camera.width / 640.0:
            return None
        self._remaining -= 1
        if (scores := _offset_scores(frame, twist)) is not None:
            self._scores.append(scores)
        offset_s, ratio = _significant_offset(np.array(self._scores)) if len(self._scores) >= MIN_FRAMES else (0.0, 1.0)
        if not offset_s:
            return None
        self._remaining = 0
        side = "after" if offset_s > 0.0 else "before"
        return (
            f"depth was taken about {abs(1e3 * offset_s):.0f} ms {side} colour: by the camera's motion its edges fit those of colour {ratio:.1f} "
            f"times better then; pair colour with the depth of its own time: add {offset_s:.2f} to depth_delay_s of camera.yaml, or what trihedron "
            "calibrate estimates"
        )


def _offset_scores(frame: Frame, twist: F64) -> F64 | None:
    """(offsets, rows, columns) mean colour gradient at the depth edges of a camera that moves with `twist` (6,), in m/s and rad/s in its own frame;
    None where edges are few."""
    edges, camera, size = depth_edges(frame.depth_m), frame.camera, frame.camera.width / 640.0
    if len(edges) < MIN_EDGES:
        return None
    edges = edges[:: max(1, len(edges) // SAMPLED_EDGES)]
    points = camera.back_project(edges.astype(np.float64), frame.depth_m[edges[:, 1], edges[:, 0]].astype(np.float64))
    moved = points + OFFSETS_S[:, None, None] * (twist[:3] + np.cross(twist[3:], points))
    pixels = moved[..., :2] / np.maximum(moved[..., 2:], 1e-3) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    gradient = color_gradient(frame, BLUR_PX * size)
    h, w = gradient.shape
    x, y = (np.rint(pixels[:, None, :, k] + size * SHIFTS_PX[:, None]).astype(np.int64) for k in (0, 1))
    rows, columns = np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)
    return np.asarray(gradient[rows[:, :, None], columns[:, None]].mean(axis=-1), np.float64)


def _significant_offset(scores: F64) -> tuple[float, float]:
    """Return the offset (s) that fits the (n, offsets, rows, columns) scores best, and its score relative to that without one; 0 and 1 where it is
    small or could be chance."""
    mean = scores.mean(axis=0)
    offset, row, column = np.unravel_index(int(mean.argmax()), mean.shape)
    row0, column0 = np.unravel_index(int(mean[UNSHIFTED].argmax()), mean[UNSHIFTED].shape)
    gains = scores[:, offset, row, column] - scores[:, UNSHIFTED, row0, column0]
    ratio = float(mean.max() / max(mean[UNSHIFTED].max(), 1e-9))
    certain = gains.mean() >= MIN_T * gains.std(ddof=1) / np.sqrt(len(gains))
    found = bool(certain) and ratio >= MIN_RATIO and abs(OFFSETS_S[offset]) >= MIN_OFFSET_S
    return (float(OFFSETS_S[offset]), ratio) if found else (0.0, 1.0)
