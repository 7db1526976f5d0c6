"""The corner of a room with a ball in it, as a surface is shown it."""

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import EXACT_DEPTH, OK, Camera, Frame, Planes, Pose, Rotation
from trihedron.plugins.surface.half_edges import opposite_half_edges

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5, depth_noise=EXACT_DEPTH)
FLOOR, LEFT, BACK = (0.0, -1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.2), (0.0, 0.0, -1.0, 3.0)  # the corner of a room, seen from inside; y down
BALL, RADIUS = np.array([0.5, 0.85, 2.2]), 0.4  # sunk into the floor


def render(T, planes, ball=True, camera=CAMERA):
    """Depth and the number of the plane (1 …, 0 = the ball or nothing) seen by a camera at T."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    depth, label = np.full(u.shape, np.inf), np.zeros(u.shape, np.uint8)
    for k, plane in enumerate(planes, 1):
        slope = rays @ np.array(plane[:3])
        with np.errstate(divide="ignore"):
            z = -(np.array(plane[:3]) @ T[:3, 3] + plane[3]) / slope
        nearer = (slope < 0.0) & (z > 0.05) & (z < depth)
        depth[nearer], label[nearer] = z[nearer], k
    if ball:
        a, b = (rays**2).sum(-1), rays @ (T[:3, 3] - BALL)
        root = b * b - a * (((T[:3, 3] - BALL) ** 2).sum() - RADIUS**2)
        z = np.where(root > 0.0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        depth, label = np.minimum(depth, z), np.where(z < depth, 0, label).astype(np.uint8)
    return np.where(np.isfinite(depth), depth, 0.0), label


def seen(index, T, planes=(FLOOR, LEFT, BACK), ball=True, camera=CAMERA, status=OK, depth=None):
    """What a surface is given of a frame: frame, planes, rotation, pose."""
    z, label = render(T, planes, ball, camera)
    z = z if depth is None else depth
    stamp, n = index * 33_000_000, len(planes)
    own = np.array([(*(T[:3, :3].T @ np.array(p[:3])), p[3] + np.array(p[:3]) @ T[:3, 3]) for p in planes]).reshape(-1, 4)
    regions = Planes(
        index, stamp, own, np.tile(np.eye(3) * 1e-6, (n, 1, 1)), np.zeros((n, 4, 4)), np.full(n, 4000, np.int32),
        np.full((n, 32, 3), np.nan, np.float32), label, 1,
    )  # fmt: skip
    color = np.full((*z.shape, 3), (200, 100, 50), np.uint8)
    frame = Frame(index, stamp, color, z.astype(np.float32), camera)
    one = np.eye(3)[None]
    rotation = Rotation(index, stamp, T[:3, :3], np.eye(3) * 1e-6, one, one, np.zeros(1, np.int32), np.ones(1), "manhattan")
    return frame, regions, rotation, Pose(index, stamp, T, np.eye(6) * 1e-6, T, -1, np.zeros(3, np.int32), 0, status, "")


def walk(count=8):
    """Poses that look into the corner from different places."""
    return [pose_matrix(exp_so3(np.array([-0.35, -0.45 + 0.06 * k, 0.0])), np.array([-0.3 + 0.1 * k, 0.02 * k, 0.03 * k])) for k in range(count)]


def fold(plugin, inputs, map=None):
    state = plugin.start()
    for frame, planes, rotation, pose in inputs:
        state = plugin.add(state, frame, planes, rotation, pose, None)
    return plugin.finish(state, map)


def off_truth(surface):
    """Distances of the vertices from the corner's planes or the ball, whichever is nearest."""
    points = surface.vertices_m.astype(float)
    off = [abs(points @ np.array(p[:3]) + p[3]) for p in (FLOOR, LEFT, BACK)] + [abs(np.linalg.norm(points - BALL, axis=1) - RADIUS)]
    return np.min(off, axis=0)


def faults(surface):
    """What is wrong with a mesh, by name: edges of more than two triangles, edges that two triangles run along the same way, vertices inside an open
    edge (T-junctions), open edges that lie upon each other (cracks), holes of less than 1 cm², planar triangles that face backwards."""
    t, points = surface.triangles, surface.vertices_m.astype(float)
    begin, end = t.ravel(), t[:, [1, 2, 0]].ravel()
    _, times = np.unique(np.sort(np.stack([begin, end], axis=1), axis=1), axis=0, return_counts=True)
    _, same_way = np.unique(np.stack([begin, end], axis=1), axis=0, return_counts=True)
    open_ones = np.flatnonzero(opposite_half_edges(t) < 0)
    a, b = points[begin[open_ones]], points[end[open_ones]]
    rim = np.unique(np.concatenate([begin[open_ones], end[open_ones]]))
    inside = 0
    for p, q, first, second in zip(a, b, begin[open_ones], end[open_ones]):
        share = (points[rim] - p) @ (q - p) / max(((q - p) ** 2).sum(), 1e-12)
        off = np.linalg.norm(points[rim] - p - np.clip(share, 0, 1)[:, None] * (q - p), axis=1)
        inside += ((off < 1e-4) & (share > 1e-3) & (share < 1 - 1e-3) & (rim != first) & (rim != second)).sum()
    places = np.unique(np.rint(points * 1e5).astype(int), axis=0, return_inverse=True)[1].ravel()
    _, upon = np.unique(np.sort(places[np.stack([begin, end])[:, open_ones]], axis=0), axis=1, return_counts=True)
    planar = surface.instances >= 0
    corners = points[t[planar]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    back = (normals * surface.coefficients[surface.instances[planar], :3]).sum(axis=1) < -1e-7
    return {
        "crowded": int((times > 2).sum()), "same way": int((same_way > 1).sum()), "T-junctions": int(inside), "cracks": int((upon > 1).sum()),
        "holes": _pinholes(begin[open_ones], end[open_ones], points), "backwards": int(back.sum()),
    }  # fmt: skip


def _pinholes(begin, end, points):
    """Rings of open edges that fit into a square centimetre."""
    parents = {int(v): int(v) for v in np.concatenate([begin, end])}

    def root(v):
        while parents[v] != v:
            v = parents[v]
        return v

    for u, v in zip(begin, end):
        parents[root(int(u))] = root(int(v))
    rings = {}
    for v in parents:
        rings.setdefault(root(v), []).append(v)
    return sum(bool(np.ptp(points[ring], axis=0).max() < 0.01) for ring in rings.values())
