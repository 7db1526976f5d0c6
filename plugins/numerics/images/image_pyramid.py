"""Image pyramids and where their pixels lie in the full image."""

from __future__ import annotations

import cv2
import numpy as np

from trihedron.pipeline.types import F64, I32, U8


def image_pyramid(gray: U8, scale: float, levels: int, least_px: int) -> list[U8]:
    """The image (h, w) at 1, 1/scale, 1/scale² …: at most `levels`, none but the first with a side below `least_px`."""
    images = [gray]
    for level in range(1, levels):
        size = (round(gray.shape[1] / scale**level), round(gray.shape[0] / scale**level))
        if min(size) < least_px:
            break
        images.append(np.asarray(cv2.resize(images[-1], size, interpolation=cv2.INTER_LINEAR_EXACT)))
    return images


def full_pixels(cells: I32, levels: I32, pyramid: list[U8]) -> F64:
    """(n, 2) positions in the full image of pixels (n, 2) of their levels (n,), pixel centres at integers: x is centred at (x + ½) s − ½."""
    h, w = pyramid[0].shape
    ratios = np.array([[w / image.shape[1], h / image.shape[0]] for image in pyramid])
    return np.asarray((cells + 0.5) * ratios[levels] - 0.5)
