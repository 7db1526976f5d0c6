"""Notice depth images that are not registered to their colour images."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F32, F64, Frame

JUMP, WIDEST_GAP_PX = 0.08, 12  # a depth edge: relative change across at most so many pixels without a reading (the shadow of a Kinect)
STRIDE = 2  # between the rows, and columns, that are searched for edges
MIN_EDGES, SAMPLED_EDGES = 250, 400  # of a frame that is judged: pixels
FRAMES, EVERY = 5, 10  # judged: so many, every tenth
BLUR_PX = 1.5
SCALES, ROWS_PX, COLUMNS_PX = np.linspace(0.88, 1.12, 13), np.arange(-8, 9, 4), np.arange(-20, 21, 2)  # searched about the principal point
STRONGEST = 97.0  # percentile of the gradients, above which all count alike
MIN_RATIO, REGISTERED = 1.25, 1.8  # of the best to the score as given, and of that: see docs/decisions.md


@dataclass
class RegistrationCheck:
    """Compare where depth jumps with where colour does, as it is and with depth scaled and shifted, over the first frames with enough edges.

    `_scores` (scales, rows, columns) sums the mean colour gradient at the near side of the depth edges, in units of the image's mean gradient."""

    _scores: F64 = field(default_factory=lambda: np.zeros((len(SCALES), len(ROWS_PX), len(COLUMNS_PX))))
    _count: int = 0
    _tenth: int = -1

    def __call__(self, frame: Frame) -> str | None:
        """Add a frame. Returns, once, what is wrong: depth lies elsewhere in the image than colour."""
        if self._count >= FRAMES or frame.index // EVERY == self._tenth:
            return None
        self._tenth = frame.index // EVERY
        edges = depth_edges(frame.depth_m)
        if len(edges) < MIN_EDGES:
            return None
        self._scores += _gradient_scores(frame, edges[:: max(1, len(edges) // SAMPLED_EDGES)])
        self._count += 1
        as_given = float(self._scores[len(SCALES) // 2, len(ROWS_PX) // 2, len(COLUMNS_PX) // 2])
        ratio = float(self._scores.max()) / max(as_given, 1e-9)
        if self._count < FRAMES or as_given > REGISTERED * FRAMES or ratio < MIN_RATIO:
            return None
        scale, row, column = np.unravel_index(int(self._scores.argmax()), self._scores.shape)
        moved = f"scaled by {SCALES[scale]:.2f} and shifted by {COLUMNS_PX[column]}, {ROWS_PX[row]} px"
        return f"{moved}, its edges fit those of colour {ratio:.1f} times better"


def depth_edges(depth_m: F32) -> NDArray[np.int64]:
    """(n, 2) pixels (x, y) on the near side of jumps of depth along every other row and column."""
    along_rows, along_columns = _edges_along_rows(depth_m[::STRIDE]), _edges_along_rows(depth_m[:, ::STRIDE].T)
    return np.concatenate([along_rows * [1, STRIDE], along_columns[:, ::-1] * [STRIDE, 1]])


def _edges_along_rows(depth_m: F32) -> NDArray[np.int64]:
    """(n, 2) column and row of the near sides. All readings are compared with the next one, and only jumps looked at closer."""
    flat, width = depth_m.ravel(), depth_m.shape[1]
    read = np.flatnonzero((flat > 0.0) & (flat < np.inf))
    z = flat[read]
    a, b = z[:-1], z[1:]
    jumps = np.flatnonzero(np.abs(a - b) > JUMP * np.minimum(a, b))
    left, right = read[jumps], read[jumps + 1]
    near = (right - left <= WIDEST_GAP_PX) & (left // width == right // width)
    nearer = np.where(a[jumps] < b[jumps], left, right)[near]
    return np.stack([nearer % width, nearer // width], axis=1)


def color_gradient(frame: Frame, blur_px: float) -> F32:
    """(h, w) magnitude of the gradient of colour, in units of its mean; the strongest are cut."""
    gray = cv2.GaussianBlur(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), blur_px)
    gradient = cv2.magnitude(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    gradient = np.minimum(gradient, np.percentile(gradient[::4, ::4], STRONGEST))
    return np.asarray(gradient / max(float(gradient.mean()), 1e-6), np.float32)


def _gradient_scores(frame: Frame, edges: NDArray[np.int64]) -> F64:
    """The mean gradient at the edges for each scale and shift."""
    gradient = color_gradient(frame, BLUR_PX)
    center, (h, w) = np.array([frame.camera.cx, frame.camera.cy]), gradient.shape
    scores = []
    for scale in SCALES:
        x, y = np.rint((edges - center) * scale + center).astype(np.int64).T
        rows, columns = np.clip(y + ROWS_PX[:, None], 0, h - 1), np.clip(x + COLUMNS_PX[:, None], 0, w - 1)
        scores.append(gradient[rows[:, None], columns].mean(axis=2))
    return np.array(scores)
