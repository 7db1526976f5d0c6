"""Estimate calibration from a run: the offset of inverse depth, the delay of the depth images, and focal lengths against depth.

The offset (1/m, `depth_offset` of camera.yaml) is estimated from walls that should be at right angles, the delay (`dataset.depth_delay_ms` of
dataset=tum) from the rotation of the camera in the colour and in the depth images, fx and fy from points that two keyframes measured. A scale of all
depths is not observable. An estimate is significant when it differs from the value in use by several standard deviations; run again with it.

Example: trihedron calibrate runs/a/run.mcap
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Camera, FrameReference, Keypoints, Matches, Planes, Tracks
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser, table
from trihedron.tools.calibration import (
    DepthDelay,
    DepthOffset,
    FrameRotation,
    RightAngle,
    estimate_depth_delay,
    estimate_depth_offset,
    right_angles,
    rotation_of_frame,
)
from trihedron.tools.calibration_focal_length import FocalLengths, estimate_focal_lengths

NEEDED = ("frames", "keypoints", "planes", "tracks", "matches", "map")


def main(argv: list[str]) -> int:
    """Print the estimates; returns the exit code. Raises RecordingError, or DataError for a recording without the topics."""
    parser = Parser("calibrate", __name__)
    parser.add_argument("recording", metavar="RUN.mcap", type=Path)
    recording = Recording(parser.parse_args(argv).recording)
    missing = next((topic for topic in NEEDED if topic not in recording.topics), None)
    if missing:
        raise DataError(str(recording.path), f"holds no topic {missing}", "record a run of graph=structural, or one that has this stage")
    planes = planes_of(recording)
    offset, delay, focal = depth_offset_of(recording, planes), depth_delay_of(recording, planes), focal_lengths_of(recording)
    camera = camera_of(recording)
    rows = [
        ["figure", "estimate", "standard deviation", "from"],
        ["depth_offset (1/m)", f"{offset.per_m:.5f}", f"{offset.sigma_per_m:.5f}", f"{offset.pairs} pairs of planes"],
        ["depth_delay_ms", f"{1e3 * delay.seconds:.1f}", f"{1e3 * delay.sigma_s:.1f}", f"{delay.frames} frames"],
        *(
            [f"{name} (px; {used:g} in use)", f"{factor * used:.2f}", f"{sigma * used:.2f}", f"{focal.pairs} pairs of keyframes"]
            for name, used, factor, sigma in zip(("fx", "fy"), (camera.fx, camera.fy), focal.factors, focal.sigmas)
        ),
    ]
    print(table(rows, "lrr"))
    return 0


def planes_of(recording: Recording) -> dict[int, Planes]:
    """The planes of each frame."""
    return {value.index: value for value in _all(recording, "planes", Planes)}


def camera_of(recording: Recording) -> Camera:
    """The camera of the first frame."""
    frames: list[FrameReference] = _all(recording, "frames", FrameReference)
    return frames[0].camera


def focal_lengths_of(recording: Recording) -> FocalLengths:
    """Estimate the factors of fx and fy from the last map of the recording."""
    maps: deque[Any] = deque(recording.values("map"), maxlen=1)
    return estimate_focal_lengths(maps[0]) if maps else FocalLengths(np.full(2, np.nan), np.full(2, np.inf), 0)


def depth_offset_of(recording: Recording, planes: Mapping[int, Planes]) -> DepthOffset:
    """Estimate the offset of the inverse depths of the recording's sensor; `planes` by frame."""
    landmarks = {match.index: dict(match.planes.tolist()) for match in _all(recording, "matches", Matches)}
    pairs: dict[tuple[int, int], list[RightAngle]] = {}
    for index, found in planes.items():
        for ids, seen in right_angles(found, landmarks.get(index, {})).items():
            pairs.setdefault(ids, []).append(seen)
    return estimate_depth_offset(pairs)


def depth_delay_of(recording: Recording, planes: Mapping[int, Planes]) -> DepthDelay:
    """Estimate the time offset of the depth images relative to colour; `planes` by frame."""
    camera = camera_of(recording)
    keypoints = {value.index: value for value in _all(recording, "keypoints", Keypoints)}
    tracks = [t for t in _all(recording, "tracks", Tracks) if t.previous_index >= 0 and t.index in keypoints and t.index in planes]
    rotations: list[FrameRotation] = [r for t in tracks if (r := rotation_of_frame(t, keypoints[t.index], planes[t.index], camera)) is not None]
    stamps = np.array([t.stamp_ns for t in tracks], np.int64)
    return estimate_depth_delay(rotations, float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else np.nan)


def _all(recording: Recording, topic: str, kind: type[Any]) -> list[Any]:
    """A topic's values, in frame order."""
    return [value for value in recording.values(topic) if isinstance(value, kind)]
