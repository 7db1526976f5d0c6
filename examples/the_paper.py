"""The method of Li, Yunus, Brasch, Navab & Tombari, RGB-D SLAM with Structural Regularities (ICRA 2021), in the order of the paper.

The paper describes no bundle adjustment, loop closure or relocalisation, and here is none. Each step is one plugin of this project with its default
options; the docstring of its file has the equations, thresholds and weights, and docs/explanation/paper.md every difference from the paper. What the
docstrings below call an addition is one of them. A stage keeps no state: what it needs of the past is passed to it, and is None before there is one.

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
    """What is known of a frame, and nothing before the first. Types are those of trihedron.pipeline.core.types. Every value has the number (`index`)
    and the time (`stamp_ns`) of its frame, so frames may be missing; everything estimated has a covariance, by which it is weighed."""

    points: Any = None  # Keypoints: pixels, ORB descriptors, and where there is depth 3D points in the camera's frame
    segments: Any = None  # Segments: end points in pixels and, where there is depth, in 3D; LBD descriptors
    planes: Any = None  # Planes: coefficients (normal, distance), and the regions of the image
    axes: Any = None  # ManhattanFrame: R_camera_manhattan; with `supported` False, a frame without axes in view passes on those of the last one
    tracks: Any = None  # Tracks: pairs (feature of the last frame, of this one), the 3D of the former, and the rotation R_current_previous they give
    rotation: Any = None  # Rotation: R_world_camera, the world being the frame of the first camera, and R_world_manhattan, the transpose of R_mw
    translation: Any = None  # Translation: position of the camera in the world; `estimated` False where it is only predicted
    matches: Any = None  # Matches: pairs (feature, landmark of the map), and pairs of planes that are parallel or perpendicular
    pose: Any = None  # Pose: T_world_camera; its newest keyframe (`reference`); status ok, degraded (little evidence) or lost (not measured)
    map: Any = None  # Map: keyframes and landmarks, with this frame if it is a keyframe; a value, which nothing changes


def extract(frame):
    """Section III-A: ORB points and LSD segments in the image, lines fitted to the depth along the segments, normals, and the planes they form."""
    normals = integral_image(frame)
    segments = line_ransac(frame, lines=lsd(frame))
    return normals, Seen(orb(frame), segments, connected_components(frame, normals=normals))


def manhattan_frame(normals, now, last):
    """Section IV-A: the three axes of the room in the camera's frame, by mean shift of the normals and line directions on the sphere, from the axes
    of the last frame. An addition: the result is fitted to the whole planes and lines that lie along an axis."""
    return mean_shift(normals=normals, segments=now.segments, planes=now.planes, previous=last.axes)


def track(camera, now, last):
    """Points and lines of the last frame that are seen again, by descriptors, and planes, by angle and distance: searched where the rotation between
    the axes of both frames, else that of the frames before (`last.tracks`), projects them; the translation is unknown, so the search is wide."""
    return projection(
        camera, keypoints=now.points, segments=now.segments, planes=now.planes, manhattan=now.axes, previous=last.tracks,
        previous_keypoints=last.points, previous_segments=last.segments, previous_planes=last.planes, previous_manhattan=last.axes,
    )  # fmt: skip


def rotation(camera, now, last):
    """Section IV-A, eq. 1: the camera's rotation from the axes and R_mw (in `last.rotation`), which the first frame that showed axes defined, so that
    it does not drift from then on. An addition: it is fused by covariance with a prediction, the refined rotation of `last.pose` turned by the motion
    of the pairs; that names the axes (the nearest of their 24 names), and stands alone where none are in view; without pairs, too, the last turn goes
    on. With bundle adjustment or loops the map would tell where the keyframe `last.pose.reference` is now, and the last pose with it; here nothing
    moves it."""
    return drift_free(
        camera, manhattan=now.axes, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous=last.rotation, previous_pose=last.pose, map=last.map,
    )  # fmt: skip


def translation(camera, now, last, before_last):
    """Section IV-B: with that rotation held, the position that minimises the residuals (eqs. 2 to 7) of this frame's points, lines and planes against
    their pairs in the last frame, whose 3D geometry is in the tracks; the paper takes lines from the keyframe and planes from the map. An addition:
    without pairs the position is predicted by the velocity between the two poses before. The map is taken as above."""
    return levenberg_marquardt(
        camera, rotation=now.rotation, tracks=now.tracks, keypoints=now.points, segments=now.segments, planes=now.planes,
        previous_pose=last.pose, earlier_pose=before_last.pose, map=last.map,
    )  # fmt: skip


def match(camera, now, last):
    """Sections III-A and IV-C: landmarks of the local map (of the newest keyframes, and those that see most of the same) in view of the camera at
    that rotation and position: points and lines by descriptors, planes by angle and distance; other planes as parallel or perpendicular, by angle."""
    return local_map(
        camera, rotation=now.rotation, translation=now.translation, keypoints=now.points, segments=now.segments, planes=now.planes, map=last.map
    )


def refine(camera, now, last):
    """Section IV-C: all six degrees of freedom, by matched landmarks and by planes that are parallel or perpendicular to those of the map (eqs. 7 and
    8 together). It starts at the rotation and position above, which are a prior with their covariances; the pairs of the tracks add no residuals, and
    tell whether the image repeats the last one bit for bit. The first pose is the origin. An addition is the status: `degraded` with few matches, or
    from the second such repeat on; `lost` where neither the last frame (`now.translation.estimated`) nor the map is seen. A lost pose is the
    predicted one, and stays lost until enough of the map agrees, however well it fits the last frame."""
    return refinement(
        camera, rotation=now.rotation, translation=now.translation, tracks=now.tracks, matches=now.matches,
        keypoints=now.points, segments=now.segments, planes=now.planes, previous=last.pose, map=last.map,
    )  # fmt: skip


def keyframe(frame, now, last):
    """Section V-A: a frame becomes a keyframe where the camera moved, turned or lost half of the landmarks since the last one (the paper does not
    say): its features become landmarks, or observations of those that they match, and landmarks that few of the next keyframes find are removed.
    Returns a new map, None where the frame is no keyframe; a lost frame is none."""
    return covisibility(frame, pose=now.pose, keypoints=now.points, segments=now.segments, planes=now.planes, matches=now.matches, map=last.map)


def main(folder="", **options):
    """Track the sequence; return the poses and the mesh (section V-B): `add` retains each frame that is not lost and shows surface not seen before;
    `finish` assigns its planes to those of the map, by angle and distance, and joins the points of its depth on each by greedy triangulation (the
    rotation's axes tell which way of the mesh is up). `options` are those of the data set."""
    dataset = th.dataset.tum(path=folder, **options) if folder else th.dataset.synthetic(**options)
    poses, mesh, last, before_last = [], greedy.start(), Seen(), Seen()
    for frame in filter(None, map(dataset, range(len(dataset)))):  # None: an image that cannot be read
        normals, now = extract(frame)
        now.axes = manhattan_frame(normals, now, last)
        now.tracks = track(frame.camera, now, last)
        now.rotation = rotation(frame.camera, now, last)
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
