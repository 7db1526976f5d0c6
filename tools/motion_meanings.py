"""Promises of the slots of motion and the map, as figures of calls on rendered frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import F64, LOST, OK, Building, Correction, Map, Matches, Pose, Rotation, Surface, Tracks, Translation
from trihedron.pipeline.core.value_checks import check_together
from trihedron.tools.judged_calls import Call, Figure, definite, most_often, pose_errors

EQUIVALENT = [  # the 24 rotations that map the axes onto each other
    matrix
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(matrix := np.diag(signs)[:, list(order)]) > 0.0
]
RIGHT_PX = 5.0  # of a correct pair
RIGHT_M, RIGHT_DEG = 0.05, 2.0  # of a pose after a few frames


def ids_exist(call: Call) -> Iterator[Figure]:
    """Rows and ids name what is there. Raises RecordingError, which names the place where they do not."""
    rows = ("keypoints", "segments", "planes")
    features = {name: call.topics.get(name) for name in rows} | {f"previous_{name}": call.previous.get(name) for name in rows}
    check_together({**features, "map": call.map, "value": call.value}, "value", {})
    yield Figure("number of ids that do not exist", 0.0, most=0.0)


# Rotation.


def _angle_deg(R: F64) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))))


def _log_so3(R: F64) -> F64:
    """Rotation vector (3,) of a small rotation."""
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def _rotation_figures(name: str, phi: F64, covariance: F64, most_deg: float, most_sigma: float) -> Iterator[Figure]:
    """Figures of an error of rotation phi (rad)."""
    yield Figure(f"angle of {name} from the truth", float(np.degrees(np.linalg.norm(phi))), "deg", most=most_deg)
    if np.linalg.det(covariance) > 0.0:
        yield Figure(f"error of {name}", float(np.sqrt(phi @ np.linalg.solve(covariance, phi) / 3.0)), "of the stated σ", most=most_sigma)


def true_axes(call: Call) -> Iterator[Figure]:
    """The Manhattan frame is that of the room, but for the order and signs of its axes, within its covariance."""
    value = call.value
    if value.supported and len(value.rotations):
        truth = call.T_room_camera[:3, :3].T
        errors = [[R @ (truth @ other).T for other in EQUIVALENT] for R in value.rotations]
        best = [min(row, key=_angle_deg) for row in errors]
        row = min(range(len(best)), key=lambda k: _angle_deg(best[k]))
        yield from _rotation_figures("the axes", _log_so3(best[row].T), value.covariance[row], RIGHT_DEG, 10.0)


def axes_figures(call: Call) -> Iterator[Figure]:
    """Covariances that are positive definite, ids that differ, and counts that are not negative."""
    value = call.value
    yield from definite("a covariance", value.covariance, strict=True)
    yield Figure("number of times that an id occurs", most_often(value.ids), most=1.0)
    yield Figure("least number of inliers", float(value.inliers.min(initial=0)), least=0.0)
    yield Figure("least spread", float(np.nanmin(value.spread, initial=0.0)), "rad", least=0.0)


def same_axes(calls: Sequence[Call]) -> Iterator[Figure]:
    """The axes keep their order and signs: of the equivalent rotations, the nearest to the previous one is taken."""
    for a, b in pairwise(calls):
        if len(a.value.rotations) and len(b.value.rotations) and a.value.supported and b.value.supported:
            moved = b.T_room_camera[:3, :3].T @ a.T_room_camera[:3, :3]
            angle = _angle_deg(b.value.rotations[0] @ (moved @ a.value.rotations[0]).T)
            yield Figure("rotation of the axes in the room since the frame before", angle, "deg", most=10.0, frame=b.frame.index)


def rotation_figures(call: Call) -> Iterator[Figure]:
    """A rotation with a covariance, and the Manhattan frames' ids."""
    value: Rotation = call.value
    yield from definite("the covariance", value.covariance)
    yield Figure("number of times that an id occurs", most_often(value.ids), most=1.0)
    yield Figure("least weight", float(value.weights.min(initial=0.0)), least=0.0)


def true_rotation(call: Call) -> Iterator[Figure]:
    """The camera's rotation in the world of the first camera, within its covariance."""
    phi = _log_so3(call.value.R_world_camera.T @ call.T_world_camera[:3, :3])
    yield from _rotation_figures("the rotation", phi, call.value.covariance, RIGHT_DEG, 10.0)


# Pairs.


def track_pairs(call: Call) -> Iterator[Figure]:
    """Rows are paired once, and the previous geometry is a copy of the previous features."""
    value: Tracks = call.value
    for name in ("keypoints", "segments", "planes"):
        for column, side in enumerate(("previous", "current")):
            if (name, side) != ("planes", "previous"):  # a plane may come apart
                yield Figure(f"number of pairs of one {side} row of {name}", most_often(getattr(value, name)[:, column]), most=1.0)
    yield Figure("previous_index", float(value.previous_index), least=float(call.frame.index - 1), most=float(call.frame.index - 1))
    if call.previous.get("keypoints") is not None and len(value.keypoints):
        off = np.abs(value.points_m - call.previous["keypoints"].points_m[value.keypoints[:, 0]])
        yield Figure("distance of points_m from the previous points", float(np.nanmax(off, initial=0.0)), "m", most=1e-5)


def true_tracks(call: Call) -> Iterator[Figure]:
    """Pairs are of one place, and the rotation is that of the camera."""
    value: Tracks = call.value
    T_current_previous = np.asarray(invert(call.T_room_camera) @ call.data.true_pose(call.position - 1), np.float64)
    points = transform(T_current_previous, value.points_m.astype(np.float64))
    yield from _wrong_pairs(call, points, call.topics["keypoints"].pixels[value.keypoints[:, 1]])
    angle = _angle_deg(value.R_current_previous @ T_current_previous[:3, :3].T)
    yield Figure("angle of R_current_previous from the truth", angle, "deg", most=RIGHT_DEG)


def _wrong_pairs(call: Call, points: F64, pixels: NDArray[np.float32]) -> Iterator[Figure]:
    known = np.isfinite(points).all(axis=1)
    if known.sum() >= 10:
        off = np.linalg.norm(call.frame.camera.project(points[known]) - pixels[known], axis=1)
        yield Figure(f"share of pairs of points more than {RIGHT_PX:g} px apart", float((~(off <= RIGHT_PX)).mean()), most=0.2)


def match_pairs(call: Call) -> Iterator[Figure]:
    """Features and landmarks are paired once, with landmarks that are alive."""
    value: Matches = call.value
    if call.map is None:
        return
    yield Figure("map_revision", float(value.map_revision), least=float(call.map.revision), most=float(call.map.revision))
    for name, table in (("keypoints", call.map.points), ("segments", call.map.lines), ("planes", call.map.planes)):
        pairs = getattr(value, name)
        yield Figure(f"number of pairs of one row of {name}", most_often(pairs[:, 0]), most=1.0)
        if name != "planes":  # a landmark is seen in parts
            yield Figure(f"number of pairs of one landmark of {name}", most_often(pairs[:, 1]), most=1.0)
        yield Figure(f"number of landmarks of {name} that are not alive", float((~table.column("alive")[pairs[:, 1]]).sum()), most=0.0)


def true_matches(call: Call) -> Iterator[Figure]:
    """Points of the map are where they are matched."""
    value: Matches = call.value
    if call.map is None:
        return
    points = transform(np.asarray(invert(call.T_world_camera), np.float64), call.map.points.column("position_m")[value.keypoints[:, 1]])
    yield from _wrong_pairs(call, points, call.topics["keypoints"].pixels[value.keypoints[:, 0]])


# Position and pose.


def translation_figures(call: Call) -> Iterator[Figure]:
    """A covariance, unit vectors, and inliers where measurements took part."""
    value: Translation = call.value
    yield from definite("the covariance", value.covariance)
    for vector in value.unobservable:
        yield Figure("length of an unobservable direction", float(np.linalg.norm(vector)), least=1.0 - 1e-6, most=1.0 + 1e-6)
    if value.estimated and call.position:  # the first frame is the world
        yield Figure("number of inliers of an estimate", float(value.inliers.sum()), least=1.0)


def true_translation(call: Call) -> Iterator[Figure]:
    """The camera's position, within its covariance."""
    off = call.T_world_camera[:3, 3] - call.value.t_world_camera
    yield Figure("distance of the position from the truth", float(np.linalg.norm(off)), "m", most=RIGHT_M)
    if np.linalg.det(call.value.covariance) > 0.0:
        sigma = float(np.sqrt(off @ np.linalg.solve(call.value.covariance, off) / 3.0))
        yield Figure("error of the position", sigma, "of the stated σ", most=40.0)


def pose_figures(call: Call) -> Iterator[Figure]:
    """Covariances, and the same pose relative to its keyframe."""
    value: Pose = call.value
    for name in ("covariance", "map_covariance", "keyframe_covariance", "local_covariance"):
        yield from definite(f"`{name}`", getattr(value, name))
    yield Figure(
        "number of inliers of a pose that is not lost", float(value.inliers.sum()), least=0.0 if value.status == LOST or call.map is None else 1.0
    )
    yield Figure("noise_scale", value.noise_scale, least=1e-6)
    if value.reference >= 0 and call.map is not None:
        of_reference = call.map.keyframes.row("T_world_camera", value.reference) @ value.T_reference_camera
        off = float(np.abs(of_reference - value.T_world_camera).max())
        yield Figure("distance of T_world_camera from its keyframe's pose times T_reference_camera", off, most=1e-6)


def true_pose(call: Call) -> Iterator[Figure]:
    """The camera's pose in the world of the first camera, unless it is lost, and within its covariance where it is `ok`."""
    value: Pose = call.value
    if value.status == LOST or value.submap:
        return
    metres, degrees = pose_errors(value.T_world_camera, call.T_world_camera)
    yield Figure("distance of the position from the truth", metres, "m", most=RIGHT_M)
    yield Figure("angle of the rotation from the truth", degrees, "deg", most=RIGHT_DEG)
    if value.status == OK and call.map is not None:  # the covariance of a degraded pose is no promise
        sigma = float(np.sqrt(max(np.trace(value.covariance[:3, :3]), 1e-18)))
        yield Figure("error of the position", metres / sigma, "of the stated σ", most=10.0)


def stamps(calls: Sequence[Call]) -> Iterator[Figure]:
    """A value has the stamp of its frame."""
    for call in calls:
        off = (call.value.stamp_ns - call.frame.stamp_ns) * 1e-9
        yield Figure("time from the frame's stamp to that of the value", off, "s", least=0.0, most=0.0, frame=call.frame.index)


# The map.


def keyframe_order(calls: Sequence[Call]) -> Iterator[Figure]:
    """Keyframes are in order of time, and revisions count up."""
    for call in calls:
        keyframes = call.value.keyframes
        if len(keyframes) > 1:
            for name in ("index", "stamp_ns"):
                step = int(np.diff(keyframes.column(name)).min())
                yield Figure(f"least step of `{name}` from a keyframe to the next", float(step), least=1.0, frame=call.frame.index)
    for a, b in pairwise(calls):
        yield Figure("step of `revision`", float(b.value.revision - a.value.revision), least=1.0, frame=b.frame.index)


def map_figures(call: Call) -> Iterator[Figure]:
    """Covariances, information, and counts of landmarks."""
    value: Map = call.value
    alive = value.keyframes.column("alive")
    for name in ("covariance", "world_covariance"):
        yield from definite(f"`{name}` of a keyframe", value.keyframes.column(name)[alive])
    for name, table in (("points", value.points), ("lines", value.lines), ("planes", value.planes)):
        alive = table.column("alive")
        column = "covariance" if name == "planes" else "information"
        yield from definite(f"`{column}` of {name}", table.column(column)[alive])
        found, visible = table.column("found")[alive], table.column("visible")[alive]
        yield Figure(f"number of times that one of the {name} was found more than visible", float((found - visible).max(initial=0)), most=0.0)
    if value.planes.column("alive").any():
        weight = value.planes.column("moments")[value.planes.column("alive")][:, 3, 3]
        yield Figure("least weight of the moments of planes", float(weight.min()), least=1e-9)


def true_map(call: Call) -> Iterator[Figure]:
    """Keyframes are at their true poses, points on true surfaces."""
    value: Map = call.value
    keyframes = value.keyframes
    for row in np.flatnonzero(keyframes.column("alive") & (keyframes.column("submap") == 0)).tolist():
        yield from _true_keyframe(call, int(keyframes.row("index", row)), keyframes.row("T_world_camera", row))
    points = value.points.column("position_m")[value.points.column("alive")]
    seen = transform(np.asarray(invert(call.T_world_camera), np.float64), points)
    pixels = call.frame.camera.project(seen)
    inside = np.isfinite(pixels).all(axis=1) & (pixels >= 0.0).all(axis=1)
    inside &= (pixels <= [call.frame.camera.width - 1, call.frame.camera.height - 1]).all(axis=1)
    if inside.sum() >= 10:
        low, high = call.depths_around(pixels[inside], measured=False)
        off = np.maximum(np.maximum(low - seen[inside, 2], seen[inside, 2] - high), 0.0) / seen[inside, 2]
        yield Figure("median distance of the points in view from the true surface, of their depth,", float(np.median(off)), most=0.03)


def _true_keyframe(call: Call, index: int, T_world_camera: F64) -> Iterator[Figure]:
    position = call.position - (call.frame.index - index)
    if 0 <= position <= call.position:
        metres, degrees = pose_errors(T_world_camera, call.true_pose(position))
        yield Figure("distance of a keyframe from its true position", metres, "m", most=RIGHT_M)
        yield Figure("angle of a keyframe from its true rotation", degrees, "deg", most=RIGHT_DEG)


def correction_figures(call: Call) -> Iterator[Figure]:
    """Ids of the map that the call was given, each once, with information that is positive semidefinite."""
    value: Correction = call.value
    revision = float(call.topics["map"].revision)
    yield Figure("based_on", float(value.based_on), least=revision, most=revision)
    for name in ("keyframe_ids", "point_ids", "line_ids", "plane_ids"):
        yield Figure(f"number of times that one of `{name}` occurs", most_often(getattr(value, name)), most=1.0)
    for name in ("point_information", "line_information", "plane_covariance"):
        yield from definite(f"`{name}`", getattr(value, name))


def true_correction(call: Call) -> Iterator[Figure]:
    """Corrected keyframes are at their true poses."""
    for row, T in zip(call.value.keyframe_ids.tolist(), call.value.T_world_keyframe):
        yield from _true_keyframe(call, int(call.topics["map"].keyframes.row("index", row)), T)


# Dense models.


def view_figures(call: Call) -> Iterator[Figure]:
    """A view from the pose, of a whole fraction of the frame's size, whose depths are true."""
    value = call.value
    metres, _ = pose_errors(value.T_world_camera, call.topics["pose"].T_world_camera)
    yield Figure("distance of T_world_camera from the pose", metres, "m", most=1e-6)
    stride = call.frame.camera.height // value.depth_m.shape[0]
    rows, columns = -(-call.frame.camera.height // stride), -(-call.frame.camera.width // stride)
    yield Figure("rows of the view beyond a whole fraction of the frame's", float(value.depth_m.shape[0] - rows), least=-1.0, most=0.0)
    yield Figure("columns of the view beyond a whole fraction of the frame's", float(value.depth_m.shape[1] - columns), least=-1.0, most=0.0)
    truth = call.depth_m[::stride, ::stride][: value.depth_m.shape[0], : value.depth_m.shape[1]]
    seen = value.depth_m[: truth.shape[0], : truth.shape[1]] > 0.0
    if seen.any():
        off = np.abs(value.depth_m[: truth.shape[0], : truth.shape[1]] - truth)[seen] / truth[seen]
        yield Figure("median error of depth, of the true one,", float(np.median(off)), most=0.03)
    lengths = np.linalg.norm(value.normals[np.isfinite(value.normals).all(axis=-1)], axis=-1)
    if len(lengths):
        yield Figure("deviation of the normals from length 1", float(np.abs(lengths - 1.0).max()), most=1e-3)


def surface_figures(call: Call) -> Iterator[Figure]:
    """Triangles of three corners, on true surfaces."""
    value: Surface = call.value
    if not len(value.triangles):
        return
    a, b, c = value.triangles.T
    yield Figure("number of triangles with two equal corners", float(((a == b) | (b == c) | (a == c)).sum()), most=0.0)
    on_surface = np.zeros(len(value.vertices_m), bool)
    in_view = np.zeros(len(value.vertices_m), bool)
    for position in range(call.position + 1):
        near, seen = _near_truth(call, position, value.vertices_m.astype(np.float64))
        on_surface |= near
        in_view |= seen
    if in_view.any():
        share = float((~on_surface[in_view]).mean())
        yield Figure("share of vertices more than 5 % of their depth off the true surface", share, most=0.2)


def _near_truth(call: Call, position: int, vertices: F64) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks (n,) of the points (n, 3) of the world that are near the true surface a frame shows, and of those in its view."""
    camera = call.frame.camera
    seen = transform(np.asarray(invert(call.true_pose(position)), np.float64), vertices)
    pixels = np.nan_to_num(camera.project(seen), nan=-1.0)
    inside: NDArray[np.bool_] = np.asarray((pixels >= 0.0).all(axis=1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1))
    x, y = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(int).T
    truth = call.data.true_planes(position)[0][y, x]
    near: NDArray[np.bool_] = np.asarray(inside & (np.abs(truth - seen[:, 2]) <= 0.05 * truth))
    return near, inside


def building_figures(call: Call) -> Iterator[Figure]:
    """Rooms with the area that their loops enclose, walls with a thickness and a length, and covariances."""
    value: Building = call.value
    for row, area in enumerate(value.areas_m2):
        enclosed = 0.0
        for begin, end in value.loops[value.loops[:, 0] == row, 1:]:
            x, y = value.corners_m[begin:end].T
            enclosed += 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        yield Figure(f"area of room {row} less that of its loops", float(area) - enclosed, "m²", least=-1e-3, most=1e-3)
    if len(value.walls_m):
        yield Figure("least length of a wall", float(np.linalg.norm(value.walls_m[:, 1] - value.walls_m[:, 0], axis=1).min()), "m", least=1e-3)
        yield Figure("least thickness of a wall", float(np.nanmin(value.thickness_m, initial=np.inf)), "m", least=0.0)
        yield from definite("`wall_covariance`", value.wall_covariance)
    yield from definite("`opening_covariance`", value.opening_covariance)
