"""Textures of the synthetic room: drawn once, the same for the same seed, smooth at the scale of a texel so that they do not alias."""

from __future__ import annotations

import cv2
import numpy as np

from trihedron.datasets.materials import PAINTERS, PLAIN, clouds, speckled
from trihedron.datasets.room import Face
from trihedron.datasets.shading import Atlas
from trihedron.pipeline.types import U8

TEXELS_PER_M = {"wall": 300.0, "floor": 250.0, "ceiling": 150.0}
FINE_TEXELS_PER_M = 400.0
LEVELS = 6
BLUR_TEXELS = 0.7
BARE_CONTRAST = 0.4


def bake(faces: list[Face], textured: bool, seed: int) -> Atlas:
    """Textures of all faces, with halved copies down to 1/32."""
    chunks: list[U8] = []
    levels = np.zeros((len(faces), LEVELS, 3), dtype=np.int64)
    per_metre = np.ones(len(faces))
    offset = 0
    for number, face in enumerate(faces):
        if textured:
            per_metre[number] = TEXELS_PER_M.get(face.material, FINE_TEXELS_PER_M)
            image = paint(face.material, face.size_m, float(per_metre[number]), np.random.default_rng([seed, 2, number]))
        else:
            image = np.full((1, 1, 3), _bare(face.material), dtype=np.uint8)
        image = _padded(image)
        for level in range(LEVELS):
            levels[number, level] = offset, image.shape[1], image.shape[0]
            chunks.append(image.reshape(-1))
            offset += image.size
            image = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return Atlas(np.concatenate(chunks), levels, per_metre)


def _bare(material: str) -> tuple[float, float, float]:
    """The colour of a bare room: paler, and near that of the walls, so that corners are weak."""
    r, g, b = (wall + BARE_CONTRAST * (own - wall) for own, wall in zip(PLAIN[material], PLAIN["wall"]))
    return r, g, b


def _padded(image: U8) -> U8:
    """Repeat the border until the sides can be halved exactly down to the last level, which keeps 2 texels."""
    multiple = 2**LEVELS
    bottom, right = -image.shape[0] % multiple, -image.shape[1] % multiple
    return np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)


def paint(material: str, size_m: tuple[float, float], per_metre: float, rng: np.random.Generator) -> U8:
    """(h, w, 3) texture of a face of the given width and height in metres."""
    w, h = (max(4, round(length * per_metre)) for length in size_m)
    image = PAINTERS.get(material, speckled)(h, w, per_metre, rng) + np.zeros(3, dtype=np.float32)
    image = image + 3.0 * clouds(h, w, (0.01 * per_metre,), rng)[:, :, None]
    image = cv2.GaussianBlur(image, (0, 0), BLUR_TEXELS)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
