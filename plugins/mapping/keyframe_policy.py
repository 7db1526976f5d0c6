"""The keyframe policy: a frame becomes a keyframe when its view has changed, unless its pose is in doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import eigvalsh, matmul
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Share, check_increasing
from trihedron.pipeline.core.types import F64, Frame, Map, Matches, Planes, Pose, Table
from trihedron.plugins.mapping.covisibility_graph import WEIGHTS, newest_keyframes
from trihedron.plugins.shared.contradiction import contradicting_depth

RATE = 30.0  # images a second of the camera whose frames the options count; that of others is counted as time
UNCHANGED = 0.25  # of the view change of a keyframe, that suffices after max_frames: a camera at rest adds none


@dataclass(frozen=True)
class KeyframeOptions:
    """Options of the keyframe policy. Frames are thirtieths of a second, whatever the rate of the camera."""

    min_frames: PositiveInt = 3  # between keyframes, unless landmarks run out
    max_frames: PositiveInt = 30  # after which a quarter of the view change below is enough
    min_shift: PositiveFloat = 0.06  # of the camera, as a share of the median depth, that makes a keyframe
    min_turn_deg: PositiveFloat = 6.0
    min_share: Share = 0.5  # of the newest keyframe's landmarks tracked, below which a keyframe is made
    urgent_share: Share = 0.25  # the same, below which one is made within `min_frames`: the next frame of a wide baseline would find no landmark
    doubt_sigmas: PositiveFloat = 3.0  # a pose with this many times the standard deviation of its reference keyframe is in doubt
    doubt_floor_m: PositiveFloat = 0.002  # least standard deviation of a keyframe in that comparison
    doubt_frames: NonNegativeInt = 10  # since the newest keyframe, in which a pose in doubt makes none while enough landmarks are tracked
    doubt_score: NonNegativeInt = 30  # points, lines and planes, weighted, that are enough
    new_plane_px: int = 4000  # a plane this large that is not in the map makes a keyframe

    def __post_init__(self) -> None:
        check_increasing(self, "min_frames", "max_frames")
        check_increasing(self, "urgent_share", "min_share")


def needs_keyframe(options: KeyframeOptions, frame: Frame, pose: Pose, planes: Planes, matches: Matches | None, map: Map) -> bool:
    """Return True if this frame shows enough that is new: the view has changed, few landmarks are tracked, or a large plane is not in the map. An
    image that repeats the one before shows nothing new, and what colour, depth or the map contradict each other about is not mapped."""
    keyframes, newest = map.keyframes, newest_keyframes(map, 1).tolist()
    if not newest or keyframes.row("submap", newest[0]) != pose.submap:
        return True
    if pose.repeats or contradicting_depth(pose):
        return False
    frames = round(1e-9 * RATE * (frame.stamp_ns - int(keyframes.row("stamp_ns", newest[0]))))
    spans = [keyframes.row(kind.span_column, newest[0]).tolist() for kind in WEIGHTS]
    tracked_share = _weighted_total(pose.inliers.tolist()) / max(_weighted_total([end - begin for begin, end in spans]), 1)
    urgent = tracked_share < options.urgent_share
    if 0 <= frames < options.min_frames and not urgent:  # less than 0: a keyframe of another sequence
        return False
    T = matmul(invert(keyframes.row("T_world_camera", newest[0])), pose.T_world_camera)
    rotation_deg = math.degrees(math.acos(min(max(0.5 * (T.trace() - 2.0), -1.0), 1.0)))
    change = max(math.hypot(*T[:3, 3].tolist()) / keyframe_distance_m(options, frame), rotation_deg / options.min_turn_deg)
    unknown = planes.pixels > options.new_plane_px
    if matches is not None:
        unknown[matches.planes[matches.planes[:, 1] < len(map.planes), 0]] = False
    needed = change > 1.0 or tracked_share < options.min_share or bool(unknown.any()) or (frames >= options.max_frames and change > UNCHANGED)
    return needed and (urgent or not (0 <= frames < options.doubt_frames and _in_doubt(options, pose, keyframes)))


def _in_doubt(options: KeyframeOptions, pose: Pose, keyframes: Table) -> bool:
    """Return True if a tracked pose is much less certain than its reference keyframe: its error would propagate to every new landmark. A later frame
    decides."""
    if pose.reference < 0 or _weighted_total(pose.inliers.tolist()) < options.doubt_score:
        return False
    covariances: list[F64] = [pose.local_covariance, keyframes.row("covariance", pose.reference)]
    sigma, reference = (float(eigvalsh(covariance[:3, :3])[-1]) ** 0.5 for covariance in covariances)
    return bool(sigma > options.doubt_sigmas * max(reference, options.doubt_floor_m))


def keyframe_distance_m(options: KeyframeOptions, frame: Frame) -> float:
    """Return the translation that makes a keyframe: `min_shift` of the median depth (1 m without depth)."""
    depth = frame.depth_m[::8, ::8].ravel()
    depth = depth[depth > 0.0]
    if not len(depth):
        return options.min_shift
    middle = [(len(depth) - 1) // 2, len(depth) // 2]
    return options.min_shift * float(np.partition(depth, middle)[middle].mean())


def _weighted_total(counts: list[int]) -> int:
    """Total of points, lines and planes, weighted as in covisibility."""
    return sum(weight * count for weight, count in zip(WEIGHTS.values(), counts))
