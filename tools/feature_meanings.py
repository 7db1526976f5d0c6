"""Promises of the slots of features, as figures of calls on rendered frames: normals, key points, lines, segments, planes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.types import F64, Keypoints, LineSegments, Segments
from trihedron.tools.judged_calls import Call, Figure, definite

NEAR_PX, NEAR_DEG = 2.0, 3.0  # between a feature and the same one in a repeat of the view
OVERLAP = 0.7  # of a region with itself in a repeat of the view
FEW = 10  # rows, below which no figure is taken


# Normals.


def unit_normals(call: Call) -> Iterator[Figure]:
    """Length 1, or NaN in all three coordinates."""
    finite = np.isfinite(call.value.normals)
    yield Figure("share of normals that are NaN in part", float((finite.any(axis=-1) & ~finite.all(axis=-1)).mean()), most=0.0)
    lengths = np.linalg.norm(call.value.normals[finite.all(axis=-1)], axis=-1)
    if len(lengths):
        yield Figure("length of a normal", float(lengths[np.abs(lengths - 1.0).argmax()]), least=1.0 - 1e-3, most=1.0 + 1e-3)


def normals_face_camera(call: Call) -> Iterator[Figure]:
    """Normals point towards the camera."""
    normals, stride = call.value.normals, call.value.stride
    y, x = np.mgrid[: normals.shape[0], : normals.shape[1]] * stride
    rays = call.frame.camera.back_project(np.stack([x, y], axis=-1).astype(np.float64), np.ones(x.shape))
    cosine = (normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    known = cosine[np.isfinite(cosine)]
    yield Figure("share of normals that point away from the camera", float((known > 0.1).mean()) if len(known) else 0.0, most=0.0)


def true_normals(call: Call) -> Iterator[Figure]:
    """Median angle to the truth on planar parts."""
    cells = slice(None, None, call.value.stride)
    labels = call.labels[cells, cells]
    rows, columns = min(labels.shape[0], call.value.normals.shape[0]), min(labels.shape[1], call.value.normals.shape[1])
    labels, normals = labels[:rows, :columns], call.value.normals[:rows, :columns]
    known = np.isfinite(normals).all(axis=-1) & (labels >= 0)
    if known.sum() >= FEW:
        cosine = (normals[known] * call.planes[labels[known], :3]).sum(axis=-1) / np.linalg.norm(normals[known], axis=-1)
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        yield Figure("median angle to the true normals", float(np.median(angle)), "deg", most=10.0)


# Key points.


def _outside(call: Call, pixels: F64, most: float = 0.0) -> Iterator[Figure]:
    camera = call.frame.camera
    if len(pixels):
        beyond = np.maximum(-0.5 - pixels, pixels - [camera.width - 0.5, camera.height - 0.5]).max()
        yield Figure("distance of a point outside of the image", max(float(beyond), 0.0), "px", most=most)


def keypoints_inside(call: Call) -> Iterator[Figure]:
    """Pixels lie in the image."""
    yield from _outside(call, call.value.pixels.astype(np.float64))


def keypoint_sigmas(call: Call) -> Iterator[Figure]:
    """Standard deviations are positive; that of the depth is there exactly where the point is."""
    value: Keypoints = call.value
    placed = np.isfinite(value.points_m).all(axis=1)
    if len(value.pixels):
        yield Figure("least sigma_px", float(value.sigma_px.min()), "px", least=1e-3)
        yield Figure("points with a position but without sigma_m, or the reverse,", float((placed != np.isfinite(value.sigma_m)).sum()), most=0.0)
    if placed.any():
        yield Figure("least sigma_m", float(value.sigma_m[placed].min()), "m", least=1e-6)


def keypoint_positions(call: Call) -> Iterator[Figure]:
    """Points project to their pixels, at the depth of the image."""
    value: Keypoints = call.value
    placed = np.isfinite(value.points_m).all(axis=1)
    if not placed.any():
        return
    points, pixels = value.points_m[placed].astype(np.float64), value.pixels[placed].astype(np.float64)
    yield Figure("distance of a projected point from its pixel", float(np.abs(call.frame.camera.project(points) - pixels).max()), "px", most=0.05)
    low, high = call.depths_around(pixels, reach=2)
    off = np.maximum(low - points[:, 2], points[:, 2] - high) / value.sigma_m[placed]
    yield Figure("depth of a point beyond those of the image around it", float(np.nanmax(off, initial=0.0)), "σ", most=3.0)


def true_keypoints(call: Call) -> Iterator[Figure]:
    """Depths agree with the truth within their standard deviations."""
    value: Keypoints = call.value
    placed = np.isfinite(value.points_m).all(axis=1)
    if placed.sum() >= FEW:
        low, high = call.depths_around(value.pixels[placed], measured=False)
        z = value.points_m[placed, 2].astype(np.float64)
        off = np.maximum(np.maximum(low - z, z - high), 0.0) / value.sigma_m[placed]
        yield Figure("share of points whose depth is off by more than 5 σ", float((off > 5.0).mean()), most=0.1)


def keypoint_repeats(calls: Sequence[Call]) -> Iterator[Figure]:
    """Over noisy repeats of a view: points are found again, by position and descriptor, and scatter as stated."""
    shifts, depths, found, ratios = [], [], [], []
    for a, b in pairwise([call.value for call in calls]):
        if min(len(a.pixels), len(b.pixels)) < FEW:
            continue
        rows, other = _nearest(a.pixels.astype(np.float64), b.pixels.astype(np.float64))
        found.append(len(rows) / len(a.pixels))
        shifts.append((b.pixels[other] - a.pixels[rows]) / np.hypot(a.sigma_px[rows], b.sigma_px[other])[:, None])
        depths.append((b.points_m[other, 2] - a.points_m[rows, 2]) / np.hypot(a.sigma_m[rows], b.sigma_m[other]))
        ratios.append(_descriptor_ratio(a.descriptors, b.descriptors, rows, other, a.metric))
    if found:
        yield Figure("share of points found again in a repeat of the view", float(np.median(found)), least=0.2)
        yield Figure("distance of their descriptors, of that of others,", float(np.median(ratios)), most=0.9)
        yield Figure("scatter of their pixels", _spread(np.concatenate(shifts)), "sigma_px", most=3.0)
        yield Figure("scatter of their depths", _spread(np.concatenate(depths)), "sigma_m", least=0.02, most=3.0)


def _nearest(a: F64, b: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of two lists of points that are mutually nearest and close."""
    apart = np.linalg.norm(a[:, None] - b[None], axis=-1)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.flatnonzero((back[there] == np.arange(len(a))) & (apart.min(axis=1) <= NEAR_PX))
    return rows, there[rows]


def _spread(values: NDArray[np.float32]) -> float:
    """Standard deviation by the median; NaN without values."""
    known = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(known))) if len(known) else float("nan")


def _descriptor_ratio(a: NDArray[np.uint8], b: NDArray[np.uint8], rows: NDArray[np.int64], other: NDArray[np.int64], metric: str) -> float:
    """Median distance of the descriptors of pairs over that of pairs which are none; 1 where the descriptors tell nothing."""
    same, wrong = _descriptor_distances(a[rows], b[other], metric), _descriptor_distances(a[rows], np.roll(b[other], 1, axis=0), metric)
    return float(np.median(same)) / float(np.median(wrong)) if len(rows) and np.median(wrong) > 0.0 else 1.0


def _descriptor_distances(a: NDArray[np.uint8], b: NDArray[np.uint8], metric: str) -> F64:
    if metric == "hamming":
        return np.asarray(np.unpackbits(a ^ b, axis=1).sum(axis=1), np.float64)
    return np.asarray(np.linalg.norm(a.astype(np.float64) - b, axis=1), np.float64)


# Lines, and lines in space.


def lines_inside(call: Call) -> Iterator[Figure]:
    """End points lie in the image or within a pixel of it, apart."""
    ends = call.value.endpoints_px.astype(np.float64)
    yield from _outside(call, ends.reshape(-1, 2), most=1.0)
    if len(ends):
        yield Figure("least length of a line", float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min()), "px", least=1.0)


def line_repeats(calls: Sequence[Call]) -> Iterator[Figure]:
    """Over noisy repeats of a view: lines are found again, by position and descriptor."""
    found, ratios = [], []
    for a, b in pairwise([call.value for call in calls]):
        if min(len(a.endpoints_px), len(b.endpoints_px)) < FEW:
            continue
        rows, other = _same_lines(a, b)
        found.append(len(rows) / len(a.endpoints_px))
        ratios.append(_descriptor_ratio(a.descriptors, b.descriptors, rows, other, "hamming"))
    if found:
        yield Figure("share of lines found again in a repeat of the view", float(np.median(found)), least=0.2)
        yield Figure("distance of their descriptors, of that of others,", float(np.median(ratios)), most=0.9)


def _same_lines(a: LineSegments | Segments, b: LineSegments | Segments) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the lines of two values that are mutually nearest, beside each other and of one direction."""
    middles = [value.endpoints_px.astype(np.float64).mean(axis=1) for value in (a, b)]
    along = [value.endpoints_px[:, 1].astype(np.float64) - value.endpoints_px[:, 0] for value in (a, b)]
    along = [one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-9) for one in along]
    step = middles[1][None] - middles[0][:, None]
    across = np.abs(step[..., 0] * along[0][:, None, 1] - step[..., 1] * along[0][:, None, 0])
    parallel = np.abs(along[0] @ along[1].T) >= np.cos(np.radians(NEAR_DEG))
    apart = np.where(parallel & (across <= NEAR_PX), np.linalg.norm(step, axis=-1), np.inf)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    lengths = np.linalg.norm(a.endpoints_px[:, 1] - a.endpoints_px[:, 0], axis=1)
    rows = np.flatnonzero((back[there] == np.arange(len(there))) & (apart.min(axis=1) <= 0.5 * lengths))
    return rows, there[rows]


def segment_rows(call: Call) -> Iterator[Figure]:
    """One row for each line, with its end points, and with all of a 3D line or nothing."""
    value, lines = call.value, call.topics["lines"]
    yield Figure("rows more than lines", float(len(value.endpoints_px) - len(lines.endpoints_px)), least=0.0, most=0.0)
    if len(value.endpoints_px) == len(lines.endpoints_px) > 0:
        yield Figure("distance of endpoints_px from those of the line", float(np.abs(value.endpoints_px - lines.endpoints_px).max()), "px", most=1e-3)
        finite = np.isfinite(value.endpoints_m).reshape(len(value.endpoints_m), -1)
        yield Figure("3D lines that are NaN in part", float((finite.any(axis=1) & ~finite.all(axis=1)).sum()), most=0.0)


def segment_positions(call: Call) -> Iterator[Figure]:
    """3D end points project to their line, in the image's depth or just before an edge of it."""
    ends, pixels = _lifted(call)
    if not len(ends):
        return
    projected = call.frame.camera.project(ends)
    along = pixels[:, 1] - pixels[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
    off = np.abs(((projected - pixels[:, :1]) * across[:, None]).sum(axis=-1))
    yield Figure("median distance of a projected end point from its line", float(np.median(off)), "px", most=3.0)
    low, high = call.depths_around(np.nan_to_num(projected.reshape(-1, 2)), reach=4)
    z, sigma = ends.reshape(-1, 3)[:, 2], call.frame.camera.depth_noise.sigma_m(ends.reshape(-1, 3)[:, 2])
    beyond = np.maximum(low - z, z - high) / sigma
    yield Figure("share of end points more than 5 σ out of the depths around them", float((beyond > 5.0).mean()), most=0.1)


def segment_covariances(call: Call) -> Iterator[Figure]:
    """Covariances are positive definite, and differ."""
    known = np.isfinite(call.value.endpoints_m).all(axis=(1, 2))
    covariances = call.value.covariance_m2[known]
    yield Figure("covariances with NaN of 3D lines", float((~np.isfinite(covariances)).any(axis=(1, 2, 3)).sum()), most=0.0)
    yield from definite("a covariance", covariances, strict=True)
    yield from differing("covariances", covariances)


def _lifted(call: Call) -> tuple[F64, F64]:
    """3D end points (n, 2, 3) and pixels (n, 2, 2) of the lines that have them."""
    known = np.isfinite(call.value.endpoints_m).all(axis=(1, 2))
    return call.value.endpoints_m[known].astype(np.float64), call.value.endpoints_px[known].astype(np.float64)


def segment_repeats(calls: Sequence[Call]) -> Iterator[Figure]:
    """Over noisy repeats of a view, 3D lines scatter across their direction as their covariances state."""
    squares = []
    for a, b in pairwise([call.value for call in calls]):
        if not min(len(a.endpoints_px), len(b.endpoints_px)):
            continue
        for i, k in zip(*_same_lines(a, b)):
            if np.isfinite(a.endpoints_m[i]).all() and np.isfinite(b.endpoints_m[k]).all():
                squares.append(_squared_distance(a, int(i), b, int(k)))
    if len(squares) >= FEW:
        yield Figure("scatter of 3D lines across", float(np.sqrt(np.median(squares) / 1.39)), "of the stated σ", least=0.1, most=5.0)


def _squared_distance(a: Segments, i: int, b: Segments, k: int) -> float:
    """Squared distance, by the covariances, of the middle of a 3D line from another one, across (two degrees of freedom, median 1.39)."""
    first, second = a.endpoints_m[i].astype(np.float64), b.endpoints_m[k].astype(np.float64)
    basis = tangent_basis((second[1] - second[0]) / np.linalg.norm(second[1] - second[0]))
    share = float(np.clip(np.dot(first.mean(axis=0) - second[0], second[1] - second[0]) / np.sum((second[1] - second[0]) ** 2), 0.0, 1.0))
    off = basis.T @ (first.mean(axis=0) - second[0])
    shares = np.array([1.0 - share, share]) ** 2
    covariance = a.covariance_m2[i].astype(np.float64).sum(axis=0) / 4.0 + np.tensordot(shares, b.covariance_m2[k].astype(np.float64), axes=1)
    return float(off @ np.linalg.solve(basis.T @ covariance @ basis, off))


# Planes.


def differing(name: str, covariances: NDArray[np.floating]) -> Iterator[Figure]:
    """A covariance depends on what was measured: of three rows or more, not all are equal."""
    if len(covariances) >= 3:
        rows = covariances.reshape(len(covariances), -1)
        yield Figure(f"number of different {name}, of {len(rows)},", float(len(np.unique(rows, axis=0))), least=2.0)


def plane_signs(call: Call) -> Iterator[Figure]:
    """d ≥ 0, so that normals point towards the camera."""
    for row, plane in enumerate(call.value.coefficients):
        yield Figure(f"d of plane {row}", float(plane[3]), "m", least=0.0)


def plane_order(call: Call) -> Iterator[Figure]:
    """Largest first, each with its cells in the label image."""
    value = call.value
    if not len(value.coefficients):
        return
    yield Figure("increase of `pixels` from a row to the next", float(np.diff(value.pixels, prepend=value.pixels[0]).max()), "px", most=0.0)
    cells = np.bincount(value.labels.ravel(), minlength=len(value.coefficients) + 1)[1:] * value.stride**2
    for row, (covered, pixels) in enumerate(zip(cells, value.pixels)):
        yield Figure(f"labelled area of plane {row} over `pixels`", covered / max(int(pixels), 1), least=0.5, most=2.0)


def plane_points(call: Call) -> Iterator[Figure]:
    """The depths of a region, and its samples, lie on the plane."""
    value, noise = call.value, call.frame.camera.depth_noise
    points, labels = _cells(call)
    for row, plane in enumerate(value.coefficients):
        samples = value.samples_m[row][np.isfinite(value.samples_m[row]).all(axis=1)].astype(np.float64)
        yield Figure(f"number of samples of plane {row}", float(len(samples)), least=1.0)
        for name, of in (("pixels", points[labels == row + 1]), ("samples", samples)):
            if len(of):
                ray = np.abs(of @ plane[:3]) / of[:, 2]  # metres from the plane for each metre of depth
                off = np.abs(of @ plane[:3] + plane[3]) / (noise.sigma_m(of[:, 2]) * np.maximum(ray, 1e-3))
                yield Figure(f"median distance of the {name} of plane {row} from it", float(np.median(off)), "σ", most=3.0)


def _cells(call: Call) -> tuple[F64, NDArray[np.int64]]:
    """Points (n, 3) of the pixels of the label image's cells that have depth, and their labels (n,)."""
    value, camera = call.value, call.frame.camera
    rows, columns = (min(a, -(-b // value.stride)) for a, b in zip(value.labels.shape, (camera.height, camera.width)))
    y, x = np.mgrid[:rows, :columns] * value.stride
    depth = call.frame.depth_m[y, x].astype(np.float64)
    seen = depth > 0.0
    return camera.back_project(np.stack([x[seen], y[seen]], axis=-1).astype(np.float64), depth[seen]), value.labels[:rows, :columns][seen].astype(int)


def plane_moments(call: Call) -> Iterator[Figure]:
    """`moments` are sums over the region: its weight, centre and extent are those of its cells."""
    value, noise = call.value, call.frame.camera.depth_noise
    points, labels = _cells(call)
    for row, (moments, plane) in enumerate(zip(value.moments, value.coefficients)):
        of = points[labels == row + 1]
        if len(of) < FEW:
            continue
        w = 1.0 / noise.sigma_m(of[:, 2]) ** 2
        ones = np.concatenate([of, np.ones((len(of), 1))], axis=1)
        expected = (ones * w[:, None]).T @ ones
        yield Figure(
            f"weight of the moments of plane {row}, of that of its pixels,", moments[3, 3] / (expected[3, 3] * value.stride**2), least=0.05, most=2.0
        )
        if moments[3, 3] > 0.0:
            centre, extent = moments[:3, 3] / moments[3, 3], np.sqrt(max(np.trace(_scatter(expected)), 1e-12))
            off = float(np.linalg.norm(centre - expected[:3, 3] / expected[3, 3]))
            yield Figure(f"distance of the centre of the moments of plane {row} from that of its pixels, in its extent,", off / extent, most=1.0)
            spread = float(np.sqrt(max(np.trace(_scatter(moments)), 0.0)) / extent)
            yield Figure(f"extent of the moments of plane {row}, of that of its pixels,", spread, least=0.2, most=1.5)
            thickness = float(np.sqrt(max(plane @ moments @ plane / moments[3, 3], 0.0)) / noise.sigma_m(centre[2]))
            yield Figure(f"rms distance of the moments of plane {row} from it", thickness, "σ", most=5.0)


def _scatter(moments: F64) -> F64:
    """Covariance (3, 3) of the points that moments (4, 4) sum up."""
    centre = moments[:3, 3] / moments[3, 3]
    return np.asarray(moments[:3, :3] / moments[3, 3] - np.outer(centre, centre), np.float64)


def plane_covariances(call: Call) -> Iterator[Figure]:
    """Covariances are positive definite, and differ."""
    yield from definite("a covariance", call.value.covariance, strict=True)
    yield from differing("covariances", call.value.covariance)


def true_planes(calls: Sequence[Call]) -> Iterator[Figure]:
    """The plane of a region that lies in one true plane is that one, within its covariance."""
    squares, angles = [], []
    for call in calls:
        stride = call.value.stride
        truth = call.labels[::stride, ::stride]
        labels = call.value.labels[: truth.shape[0], : truth.shape[1]]
        for row, (plane, covariance) in enumerate(zip(call.value.coefficients, call.value.covariance)):
            inside = truth[: labels.shape[0], : labels.shape[1]][labels == row + 1]
            counts = np.bincount(inside[inside >= 0], minlength=1)
            if counts.max() >= 0.95 * len(inside) > 0:
                off = _difference(plane, call.planes[counts.argmax()])
                squares.append(float(off @ np.linalg.solve(covariance, off)) if np.linalg.det(covariance) > 0.0 else np.inf)
                angles.append(float(np.degrees(np.hypot(off[0], off[1]))))
    if len(squares) >= 3:
        yield Figure("median angle to the true plane", float(np.median(angles)), "deg", most=3.0)
        yield Figure("median error of planes", float(np.sqrt(np.median(squares) / 2.37)), "of the stated σ", least=0.1, most=5.0)


def _difference(plane: F64, of: F64) -> F64:
    """Tangent coordinates of another normal about a plane's, and the difference of d."""
    return np.asarray([*(tangent_basis(plane[:3]).T @ of[:3]), of[3] - plane[3]], np.float64)


def plane_repeats(calls: Sequence[Call]) -> Iterator[Figure]:
    """Over noisy repeats of a view, planes are found again and scatter as their covariances state."""
    first, squares, found, wanted = calls[0].value, [], 0, 0
    for row, plane in enumerate(first.coefficients):
        mine = first.labels == row + 1
        offs, stated = [np.zeros(3)], [first.covariance[row]]
        for other in (call.value for call in calls[1:]):
            wanted += 1
            same = _same_region(mine, other.labels)
            if same is not None:
                offs.append(_difference(plane, other.coefficients[same]))
                stated.append(other.covariance[same])
        found += len(offs) - 1
        if len(offs) >= max(len(calls) // 2, 3):
            squares.append(_scatter_square(np.array(offs), np.mean(stated, axis=0)))
    if wanted:
        yield Figure("share of planes found again in a repeat of the view", found / wanted, least=0.3)
    if squares:
        yield Figure("scatter of planes in repeats of a view", float(np.sqrt(np.median(squares))), "of the stated σ", least=0.03, most=5.0)


def _same_region(mine: NDArray[np.bool_], labels: NDArray[np.uint8]) -> int | None:
    """Row of the region of another label image that this one and that cover most of each other."""
    counts = np.bincount(labels[mine], minlength=2)
    counts[0] = 0
    best = int(counts.argmax())
    union = int(mine.sum()) + int((labels == best).sum()) - int(counts[best])
    return best - 1 if best > 0 and counts[best] >= OVERLAP * union else None


def _scatter_square(offs: F64, covariance: F64) -> float:
    """Mean square of the deviations (n, 3) from their mean, by the covariance, a degree of freedom; infinite for a singular one."""
    if np.linalg.det(covariance) <= 0.0:
        return float("inf")
    deviations = offs - offs.mean(axis=0)
    return float(np.einsum("ni,ni->", deviations, np.linalg.solve(covariance, deviations.T).T) / (3.0 * (len(offs) - 1)))
