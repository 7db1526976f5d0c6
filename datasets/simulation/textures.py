"""Textures of the synthetic scenes: drawn once, the same for the same seed, smooth at the scale of a texel so that they do not alias."""

from __future__ import annotations

import cv2
import numpy as np

from trihedron.datasets.simulation.materials import PAINTERS, PLAIN, clouds, paint_speckles
from trihedron.datasets.simulation.room import Face
from trihedron.datasets.simulation.shading import Atlas
from trihedron.pipeline.core.types import U8

TEXELS_PER_M = {"wall": 300.0, "floor": 250.0, "ceiling": 150.0}
FINE_TEXELS_PER_M = 400.0
LEVELS = 6
BLUR_TEXELS = 0.7
PIECE_M = 6.0
BARE_CONTRAST = 0.4


def bake(faces: list[Face], textured: bool, seed: int, detail: float = 1.0) -> Atlas:
    """Textures of all faces, with halved copies down to 1/32; faces that look the same share theirs. `detail` multiplies the resolution."""
    chunks: list[U8] = []
    levels = np.zeros((len(faces), LEVELS, 3), dtype=np.int64)
    per_metre = np.ones(len(faces))
    baked: dict[tuple[object, ...], int] = {}
    offset = 0
    for number, face in enumerate(faces):
        if textured:
            per_metre[number] = detail * TEXELS_PER_M.get(face.material, FINE_TEXELS_PER_M)
        key = _key(number, face, textured)
        if key in baked:
            levels[number] = levels[baked[key]]
            continue
        baked[key] = number
        image = _pad_image(_texture(number, face, float(per_metre[number]), seed) if textured else _bare(face.material))
        for level in range(LEVELS):
            levels[number, level] = offset, image.shape[1], image.shape[0]
            chunks.append(image.reshape(-1))
            offset += image.size
            image = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return Atlas(np.concatenate(chunks), levels, per_metre)


def _key(number: int, face: Face, textured: bool) -> tuple[object, ...]:
    """Faces of equal keys have one texture."""
    if not textured:
        return (face.material,)
    return (number,) if face.look < 0 else (face.look, face.material, *np.round(face.size_m, 6))


def _texture(number: int, face: Face, per_metre: float, seed: int) -> U8:
    """A face's texture, painted in pieces of at most PIECE_M so that a long wall takes no more memory than a short one."""
    rng = np.random.default_rng([seed, 2, number] if face.look < 0 else [seed, 4, face.look])
    columns, rows = (max(1, int(np.ceil(length / PIECE_M))) for length in face.size_m)
    size = face.size_m[0] / columns, face.size_m[1] / rows
    if columns == rows == 1:
        return paint(face.material, size, per_metre, rng)
    h, w = (max(4, round(length * per_metre)) for length in face.size_m[::-1])
    image = np.empty((h, w, 3), np.uint8)
    for row in range(rows):
        for column in range(columns):
            (y0, y1), (x0, x1) = (row * h // rows, (row + 1) * h // rows), (column * w // columns, (column + 1) * w // columns)
            piece = paint(face.material, (size[0] + 2.0 / per_metre, size[1] + 2.0 / per_metre), per_metre, rng)
            image[y0:y1, x0:x1] = piece[: y1 - y0, : x1 - x0]
    return image


def _bare(material: str) -> U8:
    """(1, 1, 3) colour of a bare room: paler, and near that of the walls, so that corners are weak."""
    tint = [wall + BARE_CONTRAST * (own - wall) for own, wall in zip(PLAIN[material], PLAIN["wall"])]
    return np.full((1, 1, 3), tint, dtype=np.uint8)


def _pad_image(image: U8) -> U8:
    """Repeat the border until the sides can be halved exactly down to the last level, which keeps 2 texels."""
    multiple = 2**LEVELS
    bottom, right = -image.shape[0] % multiple, -image.shape[1] % multiple
    return np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)


def paint(material: str, size_m: tuple[float, float], per_metre: float, rng: np.random.Generator) -> U8:
    """(h, w, 3) texture of a face of the given width and height in metres."""
    w, h = (max(4, round(length * per_metre)) for length in size_m)
    image = PAINTERS.get(material, paint_speckles)(h, w, per_metre, rng)
    image += 3.0 * clouds(h, w, (0.01 * per_metre,), rng)[:, :, None]
    cv2.GaussianBlur(image, (0, 0), BLUR_TEXELS, dst=image)
    return np.asarray(np.clip(np.rint(image, out=image), 0, 255, out=image).astype(np.uint8))
