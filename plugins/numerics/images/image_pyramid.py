"""Image pyramids and where their pixels lie in the full image."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import cv2
import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, U8


class Pyramid(NamedTuple):
    """Levels one after another: all pixels (n,), where each level starts in them (levels + 1,), and its height and width (levels, 2)."""

    pixels: U8
    starts: I32
    shapes: I32

    def images(self) -> list[U8]:
        """Each level (h, w), as a view of the pixels."""
        return [self.pixels[start : start + h * w].reshape(h, w) for (h, w), start in zip(self.shapes.tolist(), self.starts.tolist())]


def image_pyramid(gray: U8, scale: float, levels: int, least_px: int) -> Pyramid:
    """The image (h, w) at 1, 1/scale, 1/scale² …: at most `levels`, none but the first with a side below `least_px`."""
    shapes = [gray.shape]
    for level in range(1, levels):
        shape = (round(gray.shape[0] / scale**level), round(gray.shape[1] / scale**level))
        if min(shape) < least_px:
            break
        shapes.append(shape)
    starts = np.concatenate([[0], np.cumsum([h * w for h, w in shapes])]).astype(np.int32)
    pyramid = Pyramid(np.empty(starts[-1], np.uint8), starts, np.array(shapes, np.int32))
    images = pyramid.images()
    images[0][:] = gray
    for above, image in pairwise(images):
        cv2.resize(above, image.shape[::-1], dst=image, interpolation=cv2.INTER_LINEAR_EXACT)
    return pyramid


@numba.njit(cache=True, nogil=True, error_model="numpy")
def level_of(pyramid: Pyramid, level: int) -> U8:
    """(h, w) one level."""
    h, w = pyramid.shapes[level]
    return pyramid.pixels[pyramid.starts[level] : pyramid.starts[level + 1]].reshape((h, w))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def full_pixels(cells: I32, levels: I32, shapes: I32) -> F64:
    """(n, 2) positions in the full image of pixels (n, 2) of their levels (n,), pixel centres at integers: x is centred at (x + ½) s − ½."""
    out = np.empty((len(cells), 2))
    for i in range(len(cells)):
        h, w = shapes[levels[i]]
        out[i, 0] = (cells[i, 0] + 0.5) * (shapes[0, 1] / w) - 0.5
        out[i, 1] = (cells[i, 1] + 0.5) * (shapes[0, 0] / h) - 0.5
    return out
