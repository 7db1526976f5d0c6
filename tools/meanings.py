"""The table of promises: what each slot's docstring states beyond types and shapes; slot -> named checks on rendered frames, whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.slots import FOLDS
from trihedron.tools import feature_meanings as of
from trihedron.tools import motion_meanings as in_world
from trihedron.tools.judged_calls import Check, each


@dataclass(frozen=True)
class Meaning:
    """A promise under the name that the page shows; `repeats`: judged on noisy repeats of one view, else on the walk through the room."""

    name: str
    check: Check
    repeats: bool = False


STAMPS = Meaning("stamps", in_world.stamps)

MEANINGS: dict[str, tuple[Meaning, ...]] = {
    "normals": (
        Meaning("unit normals", each(of.unit_normals)),
        Meaning("towards the camera", each(of.normals_face_camera)),
        Meaning("true normals", each(of.true_normals)),
    ),
    "keypoints": (
        Meaning("in the image", each(of.keypoints_inside)),
        Meaning("sigmas", each(of.keypoint_sigmas)),
        Meaning("positions", each(of.keypoint_positions)),
        Meaning("true depth", each(of.true_keypoints)),
        Meaning("scatter", of.keypoint_repeats, repeats=True),
    ),
    "lines": (Meaning("in the image", each(of.lines_inside)), Meaning("repeats", of.line_repeats, repeats=True)),
    "segments": (
        Meaning("rows", each(of.segment_rows)),
        Meaning("positions", each(of.segment_positions)),
        Meaning("covariances", each(of.segment_covariances)),
        Meaning("scatter", of.segment_repeats, repeats=True),
    ),
    "planes": (
        Meaning("signs", each(of.plane_signs)),
        Meaning("regions", each(of.plane_order)),
        Meaning("points on planes", each(of.plane_points)),
        Meaning("moments", each(of.plane_moments)),
        Meaning("covariances", each(of.plane_covariances)),
        Meaning("true planes", of.true_planes),
        Meaning("scatter", of.plane_repeats, repeats=True),
    ),
    "manhattan": (
        Meaning("axes", each(in_world.axes_figures)),
        Meaning("true axes", each(in_world.true_axes)),
        Meaning("same axes", in_world.same_axes),
    ),
    "tracks": (
        Meaning("ids", each(in_world.ids_exist)),
        Meaning("pairs", each(in_world.track_pairs)),
        Meaning("true pairs", each(in_world.true_tracks)),
    ),
    "rotation": (Meaning("rotation", each(in_world.rotation_figures)), Meaning("true rotation", each(in_world.true_rotation))),
    "translation": (Meaning("translation", each(in_world.translation_figures)), Meaning("true position", each(in_world.true_translation))),
    "matches": (
        Meaning("ids", each(in_world.ids_exist)),
        Meaning("pairs", each(in_world.match_pairs)),
        Meaning("true pairs", each(in_world.true_matches)),
    ),
    "pose": (
        Meaning("pose", each(in_world.pose_figures)),
        Meaning("true pose", each(in_world.true_pose)),
    ),
    "map": (
        Meaning("keyframe order", in_world.keyframe_order),
        Meaning("landmarks", each(in_world.map_figures)),
        Meaning("true map", each(in_world.true_map)),
    ),
    "bundle": (Meaning("ids", each(in_world.correction_figures)), Meaning("true poses", each(in_world.true_correction))),
    "loop": (Meaning("ids", each(in_world.correction_figures)), Meaning("true poses", each(in_world.true_correction))),
    "relocalise": (Meaning("pose", each(in_world.pose_figures)), Meaning("true pose", each(in_world.true_pose))),
    "model": (Meaning("true view", each(in_world.view_figures)),),
    "surface": (Meaning("true surface", each(in_world.surface_figures)),),
    "building": (Meaning("plan", each(in_world.building_figures)),),
}


def meanings_of(slot: str) -> tuple[Meaning, ...]:
    """Return the checks of a slot; the stamps of a fold's single value are not judged."""
    return MEANINGS[slot] if slot in FOLDS else (STAMPS, *MEANINGS[slot])
