"""Errors of single stages, frame by frame, by known poses of the camera: the measure of each slot, for the open loop of `trihedron ablate`.

A measure compares what a stage reports for a frame with what it, or its inputs, reported for the frame before, moved by the motion between the two.
So it needs no labelled scene, and later stages hide nothing. All measures are errors: less is better, 0 is perfect; over frames their root mean
square counts. The poses are the ground truth where there is any; else those of the recorded run, and what is measured then is agreement with it.
`cycle px`, `depth mm` and `one-way pairs %` need no truth: they compare an estimate with the pairs, the depth and the descriptors of the two frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import (
    F64,
    LOST,
    Bool,
    Camera,
    Frame,
    Keypoints,
    LineSegments,
    Map,
    Matches,
    Normals,
    Planes,
    Pose,
    Rotation,
    Segments,
    Tracks,
    Translation,
    Value,
)

NEAR_PX = 2.0  # of where a feature must be, to be found again
WRONG_PX = 3.0  # from where a pair's landmark is: a wrong one
OCCLUDED = 0.05  # of its depth that a point may lie behind what is seen there
UNKNOWN_M = 1e6  # in the place of a depth that is not known, where the nearest is looked for
BORDER_PX = 8.0  # of the image, where features are not looked for
STEP_PX = 8  # between the pixels at which normals and depth are compared
SAMPLED_PAIRS = 200  # of a frame, that are matched backwards, too
DEPTH_EDGE = 0.02  # of the depth: normals are compared where the depth agrees so well
LINE_DEG = 5.0  # between the directions of a segment and the same one a frame later
LEAST_SHARE = 0.5  # of a plane's points that must fall on one plane of the next frame
COLUMNS = (
    "normals deg", "points lost %", "lines lost %", "segments mm", "planes mm", "planes deg", "planes lost %", "wrong pairs %", "missed pairs %",
    "one-way pairs %", "wrong matches %", "missed matches %",
    *(f"{stage} {column}" for stage in ("rotation", "translation", "pose") for column in ("cycle px", "depth mm")),
)  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """Values of a frame, by topic, and the pose (4, 4) of its camera."""

    values: Mapping[str, Any]
    T_world_camera: F64

    def get(self, topic: str) -> Any:
        """Return the value of a topic; None where there is none."""
        return self.values.get(topic)

    @property
    def camera(self) -> Camera | None:
        """The camera of the frame, if a stage reads the frame or stands in for it."""
        frame = self.get("dataset") or self.get("frames")
        return getattr(frame, "camera", None)

    @property
    def depth_m(self) -> Any:
        """The depth image (h, w), None where the frame was not read."""
        frame = self.get("dataset")
        return frame.depth_m if isinstance(frame, Frame) else None


Errors = dict[str, float]  # of one frame, by column
Measure = Callable[[Any, Seen, Seen, F64], Errors]  # the value, its frame, the frame before, T_now_before (4, 4)


def stage_errors(topic: str, now: Seen, before: Seen | None) -> Errors:
    """Return the errors of a stage's value in one frame, by column; none in the first frame, and where the measure lacks what it needs."""
    value = now.get(topic)
    measure = MEASURES.get(type(value)) if isinstance(value, Value) else None
    if measure is None or before is None:
        return {}
    found = measure(value, now, before, invert(now.T_world_camera) @ before.T_world_camera)
    return {name: error for name, error in found.items() if np.isfinite(error)}


def of_normals(value: Normals, now: Seen, before: Seen, T: F64) -> Errors:
    """`normals deg`: median angle between the normal at a pixel and the one that the same point of the scene had a frame before."""
    last, camera, depth, last_depth = before.get("normals"), now.camera, now.depth_m, before.depth_m
    if not isinstance(last, Normals) or camera is None or depth is None or last_depth is None:
        return {}
    (v, u), points, pixels, known = warp_grid(last_depth, camera, T)
    pixels = np.rint(pixels)
    known[known] = np.abs(at(depth, pixels[known]) - points[known, 2]) < DEPTH_EDGE * points[known, 2]
    old = last.normals[v[known] // last.stride, u[known] // last.stride] @ T[:3, :3].T
    new = at(value.normals, pixels[known] // value.stride)
    cosines = np.sum(old * new, axis=1)
    return {"normals deg": median(np.degrees(np.arccos(np.clip(cosines[np.isfinite(cosines)], -1.0, 1.0))))}


def of_keypoints(value: Keypoints, now: Seen, before: Seen, T: F64) -> Errors:
    """`points lost %`: share of the last frame's key points with depth, still in view, that have no key point within 2 px."""
    last = before.get("keypoints")
    if not isinstance(last, Keypoints) or now.camera is None:
        return {}
    pixels, visible = in_view(transform(T, last.points_m.astype(np.float64)), now)
    return {"points lost %": share(distances(pixels[visible], value.pixels) > NEAR_PX)}


def of_lines(value: LineSegments, now: Seen, before: Seen, T: F64) -> Errors:
    """`lines lost %`: share of the last frame's segments with depth at both ends, still in view, of which none is within 2 px and 5 deg."""
    last, camera = before.get("lines"), now.camera
    if not isinstance(last, LineSegments) or camera is None or before.depth_m is None:
        return {}
    ends = last.endpoints_px.reshape(-1, 2).astype(np.float64)
    depth = at(nearest_depth(before.depth_m), np.clip(np.rint(ends), 0, [camera.width - 1, camera.height - 1])).astype(np.float64)
    points = camera.back_project(ends, np.where(depth < UNKNOWN_M, depth, np.nan))
    pixels, visible = in_view(transform(T, points), now)
    both = visible.reshape(-1, 2).all(axis=1)
    return {"lines lost %": share(nearest_segment(pixels.reshape(-1, 2, 2)[both], value.endpoints_px.astype(np.float64)) < 0)}


def of_segments(value: Segments, now: Seen, before: Seen, T: F64) -> Errors:
    """`segments mm`: median distance of the ends of the last frame's 3D segments from the line of the same segment now, of those that are found."""
    last, camera = before.get("segments"), now.camera
    if not isinstance(last, Segments) or camera is None:
        return {}
    points = transform(T, last.endpoints_m.reshape(-1, 3).astype(np.float64))
    pixels, visible = in_view(points, now)
    both, known = visible.reshape(-1, 2).all(axis=1), np.isfinite(value.endpoints_m).all(axis=(1, 2))
    old, lines = points.reshape(-1, 2, 3)[both], value.endpoints_m[known].astype(np.float64)
    if not len(old) or not len(lines):
        return {}
    rows = nearest_segment(pixels.reshape(-1, 2, 2)[both], value.endpoints_px[known].astype(np.float64))
    old, lines = old[rows >= 0], lines[rows[rows >= 0]]
    along = lines[:, 1] - lines[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    off = np.linalg.norm(np.cross(old - lines[:, :1], along[:, None]), axis=2)
    return {"segments mm": median(1e3 * off)}


def of_planes(value: Planes, now: Seen, before: Seen, T: F64) -> Errors:
    """`planes mm`, `planes deg`: distance of the last frame's planes, in the middle of their points, from the planes now, and the angle between their
    normals, as root mean squares over planes. `planes lost %`: share of the planes still in view of which less than half falls on one plane."""
    last, camera = before.get("planes"), now.camera
    if not isinstance(last, Planes) or camera is None:
        return {}
    offsets, angles, lost = [], [], []
    for plane, samples in zip(last.coefficients, last.samples_m):
        points = transform(T, samples[np.isfinite(samples[:, 0])].astype(np.float64))
        normal = T[:3, :3] @ plane[:3]
        labels = labels_at(points, value, camera)
        if not len(labels):
            continue
        counts = np.bincount(labels, minlength=len(value.coefficients) + 1)
        row = int(np.argmax(counts[1:])) if len(counts) > 1 else 0
        lost.append(len(counts) < 2 or counts[row + 1] < LEAST_SHARE * len(labels))
        if lost[-1]:
            continue
        own = value.coefficients[row]
        offsets.append(1e3 * abs(float(points.mean(axis=0) @ own[:3] + own[3])))
        angles.append(float(np.degrees(np.arccos(np.clip(normal @ own[:3], -1.0, 1.0)))))
    return {"planes mm": rms(offsets), "planes deg": rms(angles), "planes lost %": share(np.array(lost, bool))}


def of_tracks(value: Tracks, now: Seen, before: Seen, T: F64) -> Errors:
    """`wrong pairs %`: share of the pairs of key points whose point, moved, projects 3 px or more from its pixel (1 - precision). `missed pairs %`:
    share of the last frame's key points with one of this frame within 2 px of where they are now, that are in no pair (1 - recall)."""
    points, last, camera = now.get("keypoints"), before.get("keypoints"), now.camera
    if not isinstance(points, Keypoints) or camera is None:
        return {}
    errors = {"wrong pairs %": share(offsets_px(value, points, camera, T) > WRONG_PX)}
    if isinstance(last, Keypoints):
        pixels, visible = in_view(transform(T, last.points_m.astype(np.float64)), now)
        there = visible.copy()
        there[visible] = distances(pixels[visible], points.pixels) <= NEAR_PX
        paired = np.zeros(len(last.pixels), bool)
        paired[value.keypoints[:, 0]] = True
        errors["missed pairs %"] = share(~paired[there])
        errors["one-way pairs %"] = one_way(value.keypoints, last, points)
    return errors


def one_way(pairs: Any, last: Keypoints, points: Keypoints) -> float:
    """Return the share, in percent, of pairs (n, 2) whose point now has its nearest descriptor in the frame before at another point than the paired
    one, of `SAMPLED_PAIRS` spread over them; NaN where the points have no descriptors."""
    import cv2

    old, new = (np.ascontiguousarray(one.descriptors) for one in (last, points))
    sampled = pairs[:: -(-len(pairs) // SAMPLED_PAIRS) or 1]
    if not len(sampled) or not old.shape[1] or old.dtype != new.dtype:
        return np.nan
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if old.dtype == np.uint8 else cv2.NORM_L2)
    found = matcher.match(new[sampled[:, 1]], old)
    return share(np.array([match.trainIdx for match in found]) != sampled[:, 0])


def of_motion(value: Rotation | Translation | Pose, now: Seen, before: Seen, T: F64) -> Errors:
    """By the estimated motion since the last frame: `cycle px`, median distance of the pairs' points, there by the motion and back by the pairs, and
    `depth mm`, median difference of the last frame's depth from that of this one, on pixels that both see; the name of the stage is before both. A
    rotation is judged with the known translation."""
    ends, camera, errors, stage = [estimated_pose(type(value), frame) for frame in (now, before)], now.camera, {}, type(value).__name__.lower()
    if ends[0] is None or ends[1] is None or camera is None:
        return {}
    motion = invert(ends[0]) @ ends[1]
    tracks, points, depth, last_depth = now.get("tracks"), now.get("keypoints"), now.depth_m, before.depth_m
    if isinstance(tracks, Tracks) and isinstance(points, Keypoints):
        errors[f"{stage} cycle px"] = median(offsets_px(tracks, points, camera, motion))
    if depth is not None and last_depth is not None:
        _, moved, pixels, known = warp_grid(last_depth, camera, motion)
        there = between(depth, pixels[known])
        off = np.abs(there - moved[known, 2])
        errors[f"{stage} depth mm"] = median(1e3 * off[off < OCCLUDED * there])  # where it is unknown, off is NaN
    return errors


def estimated_pose(kind: type[Any], seen: Seen) -> F64 | None:
    """Return the pose (4, 4) that a stage of a kind estimates, with what it does not estimate as known; None without an estimate."""
    pose, rotation, translation = (seen.get(topic) for topic in ("pose", "rotation", "translation"))
    if kind is Pose:
        return pose.T_world_camera if isinstance(pose, Pose) and pose.status != LOST else None
    if not isinstance(rotation, Rotation) or (kind is Translation and not (isinstance(translation, Translation) and translation.estimated)):
        return None
    T = seen.T_world_camera.copy()
    T[:3, :3] = rotation.R_world_camera
    if kind is Translation:
        T[:3, 3] = translation.t_world_camera
    return T


def of_matches(value: Matches, now: Seen, before: Seen, T: F64) -> Errors:
    """`wrong matches %`: share of the matched points whose landmark projects 3 px or more from its pixel, at the known pose. `missed matches %`:
    share of the landmarks that were expected in view and have a key point within 2 px, without a match."""
    points, map, camera = now.get("keypoints"), before.get("map"), now.camera
    if not isinstance(points, Keypoints) or not isinstance(map, Map) or camera is None:
        return {}
    places = map.points.column("position_m").astype(np.float64)
    ids = value.keypoints[:, 1]
    if len(ids) and ids.max() >= len(places):
        return {}
    pixels = camera.project(transform(invert(now.T_world_camera), places))
    off = np.linalg.norm(pixels[ids] - points.pixels[value.keypoints[:, 0]], axis=1)
    visible = value.visible_points[value.visible_points < len(places)]
    there = visible[distances(pixels[visible], points.pixels) <= NEAR_PX]
    return {"wrong matches %": share(off[np.isfinite(off)] > WRONG_PX), "missed matches %": share(~np.isin(there, ids))}


MEASURES: dict[type[Any], Measure] = {
    Normals: of_normals,
    Keypoints: of_keypoints,
    LineSegments: of_lines,
    Segments: of_segments,
    Planes: of_planes,
    Tracks: of_tracks,
    Matches: of_matches,
    Rotation: of_motion,
    Translation: of_motion,
    Pose: of_motion,
}


def warp_grid(depth_m: Any, camera: Camera, T: F64) -> tuple[Any, F64, F64, Bool]:
    """Return rows and columns (2, n) of the pixels of a grid, their points (n, 3) moved by T, the pixels (n, 2) where these are, and which have a
    depth and are in the image."""
    v, u = np.mgrid[0 : depth_m.shape[0] : STEP_PX, 0 : depth_m.shape[1] : STEP_PX].reshape(2, -1)
    points = transform(T, camera.back_project(np.stack([u, v], axis=1), depth_m[v, u].astype(np.float64)))
    pixels = camera.project(points)
    return (v, u), points, pixels, (depth_m[v, u] > 0.0) & within(np.nan_to_num(np.rint(pixels), nan=-1.0), camera)


def between(depth_m: Any, pixels: F64) -> F64:
    """Return the depth (n,) at pixels (n, 2) with fractions, where the inverse depth is linear, as on a plane; NaN beside unknown depth."""
    from scipy.ndimage import map_coordinates

    inverse = np.where(depth_m > 0.0, 1.0 / np.maximum(depth_m, 1e-6), np.nan)
    depth: F64 = 1.0 / map_coordinates(inverse, pixels[:, ::-1].T, np.float64, order=1, cval=np.nan)
    return depth


def offsets_px(tracks: Tracks, points: Keypoints, camera: Camera, T: F64) -> F64:
    """Return the distances (n,) of the pairs' points, moved by T, from their pixels in this frame, of those with depth."""
    pixels = camera.project(transform(T, tracks.points_m.astype(np.float64)))
    off: F64 = np.linalg.norm(pixels - points.pixels[tracks.keypoints[:, 1]], axis=1)
    return off[np.isfinite(off)]


def within(pixels: F64, camera: Camera, border: float = 0.0) -> Bool:
    """Return which pixels (n, 2) lie in the image, so far from its border."""
    inside: Bool = (pixels >= border).all(axis=1) & (pixels[:, 0] <= camera.width - 1 - border) & (pixels[:, 1] <= camera.height - 1 - border)
    return inside


def at(image: Any, pixels: F64) -> Any:
    """Return the values of an image at whole pixels (n, 2) as (x, y)."""
    return image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]


def in_view(points: F64, now: Seen) -> tuple[F64, Bool]:
    """Return the pixels (n, 2) of points in the camera frame and which are in view: in the image, and where the depth is known not behind it."""
    camera, depth = now.camera, now.depth_m
    assert camera is not None
    pixels = camera.project(points)
    visible = within(np.nan_to_num(pixels, nan=-1.0), camera, BORDER_PX)
    if depth is not None:
        there = at(depth, np.rint(pixels[visible]))
        visible[visible] = (there <= 0.0) | (points[visible, 2] < (1.0 + OCCLUDED) * there)
    return pixels, visible


def nearest_depth(depth_m: Any) -> Any:
    """Return the depth image with the nearest depth within 2 px: where depth has an edge, the edge in the image is of the nearer surface."""
    import cv2

    size = 2 * round(NEAR_PX) + 1
    return cv2.erode(np.where(depth_m > 0.0, depth_m, np.float32(UNKNOWN_M)), np.ones((size, size), np.uint8))


def distances(pixels: F64, others: Any) -> F64:
    """Return the distance (n,) of each pixel (n, 2) from the nearest of others (m, 2); infinite where there is none."""
    from scipy.spatial import cKDTree

    if not len(others) or not len(pixels):
        return np.full(len(pixels), np.inf)
    found: F64 = cKDTree(np.asarray(others, np.float64)).query(pixels)[0]
    return found


def nearest_segment(ends: F64, lines: F64) -> Any:
    """Return for each segment (n, 2, 2) the row of the nearest of others (m, 2, 2) that holds it within 2 px and 5 deg, by its ends; -1 for none."""
    if not len(lines):
        return np.full(len(ends), -1)
    start, along = lines[:, 0], lines[:, 1] - lines[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-12)
    unit = along / length[:, None]
    offset = ends[:, None] - start[None, :, None]  # (n, m, 2, 2)
    across = np.abs(offset[..., 0] * unit[None, :, None, 1] - offset[..., 1] * unit[None, :, None, 0]).max(axis=2)
    middle = np.sum(offset.mean(axis=2) * unit[None], axis=2)
    own = ends[:, 1] - ends[:, 0]
    cosine = np.abs(own @ unit.T) / np.maximum(np.linalg.norm(own, axis=1), 1e-12)[:, None]
    fits = (across <= NEAR_PX) & (middle >= -NEAR_PX) & (middle <= length[None] + NEAR_PX) & (cosine >= np.cos(np.radians(LINE_DEG)))
    best = np.argmin(np.where(fits, across, np.inf), axis=1)
    return np.where(fits.any(axis=1), best, -1)


def labels_at(points: F64, planes: Planes, camera: Camera) -> Any:
    """Return the label (k,) of the planes at each of the points that are in the image: 0 none, row + 1 of a plane."""
    pixels = np.rint(camera.project(points))
    inside = within(np.nan_to_num(pixels, nan=-1.0), camera)
    return at(planes.labels, pixels[inside] // planes.stride).astype(int)


def share(wrong: Any) -> float:
    """Return the share of True in percent; NaN of nothing."""
    return 100.0 * float(np.mean(wrong)) if len(wrong) else np.nan


def median(values: Any) -> float:
    """Return the median, NaN of nothing."""
    return float(np.median(values)) if np.size(values) else np.nan


def rms(values: Any) -> float:
    """Return the root mean square, NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan
