"""Relocalisation by hypotheses and verification: the plugins differ in how they make hypotheses of the camera's pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.options import NonNegativeInt, PositiveInt, PositiveShare, Share
from trihedron.pipeline.core.types import DEGRADED, F64, I32, LOST, OK, Map, Pose
from trihedron.plugins.mapping.covisibility_graph import are_distinct, keyframes_of, living_keyframes
from trihedron.plugins.mapping.merge_verification import proposed_submaps
from trihedron.plugins.mapping.reference_keyframe import reference_of, submap_of
from trihedron.plugins.places.recognition import block_of, candidate_keyframes
from trihedron.plugins.places.verification import FrameFeatures, VerifiedPlace, verify_place

Hypotheses = Callable[[FrameFeatures, Map, I32], F64]  # poses (n, 4, 4) of the camera by the landmarks of some keyframes, best first


@dataclass(frozen=True)
class RelocaliseOptions:
    """Options of relocalisation, whatever makes the hypotheses."""

    block: PositiveInt = 80  # keyframes looked at in one frame
    every: PositiveInt = 5  # frames between looks at older sub-maps, while tracked in one that is not connected to them and nothing is proposed yet
    candidates: PositiveInt = 20  # of them, whose landmarks make hypotheses
    max_bits: NonNegativeInt = 64  # of 256 between descriptors; the mean of strangers is 128
    ratio: PositiveShare = 0.85  # best to second best descriptor
    near: PositiveInt = 8  # keyframes taken from about a hypothesis, whose landmarks verify it
    min_score: PositiveInt = 30  # points + 2 lines + 5 planes that recognise a place
    min_details: PositiveInt = 25  # points + 3 lines among them
    min_share: Share = 0.5  # of the matches that must agree
    min_found: Share = 0.08  # of the details expected in view (rooms built alike: at most 0.05; the same place: at least 0.12)
    min_each: Share = 0.04  # of the points, and of the lines, expected in view (built alike: at most 0.021; the same place: at least 0.057)
    max_through: Share = 0.15  # of the surfaces in view that the camera may see through, as for a loop
    rival: PositiveShare = 0.75  # of the best place's score, that makes another place as likely


def recognise(options: RelocaliseOptions, ways: tuple[Hypotheses, ...], view: FrameFeatures, map: Map | None, previous: Pose | None) -> Pose | None:
    """Return the pose by the first of some ways to make hypotheses that finds the place; for a lost camera that is not recognised the lost one, and
    else None."""
    if map is None or previous is None:
        return None
    frame, lost = view.frame, previous.status == LOST
    count = frame.index // max(frame.index - previous.index, 1)  # of the frames of a run that takes every S-th, too
    submaps = _submaps(options, map, submap_of(previous, map), lost, frame.index, count)
    if not len(submaps):
        return None
    look = count if lost else count // options.every
    submap = int(submaps[look % len(submaps)])
    keyframes = block_of(keyframes_of(map, submap), options.block, look)
    keyframes = candidate_keyframes(map, view.keypoints, view.segments, keyframes, options.candidates, options.max_bits)
    found: list[VerifiedPlace] = []
    for hypotheses in ways:
        places = (verify_place(T, view, map, keyframes, options.near) for T in hypotheses(view, map, keyframes))
        found += [place for place in places if place is not None]
        if any(_accept(options, place) for place in found):
            break
    best = _unambiguous(options, found)
    if best is None:
        return replace(previous, index=frame.index, stamp_ns=frame.stamp_ns, reason="nothing was recognised") if lost else None
    T, status = best.T_world_camera, OK if lost else DEGRADED
    reference, T_reference_camera = reference_of(map, T, submap)
    reason = "recognised by {} points, {} lines and {} planes of the map".format(*best.inliers)
    return Pose(frame.index, frame.stamp_ns, T, best.covariance, T_reference_camera, reference, best.inliers, 0, status, reason, submap)


def _submaps(options: RelocaliseOptions, map: Map, submap: int, lost: bool, index: int, count: int) -> I32:
    """Sub-maps to search: all for a lost camera; now and then the older ones for one tracked in a sub-map that is not merged with the first, and in
    each frame those that a recent proposal would merge it with."""
    if not lost:
        proposed = proposed_submaps(map, submap, index)
        if len(proposed) or submap == 0 or count % options.every:
            return proposed
    known = np.unique(map.keyframes.rows("submap", living_keyframes(map))).astype(np.int32)
    return known if lost else known[known < submap]


def _accept(options: RelocaliseOptions, place: VerifiedPlace) -> bool:
    enough = place.score >= options.min_score and place.details >= options.min_details
    fair = place.inlier_share >= options.min_share and place.found_share >= options.min_found and place.least_share >= options.min_each
    return enough and fair and place.violation <= options.max_through


def _unambiguous(options: RelocaliseOptions, found: list[VerifiedPlace]) -> VerifiedPlace | None:
    """The best place if it is accepted and no other is nearly as good."""
    best = max(found, key=lambda place: place.score, default=None)
    if best is None or not _accept(options, best):
        return None
    rivals = (place for place in found if place.score > options.rival * best.score)
    return None if any(are_distinct(place.T_world_camera, best.T_world_camera) for place in rivals) else best
