"""Surfaces of the synthetic room: a painter for each material, drawing one texture from a seed."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from trihedron.pipeline.core.types import F32

Painter = Callable[[int, int, float, np.random.Generator], F32]  # height, width, texels a metre, rng -> (h, w, 3) RGB 0..255
PLAIN = {  # RGB of a bare room, and the ground colour of a textured one
    "wall": (205, 200, 190), "floor": (165, 145, 120), "ceiling": (225, 225, 222), "wood": (170, 130, 90), "drawers": (176, 136, 96),
    "door": (190, 165, 130), "plastic": (215, 212, 205), "paper": (200, 190, 170), "books": (185, 165, 145), "fabric": (120, 135, 155),
    "screen": (90, 95, 105), "picture": (178, 172, 165), "crate": (185, 150, 105), "marble": (205, 205, 208), "globe": (120, 150, 180),
}  # fmt: skip


def clouds(h: int, w: int, periods: tuple[float, ...], rng: np.random.Generator) -> F32:
    """(h, w) smooth random field, roughly in -1..1, with features of the given sizes (texels), each half as strong as the one before."""
    total = np.zeros((h, w), dtype=np.float32)
    for octave, period in enumerate(periods):
        grid = rng.uniform(-1.0, 1.0, size=(max(2, round(h / period) + 1), max(2, round(w / period) + 1))).astype(np.float32)
        total += 0.5**octave * np.asarray(cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC))
    return total


def _ground(h: int, w: int, color: tuple[int, int, int]) -> F32:
    return np.broadcast_to(np.array(color, dtype=np.float32), (h, w, 3)).copy()


def _tint(rng: np.random.Generator, low: int = 20, high: int = 240) -> tuple[float, float, float]:
    r, g, b = rng.uniform(low, high, size=3)
    return float(r), float(g), float(b)


def _scatter(image: F32, count: int, radius: tuple[float, float], rng: np.random.Generator, contrast: float = 255.0) -> None:
    """Draw random filled polygons (3 to 6 corners) and rings; `contrast` limits how far a tint is from mid grey."""
    h, w = image.shape[:2]
    darkest, brightest = 128 - contrast / 2, 128 + contrast / 2
    smallest, largest = np.log(radius)
    for _ in range(count):
        centre = rng.uniform(0, w), rng.uniform(0, h)
        r = np.exp(rng.uniform(smallest, largest))
        tint = tuple(min(max(c, darkest), brightest) for c in _tint(rng, 0, 255))
        if rng.random() < 0.2:
            cv2.circle(image, (int(centre[0]), int(centre[1])), max(2, int(r)), tint, max(1, int(0.35 * r)), cv2.LINE_AA)
            continue
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, size=int(rng.integers(3, 7))))
        corners = np.empty((len(angles), 2))
        corners[:, 0], corners[:, 1] = centre[0] + r * np.cos(angles), centre[1] + r * np.sin(angles)
        cv2.fillPoly(image, [np.rint(corners * 16).astype(np.int32)], tint, cv2.LINE_AA, 4)


def _writing(image: F32, x0: int, y0: int, x1: int, y1: int, line: int, ink: tuple[float, float, float], rng: np.random.Generator) -> None:
    """Rows of short strokes and blocks, like text seen from afar; `line` is the height of a row in texels."""
    for y in range(y0, y1 - line, max(2, round(1.6 * line))):
        x = x0
        end = x0 + (x1 - x0) * rng.uniform(0.5, 1.0)
        while x < end - line:
            width = int(rng.uniform(0.3, 1.0) * line) + 1
            top = y + int(rng.uniform(0.0, 0.4) * line)
            cv2.rectangle(image, (x, top), (min(x + width, x1), y + line - 1), ink, -1)
            x += width + max(1, int(line * (0.3 if rng.random() < 0.8 else 1.2)))


def _picture(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """A framed print: broad shapes, small ones upon them, a caption."""
    image = _ground(h, w, PLAIN["picture"])
    edge = max(2, int(0.03 * per_metre))
    art = image[edge : h - edge, edge : w - edge]
    art[:] = np.array(_tint(rng, 60, 230), dtype=np.float32)
    art += 20.0 * clouds(art.shape[0], art.shape[1], (0.2 * per_metre, 0.05 * per_metre), rng)[:, :, None]
    canvas = np.ascontiguousarray(art)
    area = art.shape[0] * art.shape[1] / per_metre**2
    _scatter(canvas, int(40 * area) + 4, (0.04 * per_metre, 0.2 * per_metre), rng)
    _scatter(canvas, int(250 * area) + 8, (0.008 * per_metre, 0.04 * per_metre), rng)
    third = canvas.shape[0] // 4
    _writing(canvas, edge, canvas.shape[0] - third, canvas.shape[1] - edge, canvas.shape[0] - edge, max(3, int(0.02 * per_metre)), _tint(rng), rng)
    image[edge : h - edge, edge : w - edge] = canvas
    return image


def _wall(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Wallpaper: pale stains, scattered motifs in low contrast, and a few posters."""
    image = _ground(h, w, PLAIN["wall"]) + 9.0 * clouds(h, w, (0.8 * per_metre, 0.2 * per_metre, 0.05 * per_metre), rng)[:, :, None]
    area = h * w / per_metre**2
    _scatter(image, int(30 * area), (0.008 * per_metre, 0.03 * per_metre), rng, contrast=110.0)
    for _ in range(max(1, round(area / 7.0))):
        height, width = int(rng.uniform(0.4, 0.7) * per_metre), int(rng.uniform(0.3, 0.6) * per_metre)
        if width >= w or height >= 0.5 * h:  # the end of a wall, or a strip of one
            continue
        top, left = int(rng.uniform(0.15, 0.5) * h), int(rng.uniform(0.0, w - width))
        image[top : top + height, left : left + width] = _picture(height, width, per_metre, rng)
    return image


def _wood(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Grain along the longer side with knots."""
    grain = clouds(h, w, (0.25 * per_metre, 0.06 * per_metre), rng)
    along = np.linspace(0.0, 1.0, h if h < w else w, dtype=np.float32)
    lines = along[:, None] if h < w else along[None, :]
    rings = np.sin(2.0 * np.pi * (lines * min(h, w) / (0.03 * per_metre) + 1.5 * grain))
    image = _ground(h, w, PLAIN["wood"]) + (16.0 * rings + 14.0 * grain)[:, :, None] * np.array([1.0, 0.9, 0.7], dtype=np.float32)
    for _ in range(int(6 * h * w / per_metre**2) + 1):
        x, y = int(rng.uniform(0, w)), int(rng.uniform(0, h))
        cv2.ellipse(image, (x, y), (max(2, int(0.014 * per_metre)), max(2, int(0.009 * per_metre))), 0, 0, 360, (80.0, 50.0, 30.0), -1, cv2.LINE_AA)
    return np.asarray(image)


def _floor(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Staggered planks, each of its own tone."""
    image = np.empty((h, w, 3), dtype=np.float32)
    plank = round(0.14 * per_metre)
    for y in range(0, h, plank):
        x = -int(rng.uniform(0.0, 0.9) * per_metre)
        while x < w:
            length = int(rng.uniform(0.5, 1.1) * per_metre)
            tone = np.array(PLAIN["floor"], dtype=np.float32) * rng.uniform(0.7, 1.2)
            cv2.rectangle(image, (x, y), (x + length, y + plank), tuple(map(float, tone)), -1)
            cv2.rectangle(image, (x, y), (x + length, y + plank), (60.0, 48.0, 38.0), 1)
            x += length
    image += 9.0 * clouds(h, w, (0.3 * per_metre, 0.03 * per_metre), rng)[:, :, None]
    _scatter(image, int(12 * h * w / per_metre**2), (0.006 * per_metre, 0.02 * per_metre), rng, contrast=140.0)
    return image


def _ceiling(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Panels with seams and small holes."""
    image = _ground(h, w, PLAIN["ceiling"])
    panel = round(0.6 * per_metre)
    for x in range(panel // 2, w, panel):
        cv2.line(image, (x, 0), (x, h), (170.0, 170.0, 168.0), 2)
    for y in range(panel // 2, h, panel):
        cv2.line(image, (0, y), (w, y), (170.0, 170.0, 168.0), 2)
    _scatter(image, int(25 * h * w / per_metre**2), (0.012 * per_metre, 0.03 * per_metre), rng, contrast=110.0)
    return image


def _drawers(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """A cabinet's front: two rows of drawers with handles and labels."""
    image = _wood(h, w, per_metre, rng)
    for row in range(2):
        for column in range(3):
            x0, x1 = round((column + 0.04) * w / 3), round((column + 0.96) * w / 3)
            y0, y1 = round((row + 0.05) * h / 2), round((row + 0.95) * h / 2)
            cv2.rectangle(image, (x0, y0), (x1, y1), (70.0, 50.0, 35.0), 2)
            middle, quarter = (x0 + x1) // 2, y0 + (y1 - y0) // 4
            half = int(0.06 * per_metre)
            cv2.rectangle(image, (middle - half, quarter), (middle + half, quarter + int(0.015 * per_metre)), (225.0, 222.0, 215.0), -1)
            _writing(image, x0 + half, quarter + half, x1 - half, y1 - half // 2, max(3, int(0.018 * per_metre)), (50.0, 40.0, 35.0), rng)
    return image


def _door(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Two panels, a handle and a notice."""
    image = _wood(h, w, per_metre, rng) * 0.6 + _ground(h, w, PLAIN["door"]) * 0.4
    for low, high in ((0.08, 0.45), (0.52, 0.94)):
        cv2.rectangle(image, (round(0.15 * w), round(low * h)), (round(0.85 * w), round(high * h)), (90.0, 70.0, 50.0), 3)
    cv2.rectangle(image, (round(0.87 * w), round(0.48 * h)), (round(0.97 * w), round(0.5 * h)), (235.0, 235.0, 235.0), -1)
    height, width = int(0.3 * per_metre), int(0.21 * per_metre)
    top, left = round(0.2 * h), (w - width) // 2
    image[top : top + height, left : left + width] = _picture(height, width, per_metre, rng)
    return image


def _books(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Spines of many widths and heights with titles."""
    image = _ground(h, w, (45, 38, 32))
    x = 1
    while x < w - 4:
        width = int(rng.uniform(0.018, 0.05) * per_metre)
        top = int(rng.uniform(0.0, 0.25) * h)
        cv2.rectangle(image, (x, top), (x + width - 1, h), _tint(rng), -1)
        y = top + int(rng.uniform(0.1, 0.25) * (h - top))
        label = y + int(rng.uniform(0.15, 0.5) * (h - top))
        cv2.rectangle(image, (x + width // 5, y), (x + 4 * width // 5, label), _tint(rng), -1)
        x += width + 1
    return image


def _fabric(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Stripes of random widths both ways with embroidered spots."""
    image = _ground(h, w, PLAIN["fabric"])
    for axis, length in ((0, h), (1, w)):
        profile = np.zeros(length, dtype=np.float32)
        edges = np.cumsum(rng.uniform(0.02, 0.1, size=int(length / (0.02 * per_metre)) + 2) * per_metre).astype(int)
        for begin, end, tone in zip(edges[:-1], edges[1:], rng.uniform(-22.0, 22.0, size=len(edges))):
            profile[begin:end] = tone
        image += (profile[:, None] if axis == 0 else profile[None, :])[:, :, None]
    _scatter(image, int(70 * h * w / per_metre**2), (0.008 * per_metre, 0.03 * per_metre), rng, contrast=190.0)
    return image


def _screen(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """A monitor: a dark frame, two windows of writing."""
    image = _ground(h, w, (30, 30, 32))
    edge = max(2, int(0.015 * per_metre))
    for low, high in ((0.0, 0.55), (0.58, 1.0)):
        x0, x1 = edge + round(low * (w - 2 * edge)), edge + round(high * (w - 2 * edge)) - 2
        ground, ink = ((235.0, 235.0, 230.0), (40.0, 40.0, 50.0)) if low == 0.0 else ((40.0, 48.0, 60.0), (150.0, 210.0, 160.0))
        cv2.rectangle(image, (x0, edge), (x1, h - edge), ground, -1)
        _writing(image, x0 + edge, 2 * edge, x1 - edge, h - 2 * edge, max(3, int(0.012 * per_metre)), ink, rng)
    return image


def _crate(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Boards with dark gaps, nails and stencilled writing."""
    image = _wood(h, w, per_metre, rng)
    board = max(4, round(0.12 * per_metre))
    for y in range(0, h, board):
        image[y : y + board] *= rng.uniform(0.8, 1.2)
        cv2.line(image, (0, y), (w, y), (45.0, 35.0, 25.0), 2)
        for x in (int(0.04 * per_metre), w - int(0.04 * per_metre)):
            cv2.circle(image, (x, y + board // 2), max(1, int(0.006 * per_metre)), (40.0, 40.0, 40.0), -1, cv2.LINE_AA)
    _writing(image, w // 4, h // 3, 3 * w // 4, 2 * h // 3, max(4, int(0.035 * per_metre)), (40.0, 35.0, 30.0), rng)
    return image


def _marble(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Veins where a smooth field crosses zero."""
    field = clouds(h, w, (0.3 * per_metre, 0.1 * per_metre, 0.03 * per_metre), rng)
    veins = np.exp(-((field / 0.06) ** 2))
    image = _ground(h, w, PLAIN["marble"]) - 95.0 * veins[:, :, None] + 8.0 * field[:, :, None]
    _scatter(image, int(40 * h * w / per_metre**2), (0.006 * per_metre, 0.015 * per_metre), rng, contrast=150.0)
    return np.asarray(image)


def _globe(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Continents on a sea with meridians."""
    land = clouds(h, w, (0.12 * per_metre, 0.04 * per_metre, 0.015 * per_metre), rng) > 0.15
    image = np.where(land[:, :, None], (185.0, 165.0, 95.0), PLAIN["globe"]).astype(np.float32)
    for x in np.linspace(0, w - 1, 13).astype(int):
        cv2.line(image, (int(x), 0), (int(x), h), (90.0, 100.0, 110.0), 1)
    return image


def paint_speckles(h: int, w: int, per_metre: float, rng: np.random.Generator) -> F32:
    """Plain material with faint marks."""
    image = _ground(h, w, PLAIN["plastic"])
    _scatter(image, int(60 * h * w / per_metre**2), (0.004 * per_metre, 0.012 * per_metre), rng, contrast=120.0)
    return image


PAINTERS: dict[str, Painter] = {
    "wall": _wall, "floor": _floor, "ceiling": _ceiling, "wood": _wood, "drawers": _drawers, "door": _door, "books": _books,
    "fabric": _fabric, "screen": _screen, "picture": _picture, "crate": _crate, "marble": _marble, "globe": _globe,
}  # fmt: skip
