"""Small pictures of values, for notebooks, and the marks that pictures of frames have: tinted planes, lines, key points and axes.

A package of plugins registers the picture of a type of its own with `picture_of.register`.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any

import cv2
import numpy as np

from trihedron.pipeline.core.geometry import upright
from trihedron.pipeline.core.types import F32, F64, I32, U8, Frame, Keypoints, LineSegments, ManhattanFrame, Planes, Segments, Surface

WIDTH_PX = 320  # of a picture
MOST_BYTES = 50_000  # of its PNG
SHRINK = 0.85  # of the width, until it fits
PAPER = 255
AXIS_COLORS = ((220, 50, 50), (50, 170, 50), (60, 90, 230))
AXIS_LENGTH_PX = 60
IN_SPACE, ON_IMAGE, POINT = (255, 230, 0), (150, 150, 150), (0, 230, 120)
MARGIN_PX = 8  # round a plan or a mesh
MOST_TRIANGLES = 50_000  # drawn of a mesh: the largest
VIEW = np.array([[-0.8, 0.6, 0.0], [0.36, 0.48, -0.8], [0.48, 0.64, 0.6]])  # of a mesh with z up: rows are right, down and towards the viewer


@singledispatch
def picture_of(value: object) -> U8 | None:
    """Return a picture (h, w, 3) RGB of a value, None where its type has none."""
    return None


def html_of(value: object) -> str | None:
    """Return the picture of a value as HTML with its line below; None where there is no picture."""
    picture = picture_of(value)
    if picture is None or picture.size == 0:
        return None
    line = html.escape(repr(value))
    data = base64.b64encode(small_png(picture)).decode()
    return f'<figure><img src="data:image/png;base64,{data}" alt="{line}"><figcaption>{line}</figcaption></figure>'


def small_png(picture: U8) -> bytes:
    """Encode a picture (h, w, 3) RGB as PNG of at most MOST_BYTES, as small as that needs."""
    scale = min(1.0, WIDTH_PX / picture.shape[1])
    while True:
        size = max(round(picture.shape[1] * scale), 1), max(round(picture.shape[0] * scale), 1)
        shrunk = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else picture
        encoded = bytes(cv2.imencode(".png", cv2.cvtColor(shrunk, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])
        if len(encoded) <= MOST_BYTES:
            return encoded
        scale *= SHRINK


def tint_planes(image: U8, planes: Planes) -> U8:
    """Return an image (h, w, 3) with each plane in a colour of its own."""
    from matplotlib import colormaps

    height, width = image.shape[:2]
    labels = cv2.resize(planes.labels, (width, height), interpolation=cv2.INTER_NEAREST)
    palette = np.vstack([[0, 0, 0], 255 * np.array([colormaps["tab20"](i % 20)[:3] for i in range(255)])])
    mixed = np.where(labels[..., None] > 0, 0.55 * image + 0.45 * palette[labels], image)
    return np.ascontiguousarray(mixed.astype(np.uint8))


def draw_lines(image: U8, endpoints_px: F32, in_space: Any) -> None:
    """Draw lines (n, 2, 2) into an image: yellow where `in_space` (n,), else grey."""
    for ends, lifted in zip(np.rint(endpoints_px).astype(int), in_space):
        cv2.line(image, tuple(map(int, ends[0])), tuple(map(int, ends[1])), IN_SPACE if lifted else ON_IMAGE, 2, cv2.LINE_AA)


def draw_keypoints(image: U8, pixels: F32) -> None:
    """Draw key points (n, 2) into an image."""
    for x, y in np.rint(pixels).astype(int):
        cv2.circle(image, (int(x), int(y)), 2, POINT, 1, cv2.LINE_AA)


def draw_axes(image: U8, R_camera_manhattan: F64) -> None:
    """Draw the three axes as arrows into the lower left corner of an image."""
    origin = (AXIS_LENGTH_PX + 15, image.shape[0] - AXIS_LENGTH_PX - 15)
    for axis, color in enumerate(AXIS_COLORS):
        x, y = R_camera_manhattan[:2, axis] * AXIS_LENGTH_PX
        cv2.arrowedLine(image, origin, (round(origin[0] + x), round(origin[1] + y)), color, 3, cv2.LINE_AA, tipLength=0.2)


@picture_of.register
def _(value: Frame) -> U8 | None:
    """Colour, and depth beside it: the nearer, the brighter; black = none."""
    known = value.depth_m > 0.0
    nearness = np.zeros(value.depth_m.shape, np.uint8)
    if known.any():
        near, far = np.percentile(value.depth_m[known], (1, 99))
        nearness[known] = np.clip(255 - 215 * (value.depth_m[known] - near) / max(far - near, 1e-6), 40, 255).astype(np.uint8)
    return np.concatenate([value.color, np.repeat(nearness[..., None], 3, axis=2)], axis=1)


@picture_of.register
def _(value: Planes) -> U8 | None:
    h, w = value.labels.shape
    return tint_planes(np.full((h, w, 3), PAPER, np.uint8), value)


@picture_of.register
def _(value: Keypoints) -> U8 | None:
    image = _paper_round(value.pixels)
    draw_keypoints(image, value.pixels)
    return image


@picture_of.register
def _(value: LineSegments) -> U8 | None:
    image = _paper_round(value.endpoints_px)
    draw_lines(image, value.endpoints_px, np.zeros(len(value.endpoints_px), bool))
    return image


@picture_of.register
def _(value: Segments) -> U8 | None:
    image = _paper_round(value.endpoints_px)
    draw_lines(image, value.endpoints_px, np.isfinite(value.endpoints_m).all(axis=(1, 2)))
    return image


@picture_of.register
def _(value: ManhattanFrame) -> U8 | None:
    if not value.supported or not len(value.rotations):
        return None
    image = np.full((2 * AXIS_LENGTH_PX + 30, 2 * AXIS_LENGTH_PX + 30, 3), PAPER, np.uint8)
    draw_axes(image, value.rotations[0])
    return image


def _paper_round(pixels: F32) -> U8:
    """Return a dark image as large as these pixels (..., 2) reach; features do not know the size of theirs."""
    width, height = np.ceil(pixels.reshape(-1, 2).max(axis=0, initial=0.0)).astype(int) + MARGIN_PX
    return np.full((max(int(height), 1), max(int(width), 1), 3), 40, np.uint8)


@picture_of.register
def _(value: Surface) -> U8 | None:
    """The mesh from above and the side, the far triangles first, without those that turn their back, as a ceiling does."""
    if not len(value.triangles):
        return None
    vertices = value.vertices_m.astype(np.float64)
    seen = np.einsum("vk,jk->vj", vertices, np.einsum("ij,jk->ik", VIEW, upright(value.up)))
    corners = seen[value.triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    facing = b[:, 0] * a[:, 1] - a[:, 0] * b[:, 1]  # twice the area in the picture, whose y points down
    front = np.argsort(-facing, kind="stable")[: min(MOST_TRIANGLES, int((facing > 0).sum()))]
    front = front[np.argsort(corners[front, :, 2].mean(axis=1), kind="stable")]
    image, place = canvas_round([seen[:, :2]])
    colors = value.colors[value.triangles[front]].mean(axis=1)
    for corner, color in zip(place(corners[front, :, :2]), colors.tolist()):
        cv2.fillConvexPoly(image, corner, color)
    return image


def canvas_round(shapes: Sequence[F64]) -> tuple[U8, Callable[[F64], I32]]:
    """Return white paper, at most WIDTH_PX wide or high, on which shapes of points (n, 2) fit, y down, and the function from points to pixels."""
    points = np.concatenate(shapes)
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (WIDTH_PX - 2 * MARGIN_PX) / max(float((high - low).max()), 1e-6)
    width, height = np.ceil((high - low) * scale).astype(int) + 2 * MARGIN_PX
    image = np.full((int(height), int(width), 3), PAPER, np.uint8)
    return image, lambda positions: np.rint((positions - low) * scale + MARGIN_PX).astype(np.int32)
