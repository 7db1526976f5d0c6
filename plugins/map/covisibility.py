"""The covisibility map: keyframes connected by the points, lines and planes they share."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, PositiveShare, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import DEGRADED, I32, LOST, Correction, Frame, Keypoints, Map, Matches, Planes, Pose, Segments
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.mapping.covisibility_graph import keyframes_of, local_window
from trihedron.plugins.mapping.culling import cull_landmarks, cull_redundant_keyframe, cull_repeated_keyframe, free_dead_rows
from trihedron.plugins.mapping.insertion import (
    Observations,
    add_keyframe,
    associate,
    count_visible,
    existing,
    insert_lines,
    insert_planes,
    insert_points,
)
from trihedron.plugins.mapping.keyframe_policy import UNCHANGED, KeyframeOptions, keyframe_distance_m, needs_keyframe
from trihedron.plugins.mapping.landmarks import empty_map, union
from trihedron.plugins.mapping.merge_verification import propose_merge
from trihedron.plugins.mapping.merging import merge_lines, merge_planes, merge_points
from trihedron.plugins.mapping.projection import visible_planes
from trihedron.plugins.mapping.reference_keyframe import submap_of, transform_to_map
from trihedron.plugins.mapping.submaps import is_elsewhere, merge_submaps, split_submap
from trihedron.plugins.none import NoMap

log = logging.getLogger("trihedron")
NEARBY = {"newest": 2, "covisible": 10, "near": 3}  # keyframes whose planes should be observed again: as many as tracking searches


@register("map", "covisibility")
@dataclass(frozen=True)
class Covisibility(KeyframeOptions):
    """Insert a keyframe when the view has changed, update known landmarks, add new ones, cull and merge (section V-A).

    Without bundle adjustment a landmark is the running estimate of all its observations, each weighted by its covariance."""

    memory: Annotated[float, Range(above=1)] = 30.0  # observations that the estimate of a point or line averages
    plane_memory: Annotated[float, Range(above=1)] = 30.0  # keyframes a plane remembers
    judge: bool = True  # classify matches at the final pose; false where they were verified by a rigid motion and loops exceed the pose's uncertainty
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    min_line_px: float = 30.0  # shortest segment that becomes a landmark
    trial: PositiveInt = 3  # keyframes after which a landmark seen by fewer of those that should have seen it is removed
    min_found: Share = 0.25  # found ratio below which a landmark is removed (ORB-SLAM)
    redundant: PositiveInt = 8  # keyframes that must see what another one sees, as well, for that to be redundant
    redundant_share: PositiveShare = 0.9  # of its landmarks (ORB-SLAM)
    merge_deg: float = 4.0  # planes that differ by less, and by less than merge_m on average, become one
    merge_m: float = 0.03  # mean distance of planes that become one
    verified_by: PositiveInt = 3  # views that agree on the motion between two sub-maps before these are merged; 1 = merge at the first recognised
    apart: tuple[int, ...] = ()  # sub-maps that are not merged with older ones: undoes a merge that was wrong, in a replay

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
        """Return the next version of the map, or None when this frame changes nothing."""
        corrected = map
        if corrected is not None and bundle is not None and bundle.based_on >= corrected.loop_closed:  # else it would undo that correction
            corrected = apply_correction(corrected, bundle)
        if corrected is not None and loop is not None and len(loop.keyframe_ids) and loop.based_on >= corrected.loop_closed:
            corrected = replace(apply_correction(corrected, loop), loop_closed=corrected.revision + 1)
        if corrected is not None and relocalise is not None and relocalise.status == DEGRADED and pose.status != LOST:
            corrected = self._merge(corrected, transform_to_map(pose, corrected), transform_to_map(relocalise, corrected))
        if corrected is not None and is_elsewhere(pose) and pose.submap == submap_of(pose, corrected):  # else it is split already
            corrected = self._split(corrected, pose)
        pose = replace(transform_to_map(pose, corrected), submap=submap_of(pose, corrected))
        if corrected is None:
            matches = None
            lengths = keypoints.descriptors.shape[1], segments.descriptors.shape[1], planes.samples_m.shape[1]
            corrected = empty_map(frame.index, frame.stamp_ns, *lengths)
        elif pose.status == LOST or not needs_keyframe(self, frame, pose, planes, matches, corrected):
            return None if corrected is map else self._version(corrected, frame)
        matches = existing(matches, corrected) if matches is not None else None
        return self._version(self._insert(corrected, frame, pose, keypoints, segments, planes, matches), frame)

    def localising(self) -> NoMap:
        """Return the plugin that leaves a loaded map as it is."""
        return NoMap()

    def _merge(self, map: Map, pose: Pose, recognised: Pose) -> Map:
        """The map whose sub-map of `pose` is merged with the one in which it was recognised, or in which that is proposed."""
        if (number := submap_of(pose, map)) in self.apart:
            return map
        if self.verified_by > 1:
            map, verified = propose_merge(map, pose, recognised, self.verified_by)
            if verified is None:
                return map
            recognised = verified
        if number != recognised.submap:
            log.warning("map: sub-map %d is merged with %d at frame %d; map.apart=[%d] undoes it", number, recognised.submap, pose.index, number)
        return replace(merge_submaps(map, pose, recognised, self.merge_deg, self.merge_m), loop_closed=map.revision + 1)

    def _split(self, map: Map, pose: Pose) -> Map:
        """The map that what was mapped since the camera was lost is split off."""
        split = split_submap(map, pose)
        if split is map:
            return map
        number, begun = submap_of(pose, split), pose.lost_from
        log.warning("map: the camera that was lost in frame %d was found in another place; what it mapped since is sub-map %d", begun, number)
        return replace(split, loop_closed=map.revision + 1)

    def _version(self, map: Map, frame: Frame) -> Map:
        return replace(map, index=frame.index, stamp_ns=frame.stamp_ns, revision=map.revision + 1)

    def _insert(self, map: Map, frame: Frame, pose: Pose, keypoints: Keypoints, segments: Segments, planes: Planes, matches: Matches | None) -> Map:
        """The map with this frame as its newest keyframe."""
        matches = matches if len(keyframes_of(map, pose.submap)) else None  # a new sub-map has no landmarks yet
        found = associate(map, frame.camera, pose.T_world_camera, keypoints, segments, planes, matches, self.line_sigma_px, self.judge)
        expected = self._expected_planes(map, frame, pose, matches)
        map, row = add_keyframe(map, pose, frame.camera)
        view = Observations(row, frame.camera, pose.T_world_camera, pose.local_covariance)
        if matches is not None:
            map = count_visible(map, matches.visible_points, matches.visible_lines, expected)
        map = insert_points(map, view, keypoints, found.points, found.new_points, self.memory)
        ends = segments.endpoints_px[found.new_lines]
        new_lines = found.new_lines[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= self.min_line_px]
        map = insert_lines(map, view, segments, found.lines, new_lines, self.line_sigma_px, self.memory)
        map = insert_planes(map, view, planes, found.planes, found.new_planes, self.plane_memory)
        if matches is not None:
            map = merge_points(map, view, matches.visible_points, keypoints.metric)
            map = merge_lines(map, view, matches.visible_lines)
        map = merge_planes(map, row, self.merge_deg, self.merge_m)
        map = cull_landmarks(map, row, matches, expected, self.trial, self.min_found)
        map = cull_redundant_keyframe(map, self.redundant, self.redundant_share)
        near_m, near_deg = UNCHANGED * keyframe_distance_m(self, frame), UNCHANGED * self.min_turn_deg
        return free_dead_rows(cull_repeated_keyframe(map, near_m, near_deg, self.min_share))

    def _expected_planes(self, map: Map, frame: Frame, pose: Pose, matches: Matches | None) -> I32:
        """Planes of the local window that should be visible in this frame, and those that are matched."""
        if matches is None:
            return np.empty(0, np.int32)
        around = local_window(map, pose.T_world_camera, **NEARBY, submap=pose.submap).planes
        return union(visible_planes(map.planes, around, pose.T_world_camera, frame), matches.planes[:, 1])
