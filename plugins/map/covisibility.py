"""Keyframes tied by the points, lines and planes they share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, PositiveShare, Range, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import DEGRADED, F32, I32, LOST, OK, Correction, Frame, Keypoints, Map, Matches, Planes, Pose, Segments, Table
from trihedron.plugins.map.none import NoMap
from trihedron.plugins.mapping import insertion
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.mapping.covisibility_graph import WEIGHTS, keyframes_of, local_window, newest_keyframes
from trihedron.plugins.mapping.culling import cull, cull_keyframe, cull_repeated, released
from trihedron.plugins.mapping.insertion import Associated, associate, existing
from trihedron.plugins.mapping.landmarks import empty_map, union
from trihedron.plugins.mapping.merging import merge_lines, merge_planes, merge_points
from trihedron.plugins.mapping.reference_keyframe import submap_of, transform_to_map
from trihedron.plugins.mapping.submaps import tied
from trihedron.plugins.mapping.visibility import visible_planes

NEARBY = {"newest": 2, "covisible": 10, "near": 3}  # keyframes whose planes should be seen again: as many as tracking searches
STALE = 0.25  # of the view change of a keyframe, that makes one after max_frames: a camera at rest adds none


@register("map", "covisibility")
@dataclass(frozen=True)
class Covisibility:
    """Insert a keyframe when the view has changed, measure known landmarks again, add new ones, cull and fuse (section V-A).

    Without bundle adjustment a landmark is the running estimate of all its measurements, each weighed by its covariance."""

    min_frames: PositiveInt = 3  # between keyframes
    max_frames: PositiveInt = 30  # after which a quarter of the view change below is enough
    min_shift: PositiveFloat = 0.06  # of the camera, as a share of the median depth, that makes a keyframe
    min_turn_deg: PositiveFloat = 6.0
    min_share: Share = 0.5  # of the newest keyframe's landmarks tracked, below which a keyframe is made
    doubt_sigmas: PositiveFloat = 3.0  # a degraded pose with this many times the standard deviation of its reference keyframe is in doubt
    doubt_floor_m: PositiveFloat = 0.002  # least standard deviation of a keyframe in that comparison
    doubt_frames: NonNegativeInt = 10  # since the newest keyframe, in which a pose in doubt makes none while enough landmarks are tracked
    doubt_score: NonNegativeInt = 30  # points, lines and planes, weighed, that are enough
    new_plane_px: int = 4000  # a plane this large that is not in the map makes a keyframe
    memory: Annotated[float, Range(above=1)] = 30.0  # measurements a point or line remembers
    plane_memory: Annotated[float, Range(above=1)] = 30.0  # keyframes a plane remembers
    judge: bool = True  # matches by the final pose; false where they were verified among themselves and a loop may be longer than the pose is sure
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    min_line_px: float = 30.0  # shortest segment that becomes a landmark
    trial: PositiveInt = 3  # keyframes after which a landmark seen by fewer of those that should have seen it is removed
    min_found: Share = 0.25  # found ratio below which a landmark is removed (ORB-SLAM)
    redundant: PositiveInt = 8  # keyframes that must see what another one sees, as well, for that to be redundant
    redundant_share: PositiveShare = 0.9  # of its landmarks (ORB-SLAM)
    merge_deg: float = 4.0  # planes that differ by less, and by less than merge_m on average, become one
    merge_m: float = 0.03

    def __post_init__(self) -> None:
        check_increasing(self, "min_frames", "max_frames")

    def __call__(
        self,
        frame: Frame,
        pose: Pose,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        matches: Matches | None,
        map: Map | None,
        bundle: Correction | None,
        loop: Correction | None,
        relocalise: Pose | None,
    ) -> Map | None:
        """The next version of the map, or None when this frame changes nothing."""
        corrected = self._corrected(map, bundle, loop)
        if corrected is not None and relocalise is not None and relocalise.status == DEGRADED and pose.status != LOST:
            corrected = tied(corrected, transform_to_map(pose, corrected), transform_to_map(relocalise, corrected), self.merge_deg, self.merge_m)
        pose = _in_its_submap(transform_to_map(pose, corrected), corrected)
        if corrected is None:
            matches = None
            lengths = keypoints.descriptors.shape[1], segments.descriptors.shape[1], planes.samples_m.shape[1]
            corrected = empty_map(frame.index, frame.stamp_ns, *lengths)
        elif pose.status == LOST or not self._wanted(frame, pose, planes, matches, corrected):
            return None if corrected is map else self._version(corrected, frame)
        matches = existing(matches, corrected) if matches is not None else None
        return self._version(self._inserted(corrected, frame, pose, keypoints, segments, planes, matches), frame)

    def _corrected(self, map: Map | None, *corrections: Correction | None) -> Map | None:
        for correction in corrections:
            if map is not None and correction is not None:
                map = apply_correction(map, correction)
        return map

    def localising(self) -> NoMap:
        """Return the plugin that leaves a loaded map as it is."""
        return NoMap()

    def _version(self, map: Map, frame: Frame) -> Map:
        return replace(map, index=frame.index, stamp_ns=frame.stamp_ns, revision=map.revision + 1)

    def _wanted(self, frame: Frame, pose: Pose, planes: Planes, matches: Matches | None, map: Map) -> bool:
        """Whether this frame shows enough that is new."""
        keyframes, newest = map.keyframes, newest_keyframes(map, 1).tolist()
        if not newest or keyframes.row("submap", newest[0]) != pose.submap:
            return True
        frames = frame.index - int(keyframes.row("index", newest[0]))
        if 0 <= frames < self.min_frames:  # less than 0: a keyframe of another sequence
            return False
        T = invert(keyframes.row("T_world_camera", newest[0])) @ pose.T_world_camera
        turned_deg = math.degrees(math.acos(min(max(0.5 * (T.trace() - 2.0), -1.0), 1.0)))
        moved = max(math.hypot(*T[:3, 3].tolist()) / self._shift_m(frame), turned_deg / self.min_turn_deg)
        spans = [keyframes.row(kind, newest[0]).tolist() for kind in ("points", "lines", "planes")]
        poor = _weighed(pose.inliers.tolist()) < self.min_share * _weighed([end - begin for begin, end in spans])
        unknown = planes.pixels > self.new_plane_px
        if matches is not None:
            unknown[matches.planes[matches.planes[:, 1] < len(map.planes), 0]] = False
        wanted = moved > 1.0 or poor or bool(unknown.any()) or (frames >= self.max_frames and moved > STALE)
        return wanted and not (0 <= frames < self.doubt_frames and self._in_doubt(pose, keyframes))

    def _in_doubt(self, pose: Pose, keyframes: Table) -> bool:
        """Return True if a tracked pose is much less certain than the keyframe it refers to: its doubt would spread to all that is measured from it.
        A later frame decides."""
        if pose.status == OK or pose.reference < 0 or _weighed(pose.inliers.tolist()) < self.doubt_score:
            return False
        sigma, reference = (float(np.linalg.eigvalsh(c[:3, :3])[-1]) ** 0.5 for c in (pose.covariance, keyframes.row("covariance", pose.reference)))
        return sigma > self.doubt_sigmas * max(reference, self.doubt_floor_m)

    def _shift_m(self, frame: Frame) -> float:
        """Way that makes a keyframe."""
        depth = frame.depth_m[::8, ::8].ravel()
        return self.min_shift * _median(depth[depth > 0.0], 1.0)

    def _inserted(self, map: Map, frame: Frame, pose: Pose, keypoints: Keypoints, segments: Segments, planes: Planes, matches: Matches | None) -> Map:
        """The map with this frame as its newest keyframe."""
        matches = matches if len(keyframes_of(map, pose.submap)) else None  # a new sub-map knows nothing yet
        found = associate(map, frame.camera, pose.T_world_camera, keypoints, segments, planes, matches, self.line_sigma_px, self.judge)
        expected = self._planes_in_view(map, frame, pose, matches)
        map, row = insertion.add_keyframe(map, pose, frame.camera)
        view = insertion.Observations(row, frame.camera, pose.T_world_camera, pose.covariance)
        map = self._seen(map, matches, expected)
        map = insertion.insert_points(map, view, keypoints, found.points, found.new_points, self.memory)
        map = insertion.insert_lines(map, view, segments, found.lines, self._long(segments, found), self.line_sigma_px, self.memory)
        map = insertion.insert_planes(map, view, planes, found.planes, found.new_planes, self.plane_memory)
        if matches is not None:
            map = merge_points(map, view, matches.visible_points, keypoints.metric)
            map = merge_lines(map, view, matches.visible_lines)
        map = merge_planes(map, row, self.merge_deg, self.merge_m)
        map = cull(map, row, matches, expected, self.trial, self.min_found)
        map = cull_keyframe(map, self.redundant, self.redundant_share)
        return released(cull_repeated(map, STALE * self._shift_m(frame), STALE * self.min_turn_deg, self.min_share))

    def _planes_in_view(self, map: Map, frame: Frame, pose: Pose, matches: Matches | None) -> I32:
        """Planes seen about here that should be seen now, those that are among them."""
        if matches is None:
            return np.empty(0, np.int32)
        around = local_window(map, pose.T_world_camera, **NEARBY, submap=pose.submap).planes
        return union(visible_planes(map.planes, around, pose.T_world_camera, frame), matches.planes[:, 1])

    def _seen(self, map: Map, matches: Matches | None, planes: I32) -> Map:
        if matches is None:
            return map
        points = insertion.count_visible(map.points, matches.visible_points)
        lines = insertion.count_visible(map.lines, matches.visible_lines)
        return replace(map, points=points, lines=lines, planes=insertion.count_visible(map.planes, planes))

    def _long(self, segments: Segments, found: Associated) -> I32:
        """New segments long enough to be found again."""
        ends = segments.endpoints_px[found.new_lines]
        return found.new_lines[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= self.min_line_px]


def _in_its_submap(pose: Pose, map: Map | None) -> Pose:
    """The pose, said in the sub-map that its reference keyframe belongs to by now."""
    submap = submap_of(pose, map)
    return pose if submap == pose.submap else replace(pose, submap=submap)


def _weighed(counts: list[int]) -> int:
    """Points, lines and planes as one number, weighed as in co-visibility."""
    return sum(weight * count for weight, count in zip(WEIGHTS.values(), counts))


def _median(values: F32, default: float) -> float:
    """As NumPy's, of values without NaN; the default of none."""
    if not len(values):
        return default
    middle = [(len(values) - 1) // 2, len(values) // 2]
    return float(np.partition(values, middle)[middle].mean())
