"""Frames, motions and matched points of a recording, as the estimates of calibration need them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.registration import DepthCamera, Registration
from trihedron.pipeline.app.recorded_values import frames_of, references_of, trajectory_of
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import log_so3
from trihedron.pipeline.core.types import F32, F64, Camera, Frame, Keypoints, Matches, Trajectory
from trihedron.pipeline.core.value_checks import check_together, validate_value
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.calibration_judgement import blocks_of
from trihedron.tools.calibration_pairs import Observations, Pairs

NEEDED = ("frames", "keypoints", "matches", "pose")
FRAMES = 48  # read, at most
MIN_POINTS, MAX_POINTS = 20, 40  # of a pair; more are thinned
APART = (0, 2)  # blocks between the frames of a pair: of the same half
WINDOW = 2  # pixels on either side by which the slope of depth is measured, at 320 a line
SMOOTH = 0.05  # relative difference of depths in the window: no edge


@dataclass(frozen=True)
class Recorded:
    """Posed frames spread over a recording, with their poses (n, 4, 4), motions (n, 6) as `calibration_pairs.Observations` has them, blocks (n,), and
    of each its key points that belong to landmarks: pixels (k, 2), standard deviations (k,) and landmarks (k,)."""

    camera: Camera
    frames: list[Frame]
    poses: F64
    motions: F64
    blocks: NDArray[np.int64]
    pixels: list[F64]
    sigma_px: list[F64]
    landmarks: list[NDArray[np.int64]]


def read_recording(recording: Recording) -> Recorded:
    """Read up to FRAMES frames. Raises DataError for a recording that lacks topics, frames or poses, RecordingError for a damaged one."""
    place = str(recording.path)
    missing = next((topic for topic in NEEDED if topic not in recording.topics), None)
    if missing:
        raise DataError(place, f"holds no topic {missing}", "record a run of graph=structural, or one that has this stage")
    trajectory, read = trajectory_of(recording), frames_of(recording)
    rows = {stamp: row for row, stamp in enumerate(trajectory.stamps_ns.tolist())}
    posed = [reference for reference in references_of(recording).values() if reference.stamp_ns in rows]
    if len(posed) < 3:
        raise DataError(place, "has fewer than three posed frames", "calibrate from a run that tracked its camera")
    chosen = [posed[row] for row in np.unique(np.linspace(0, len(posed) - 1, FRAMES).astype(int))]
    known = [(frame, rows[reference.stamp_ns]) for reference in chosen if (frame := read(reference)) is not None]
    keypoints = {v.index: v for found in recording.values("keypoints") if isinstance(v := validate_value("keypoints", found, place), Keypoints)}
    matches = {v.index: v for found in recording.values("matches") if isinstance(v := validate_value("matches", found, place), Matches)}
    pixels, sigmas, landmarks = [], [], []
    for frame, _ in known:
        points, matched = keypoints.get(frame.index), matches.get(frame.index)
        pairs = np.zeros((0, 2), np.int32)
        if points is not None and matched is not None:
            check_together({"keypoints": points, "matches": matched}, place, {topic: topic for topic in ("keypoints", "matches")})
            pairs = matched.keypoints
        pixels.append(np.zeros((0, 2)) if points is None else points.pixels[pairs[:, 0]].astype(np.float64))
        sigmas.append(np.zeros(0) if points is None else points.sigma_px[pairs[:, 0]].astype(np.float64))
        landmarks.append(pairs[:, 1].astype(np.int64))
    at = [row for _, row in known]
    motions = np.array([_motion(trajectory, row) for row in at])
    return Recorded(known[0][0].camera, [f for f, _ in known], trajectory.poses[at], motions, blocks_of(len(at)), pixels, sigmas, landmarks)


def _motion(trajectory: Trajectory, row: int) -> F64:
    """Angular rate (rad/s) and velocity (m/s) in the camera's frame, by the poses before and after."""
    before, after = max(row - 1, 0), min(row + 1, len(trajectory) - 1)
    seconds = float(trajectory.stamps_ns[after] - trajectory.stamps_ns[before]) * 1e-9
    relative = invert(trajectory.poses[before]) @ trajectory.poses[after]
    velocity = trajectory.poses[row][:3, :3].T @ (trajectory.poses[after][:3, 3] - trajectory.poses[before][:3, 3])
    return np.concatenate([log_so3(relative[:3, :3]), velocity]) / max(seconds, 1e-6)


def pairs_of(recorded: Recorded, depth_camera: DepthCamera | None) -> Pairs | None:
    """Pair frames of the same half that share landmarks; depth is registered with `depth_camera` first. None where there are none."""
    camera, blocks = recorded.camera, recorded.blocks
    seen = [_observations(recorded, row, _register_depth(frame, depth_camera)) for row, frame in enumerate(recorded.frames)]
    first, second, motions, of = [], [], [], []
    for i in range(len(seen)):
        for j in range(i + 1, len(seen)):
            if blocks[j] - blocks[i] not in APART:
                continue
            common, a, b = np.intersect1d(seen[i][1], seen[j][1], return_indices=True)
            if len(common) >= MIN_POINTS:
                chosen = np.unique(np.linspace(0, len(common) - 1, MAX_POINTS).astype(int))
                first.append(seen[i][0].select(a[chosen]))
                second.append(seen[j][0].select(b[chosen]))
                motions.append(invert(recorded.poses[j]) @ recorded.poses[i])
                of.append(blocks[i])
    if not of:
        return None
    pair = np.repeat(np.arange(len(of)), [len(one.depths_m) for one in first])
    return Pairs(camera, Observations.concatenate(first), Observations.concatenate(second), pair, np.array(motions), np.array(of))


def _register_depth(frame: Frame, depth_camera: DepthCamera | None) -> F32:
    if depth_camera is None:
        return frame.depth_m
    camera = frame.camera
    return Registration(camera.width, camera.height, depth_camera.K, (), depth_camera.T_color_depth, camera)(frame.depth_m)


def _observations(recorded: Recorded, row: int, depth_m: F32) -> tuple[Observations, NDArray[np.int64]]:
    """The matched key points of a frame about which depth is smooth, and their landmarks."""
    camera, pixels = recorded.camera, recorded.pixels[row]
    size = max(round(WINDOW * camera.width / 320), 1)
    steps = np.arange(-size, size + 1)
    x, y = np.rint(pixels).astype(np.int64).T
    columns, rows = np.clip(x[:, None, None] + steps, 0, camera.width - 1), np.clip(y[:, None, None] + steps[:, None], 0, camera.height - 1)
    window = depth_m[rows, columns].astype(np.float64).reshape(len(pixels), len(steps), len(steps))
    z = np.median(window.reshape(len(pixels), -1), axis=1) if len(pixels) else np.zeros(0)
    good = (
        (window.min(axis=(1, 2), initial=np.inf) > 0.0) & (np.ptp(window.reshape(len(pixels), -1), axis=1) < SMOOTH * z) if len(pixels) else z > 0.0
    )
    spread = float((steps**2).sum() * len(steps))
    slope = np.stack([(window * steps).sum(axis=(1, 2)), (window * steps[:, None]).sum(axis=(1, 2))], axis=1) / spread
    motion = np.tile(recorded.motions[row], (len(pixels), 1))
    rays = np.concatenate([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(pixels), 1))], axis=1)
    points = rays * z[:, None]
    moving = -(motion[:, 3:] + np.cross(motion[:, :3], points))
    flow = (moving[:, :2] - rays[:, :2] * moving[:, 2:]) * [camera.fx, camera.fy] / np.maximum(z, 1e-3)[:, None]
    rates = moving[:, 2] - (slope * flow).sum(axis=1)
    sigma_m = np.asarray(camera.depth_noise.sigma_m(z), np.float64)
    seen = Observations(pixels, z, rates, recorded.sigma_px[row], sigma_m, motion)
    return seen.select(good), recorded.landmarks[row][good]
