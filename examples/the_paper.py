"""The method of Li, Yunus, Brasch, Navab & Tombari, RGB-D SLAM with Structural Regularities (ICRA 2021), in the order of the paper.

As published it has no bundle adjustment, loop closure or relocalisation. Each step is one plugin of this project with its default options; the
docstring of its file has the equations, thresholds and weights, and docs/explanation/paper.md what differs from the paper. A stage keeps no state:
what it needs of the past is passed to it, and is None before there is one. A lost frame has a pose of status `lost`, which no keyframe and no
mesh is made of.

python examples/the_paper.py [FOLDER]    # a sequence of the TUM benchmark; without one the built-in room
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import trihedron as th

# Another plugin is another name, options are arguments: th.manhattan.plane_svd(), th.planes.cape(angle_deg=3). `trihedron
# plugins manhattan` lists the plugins of a slot, with the name of one its options and defaults; its file is plugins/SLOT/NAME.py. Every plugin of a
# slot takes the same keywords, and any function that takes and returns the same types can stand in its place.
orb, lsd, line_ransac = th.keypoints.orb(), th.lines.lsd(), th.segments.ransac()
integral_image, connected_components, mean_shift = th.normals.integral_image(), th.planes.connected_components(), th.manhattan.mean_shift()
projection, drift_free, levenberg_marquardt = th.tracks.projection(), th.rotation.drift_free(), th.translation.levenberg_marquardt()
local_map, refinement, covisibility = th.matches.local_map(), th.pose.refine(), th.map.covisibility()
greedy = th.surface.planar_greedy().plugin  # itself, since a surface is no function of a frame: start, add every frame, finish


@dataclass
class Seen:
    """What is known of a frame; of the first frame's past, nothing. After a lost frame tracks go on from it, and poses stay lost until enough of the
    map agrees. The types are those of trihedron.pipeline.core.types."""

    points: Any = None  # Keypoints: pixels, and 3D points in the camera's frame with their σ and descriptors
    segments: Any = None  # Segments: end points in pixels and in 3D
    planes: Any = None  # Planes: coefficients with covariance, and the regions of the image
    axes: Any = None  # ManhattanFrame: the rotation from the room's axes to the camera
    tracks: Any = None  # Tracks: pairs of features, last frame and this one, and the rotation between them
    rotation: Any = None  # Rotation: of the camera in the world, the frame of the first camera; and R_mw of eq. 1, that of the room's axes
    translation: Any = None  # Translation: position of the camera in the world
    matches: Any = None  # Matches: features and their landmarks of the map
    pose: Any = None  # Pose: T_world_camera, its covariance (position, then rotation, camera frame), stamp_ns, and status ok, degraded or lost
    map: Any = None  # Map: keyframes and landmarks, with this frame if it is a keyframe; a value, which nothing changes


def extract(frame):
    """Section III-A: ORB points and LSD segments in the image, lines fitted to the depth along the segments, normals, and the planes they form."""
    normals = integral_image(frame)
    segments = line_ransac(frame, lines=lsd(frame))
    return normals, Seen(orb(frame), segments, connected_components(frame, normals=normals))


def manhattan_frame(normals, now, last):
    """Section IV-A: the three axes of the room in the camera's frame, by mean shift of the normals and line directions on the sphere, then fitted to
    the planes and lines on them."""
    return mean_shift(normals=normals, segments=now.segments, planes=now.planes, previous=last.axes)


def track(camera, now, last):
    """Points, lines and planes of the last frame that are seen again: searched where the rotation between the axes of both frames, else the last
    motion (`last.tracks`), projects them."""
    return projection(
        camera, keypoints=now.points, segments=now.segments, planes=now.planes, manhattan=now.axes, previous=last.tracks,
        previous_keypoints=last.points, previous_segments=last.segments, previous_planes=last.planes, previous_manhattan=last.axes,
    )  # fmt: skip


def rotation(now, last):
    """Section IV-A, eq. 1: the camera's rotation from the axes and R_mw, known since the first frame that showed them, so that it does not drift.
    Beyond the paper it is weighed by covariance against that of the tracks, which stand alone where no axes are in view. Of the map it takes where
    the last pose is now: with bundle adjustment or loops its keyframe would move, here nothing moves it."""
    return drift_free(
        manhattan=now.axes, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous=last.rotation, previous_pose=last.pose, map=last.map,
    )  # fmt: skip


def translation(camera, now, last, before_last):
    """Section IV-B: with that rotation held, the position that minimises the residuals of tracked points, lines and planes of the last frame (eqs. 2
    to 7). Without any, and not in the paper, it is predicted by the velocity between the earlier poses. The map is taken as above."""
    return levenberg_marquardt(
        camera, rotation=now.rotation, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous_pose=last.pose, earlier_pose=before_last.pose, map=last.map,
    )  # fmt: skip


def match(camera, now, last):
    """Sections III-A and IV-C: landmarks of the local map that are in view of the camera at that rotation and position, by descriptors; planes by
    angle and distance."""
    return local_map(
        camera, rotation=now.rotation, translation=now.translation, keypoints=now.points, segments=now.segments, planes=now.planes, map=last.map
    )


def refine(camera, now, last):
    """Section IV-C: all six degrees of freedom, by matched landmarks and by planes that are parallel or perpendicular to those of the map (eqs. 7
    and 8 together). A frame without matches retains the tracked pose; the first is the origin. Of the tracks it takes whether the image repeats."""
    return refinement(
        camera, rotation=now.rotation, translation=now.translation, tracks=now.tracks, matches=now.matches,
        keypoints=now.points, segments=now.segments, planes=now.planes, previous=last.pose, map=last.map,
    )  # fmt: skip


def keyframe(frame, now, last):
    """Section V-A: a frame that shows enough new becomes a keyframe: its features become landmarks, or observations of those that they match, and
    landmarks that are seldom found again are removed. Returns a new map, None where the frame is no keyframe."""
    return covisibility(frame, pose=now.pose, keypoints=now.points, segments=now.segments, planes=now.planes, matches=now.matches, map=last.map)


def main(folder="", **options):
    """Track the sequence; return the poses and the mesh (section V-B): points on each plane of the map are joined by
    greedy triangulation. `options` are those of the data set."""
    dataset = th.dataset.tum(path=folder, **options) if folder else th.dataset.synthetic(**options)
    poses, mesh, last, before_last = [], greedy.start(), Seen(), Seen()
    for frame in filter(None, map(dataset, range(len(dataset)))):  # None: an image that cannot be read
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
    ok = sum(pose.status == "ok" for pose in found)
    print(f"{len(found)} frames, {ok} ok; {len(surface.triangles)} triangles; the last camera is at", found[-1].T_world_camera[:3, 3].round(3), "m")
