"""The method of Li, Yunus, Brasch, Navab & Tombari, RGB-D SLAM with Structural Regularities (ICRA 2021), in the order of the paper.

python examples/the_paper.py [FOLDER]    # a sequence of the TUM benchmark; without one the built-in room
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import trihedron as th

# One plugin a step. Another one is another name: th.manhattan.plane_svd(), th.planes.cape(angle_deg=3).
orb, lsd, line_ransac = th.keypoints.orb(), th.lines.lsd(), th.segments.ransac()
integral_image, connected_components, mean_shift = th.normals.integral_image(), th.planes.connected_components(), th.manhattan.mean_shift()
projection, drift_free, levenberg_marquardt = th.tracks.projection(), th.rotation.drift_free(), th.translation.levenberg_marquardt()
local_map, refinement, covisibility = th.matches.local_map(), th.pose.refine(), th.map.covisibility()
greedy = th.surface.planar_greedy().plugin


@dataclass
class Seen:
    """What is known of a frame; of the first frame's past, nothing."""

    points: Any = None
    segments: Any = None
    planes: Any = None
    axes: Any = None
    tracks: Any = None
    rotation: Any = None
    translation: Any = None
    matches: Any = None
    pose: Any = None
    map: Any = None  # with this frame, if it is a keyframe


def extract(frame):
    """Section III-A: ORB points and LSD segments in the image, lines fitted to the depth along the segments, normals, and the planes they form."""
    normals = integral_image(frame)
    segments = line_ransac(frame, lines=lsd(frame))
    return normals, Seen(orb(frame), segments, connected_components(frame, normals=normals))


def manhattan_frame(normals, now, last):
    """Section IV-A: the three axes of the room, by mean shift of the normals and line directions on the sphere."""
    return mean_shift(normals=normals, segments=now.segments, planes=now.planes, previous=last.axes)


def track(camera, now, last):
    """Points, lines and planes of the last frame that are seen again."""
    return projection(
        camera, keypoints=now.points, segments=now.segments, planes=now.planes, manhattan=now.axes, previous=last.tracks,
        previous_keypoints=last.points, previous_segments=last.segments, previous_planes=last.planes, previous_manhattan=last.axes,
    )  # fmt: skip


def rotation(now, last):
    """Section IV-A: the camera's rotation from the axes alone, so that it does not drift; without axes, from the tracked features."""
    return drift_free(
        manhattan=now.axes, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous=last.rotation, previous_pose=last.pose, map=last.map,
    )  # fmt: skip


def translation(camera, now, last, before_last):
    """Section IV-B: with that rotation held, the translation that minimises the residuals of tracked points, lines and planes."""
    return levenberg_marquardt(
        camera, rotation=now.rotation, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous_pose=last.pose, earlier_pose=before_last.pose, map=last.map,
    )  # fmt: skip


def match(camera, now, last):
    """Sections III-A and V-A: landmarks of the local map that are seen from there; planes by angle and distance."""
    return local_map(
        camera, rotation=now.rotation, translation=now.translation, keypoints=now.points, segments=now.segments, planes=now.planes, map=last.map
    )


def refine(camera, now, last):
    """Section IV-C: all six degrees of freedom, by matched landmarks and by planes that are parallel or perpendicular to those of the map."""
    return refinement(
        camera, rotation=now.rotation, translation=now.translation, tracks=now.tracks, matches=now.matches,
        keypoints=now.points, segments=now.segments, planes=now.planes, previous=last.pose, map=last.map,
    )  # fmt: skip


def keyframe(frame, now, last):
    """Section V-A: a frame that shows enough new becomes a keyframe, and its features landmarks of the map."""
    return covisibility(frame, pose=now.pose, keypoints=now.points, segments=now.segments, planes=now.planes, matches=now.matches, map=last.map)


def main(folder="", **options):
    """Track the sequence; return the poses and the mesh (section V)."""
    dataset = th.dataset.tum(path=folder, **options) if folder else th.dataset.synthetic(**options)
    poses, mesh, last, before_last = [], greedy.start(), Seen(), Seen()
    for frame in filter(None, map(dataset, range(len(dataset)))):
        normals, now = extract(frame)
        now.axes = manhattan_frame(normals, now, last)
        now.tracks = track(frame.camera, now, last)
        now.rotation = rotation(now, last)
        now.translation = translation(frame.camera, now, last, before_last)
        now.matches = match(frame.camera, now, last)
        now.pose = refine(frame.camera, now, last)
        now.map = keyframe(frame, now, last) or last.map
        mesh = greedy.add(mesh, frame, now.planes, now.rotation, now.pose, now.map)
        last, before_last = now, last
        poses.append(now.pose)
    return poses, greedy.finish(mesh, last.map)


if __name__ == "__main__":
    found, surface = main(*sys.argv[1:])
    print(f"{len(found)} frames, {len(surface.triangles)} triangles; the last camera is at", found[-1].T_world_camera[:3, 3].round(3), "m")
