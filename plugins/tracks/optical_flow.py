"""Tracking by optical flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, I32, Bool, Frame, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.relative_motion import solve_motion
from trihedron.plugins.tracks.feature_pairs import NO_PAIRS, Features, StructureGates, tracks_value, with_carried_depth
from trihedron.plugins.tracks.optical_flow_kernels import nearest_pixels


@register("tracks", "optical_flow")
@dataclass(frozen=True)
class OpticalFlow:
    """Track the previous key points by pyramidal Lucas–Kanade (Lucas and Kanade, 1981; Bouguet, 2000) with a forward–backward check, and snap each
    to this frame's nearest key point. No descriptor is used, and points without depth remain. Lines and planes are then matched by the points'
    motion."""

    window_px: Annotated[int, Range(3)] = 15
    levels: NonNegativeInt = 3  # of the pyramid above the image
    back_px: PositiveFloat = 1.0  # forward–backward error at most
    snap_px: PositiveFloat = 1.5  # standard deviations of the key point, between the end of the flow and the key point
    max_age: PositiveInt = 10  # frames; older features are not matched
    prior_deg: PositiveFloat = 2.0  # of the repeated last rotation
    prior_m: PositiveFloat = 0.1  # of no translation, per frame
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    plane_floor_deg: PositiveFloat = 0.3

    def __call__(
        self,
        frame: Frame,
        previous_frame: Frame | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_segments: Segments | None,
        previous_planes: Planes | None,
        previous: Tracks | None,
    ) -> Tracks | None:
        """Return the pairs with the previous frame; None for the first frame, no pairs when the previous features are too old."""
        if previous_frame is None or previous_keypoints is None or previous_segments is None or previous_planes is None:
            return None
        now = Features(keypoints, segments, planes)
        before = with_carried_depth(Features(previous_keypoints, previous_segments, previous_planes), previous, self, frame.camera)
        gap, R = frame.index - previous_frame.index, np.eye(3)
        if previous is not None and previous.index == previous_frame.index and previous.index > previous.previous_index:
            R = exp_so3(gap / (previous.index - previous.previous_index) * log_so3(previous.R_current_previous))
        if gap > self.max_age or before.keypoints.index != previous_frame.index:
            return tracks_value(now, before, (NO_PAIRS, NO_PAIRS, NO_PAIRS), R)
        points = self._points(frame, previous_frame, keypoints, before.keypoints)
        tracks = tracks_value(now, before, (points, NO_PAIRS, NO_PAIRS), R)
        motion = solve_motion(self, frame.camera, tracks, keypoints, segments, planes, gap)
        return tracks_value(now, before, (points, *StructureGates().pairs(now, before, frame.camera, motion.R, motion.t)), motion.R)

    def _points(self, frame: Frame, previous_frame: Frame, now: Keypoints, before: Keypoints) -> I32:
        """Match key points, rows (n, 2) (previous, current), each at most once."""
        if not (len(before.pixels) and len(now.pixels)):
            return NO_PAIRS
        there, found = self._flow(previous_frame, frame, before.pixels)
        back, returned = self._flow(frame, previous_frame, there)
        good = found & returned & (np.linalg.norm(back - before.pixels, axis=1) < self.back_px)
        rows = np.flatnonzero(good).astype(np.int32)
        nearest, distance = nearest_pixels(there[rows], np.array(now.pixels))
        near = distance < self.snap_px * now.sigma_px[nearest]
        rows, nearest, distance = rows[near], nearest[near], distance[near]
        order = np.lexsort((rows, distance))
        _, first = np.unique(nearest[order], return_index=True)
        chosen = np.sort(order[first])
        return np.stack([rows[chosen], nearest[chosen]], axis=1).astype(np.int32).reshape(-1, 2)

    def _flow(self, start: Frame, end: Frame, pixels: F32) -> tuple[F32, Bool]:
        """Track pixels (n, 2) of one frame in the other; also the mask (n,) of those found."""
        window = (self.window_px, self.window_px)
        moved, status, _ = cv2.calcOpticalFlowPyrLK(start.gray, end.gray, pixels[:, None], None, winSize=window, maxLevel=self.levels)
        return moved[:, 0], status[:, 0] > 0
