"""Estimate from a run what a camera file should say of the depth: the offset of inverse depth, and the delay of the depth images.

The offset (1/m, `depth_offset` of camera.yaml) comes of walls that should be at right angles, the delay (`dataset.depth_delay_ms` of dataset=tum) of
how the camera turns in the colour and in the depth images. A scale of all depths cannot be seen. A figure counts when it is several times its
standard deviation; run again with it to see what it buys.

Example: trihedron calibrate runs/a/run.mcap
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import FrameReference, Keypoints, Matches, Planes, Tracks
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser, table
from trihedron.tools.calibration import DepthDelay, DepthOffset, RightAngle, Turn, estimate_depth_delay, estimate_depth_offset, right_angles, turn_of

NEEDED = ("frames", "keypoints", "planes", "tracks", "matches")


def main(argv: list[str]) -> int:
    """Print both figures; returns the exit code. Raises RecordingError, or DataError for a recording without the topics."""
    parser = Parser("calibrate", __name__)
    parser.add_argument("recording", metavar="RUN.mcap", type=Path)
    recording = Recording(parser.parse_args(argv).recording)
    missing = next((topic for topic in NEEDED if topic not in recording.topics), None)
    if missing:
        raise DataError(str(recording.path), f"holds no topic {missing}", "record a run of graph=structural, or one that has this stage")
    planes = planes_of(recording)
    offset, delay = depth_offset_of(recording, planes), depth_delay_of(recording, planes)
    rows = [
        ["figure", "estimate", "standard deviation", "from"],
        ["depth_offset (1/m)", f"{offset.per_m:.5f}", f"{offset.sigma_per_m:.5f}", f"{offset.pairs} pairs of planes"],
        ["depth_delay_ms", f"{1e3 * delay.seconds:.1f}", f"{1e3 * delay.sigma_s:.1f}", f"{delay.frames} frames"],
    ]
    print(table(rows, "lrr"))
    return 0


def planes_of(recording: Recording) -> dict[int, Planes]:
    """The planes of each frame."""
    return {value.index: value for value in _all(recording, "planes", Planes)}


def depth_offset_of(recording: Recording, planes: Mapping[int, Planes]) -> DepthOffset:
    """What to add to the inverse depths of the recording's sensor; `planes` by frame."""
    landmarks = {match.index: dict(match.planes.tolist()) for match in _all(recording, "matches", Matches)}
    pairs: dict[tuple[int, int], list[RightAngle]] = {}
    for index, found in planes.items():
        for ids, seen in right_angles(found, landmarks.get(index, {})).items():
            pairs.setdefault(ids, []).append(seen)
    return estimate_depth_offset(pairs)


def depth_delay_of(recording: Recording, planes: Mapping[int, Planes]) -> DepthDelay:
    """How much later than its colour image a depth image of the recording was taken; `planes` by frame."""
    camera = _all(recording, "frames", FrameReference)[0].camera
    keypoints = {value.index: value for value in _all(recording, "keypoints", Keypoints)}
    tracks = [t for t in _all(recording, "tracks", Tracks) if t.previous_index >= 0 and t.index in keypoints and t.index in planes]
    turns: list[Turn] = [turn for t in tracks if (turn := turn_of(t, keypoints[t.index], planes[t.index], camera)) is not None]
    stamps = np.array([t.stamp_ns for t in tracks], np.int64)
    return estimate_depth_delay(turns, float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else np.nan)


def _all(recording: Recording, topic: str, kind: type[Any]) -> list[Any]:
    """A topic's values, in frame order."""
    return [value for value in recording.values(topic) if isinstance(value, kind)]
