"""Registration of depth to colour from edges: where depth jumps, colour changes.

The near side of a jump of depth, at pixel p and depth z, was seen by a camera of focal length f_d and centre c_d beside the colour camera (f_c, c_c):

    X = z ((p - c_d) / f_d, 1) + t,  moved by the camera's motion during the delay τ of depth,  u = f_c X / Z + c_c

The parameters are log(f_c / f_d), the shift s in `u = f_c / f_d (p - c_c) + c_c + s + …` (px), the sideways offset t (m) and τ (s). They maximise
the mean gradient of the colour image at u over the edges of all frames, in units of the image's mean gradient. Depths that differ separate t from s;
motion determines τ. Edges of depth are themselves beside those of things: structured light and stereo find the best match of a window of about 9 px,
and on the side of the projector's shadow none (Konolige and Mihelich, Technical description of Kinect calibration, 2010). The covariance is that of
an M-estimator whose terms are blocks of frames ("sandwich": Huber, 1967), since neighbouring frames err alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from trihedron.pipeline.core.types import F32, F64, Bool, Camera, Frame
from trihedron.pipeline.run.registration_check import color_gradient, depth_edges

I64 = NDArray[np.int64]
MIN_EDGES, MAX_EDGES = 60, 200  # of a frame that takes part; more are thinned
BLURS_PX = (4.0, 1.5)  # of the image, at 640 a line: for the search, then for the estimate
EDGE_BIAS_PX = 4.0  # by which edges of depth may be off: half a window of correlation
NAMES = ("log_scale", "shift_x_px", "shift_y_px", "offset_x_m", "offset_y_m", "delay_s")
PRIOR = np.array([0.1, 8.0, 8.0, 0.05, 0.05, 0.03])  # standard deviations, px at 640 a line
PRIOR_WEIGHT = 0.002  # of the prior's squares, in units of the score
STEPS = np.array([0.002, 0.5, 0.5, 0.003, 0.003, 0.003])  # of the search and the derivatives
DIFFERENCE = 0.2  # of a step, for the derivatives of the search
SCALES, ROWS_PX, COLUMNS_PX = np.linspace(0.88, 1.12, 13), np.arange(-8, 9, 4), np.arange(-24, 25, 3)  # where the search begins


@dataclass(frozen=True)
class Edges:
    """Depth edges of all frames: pixels (n, 2), depths (n,) m, frame (n,), block (n,), the camera's motion (n, 6) in its own frame (angular rate in
    rad/s, velocity in m/s), and for each blur the colour gradients (frames, h, w)."""

    camera: Camera
    pixels: F64
    depths_m: F64
    frames: I64
    blocks: I64
    motions: F64
    gradients: tuple[F32, ...]

    def select(self, chosen: Bool) -> Edges:
        """Return a part of the edges."""
        pixels, depths_m, frames = self.pixels[chosen], self.depths_m[chosen], self.frames[chosen]
        return Edges(self.camera, pixels, depths_m, frames, self.blocks[chosen], self.motions[chosen], self.gradients)


@dataclass(frozen=True)
class Registered:
    """Parameters (6,) in the order of NAMES, and their covariance (6, 6), 0 for those that were held."""

    parameters: F64
    covariance: F64


def edges_of(frames: Sequence[Frame], motions: F64, blocks: I64) -> Edges:
    """Collect the edges of frames with their motions (n, 6), 0 where unknown, and blocks (n,)."""
    camera = frames[0].camera
    pixels, depths, rows, images = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, np.int64)], []
    for row, frame in enumerate(frames):
        found = depth_edges(frame.depth_m)
        images.append([color_gradient(frame, max(blur * camera.width / 640.0, 0.8)) for blur in BLURS_PX])
        if len(found) >= MIN_EDGES:
            found = found[np.unique(np.linspace(0, len(found) - 1, MAX_EDGES).astype(int))]
            pixels.append(found.astype(np.float64))
            depths.append(frame.depth_m[found[:, 1], found[:, 0]].astype(np.float64))
            rows.append(np.full(len(found), row))
    of = np.concatenate(rows)
    gradients = tuple(np.array([image[k] for image in images]) for k in range(len(BLURS_PX)))
    return Edges(camera, np.concatenate(pixels), np.concatenate(depths), of, blocks[of], motions[of], gradients)


def project_edges(edges: Edges, parameters: F64) -> F64:
    """(n, 2) pixels of the edges in colour."""
    camera, size = edges.camera, edges.camera.width / 640.0
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    scale, shift, offset, delay_s = np.exp(parameters[0]), parameters[1:3] * size, parameters[3:5], parameters[5]
    z = edges.depths_m[:, None]
    points = np.concatenate([z * (scale * (edges.pixels - center) + shift) / focal + offset, z], axis=1)
    rate, velocity = edges.motions[:, :3], edges.motions[:, 3:]
    points = points + delay_s * (velocity + np.cross(rate, points))
    return np.asarray(focal * points[:, :2] / np.maximum(points[:, 2:], 1e-3) + center, np.float64)


def moved_px(edges: Edges, parameters: F64) -> float:
    """Return the root mean square of the distances (px) by which a registration moves the edges; their delay does not count."""
    at_rest = np.append(parameters[:5], 0.0)
    moved = project_edges(edges, at_rest) - edges.pixels
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def gradients_at(edges: Edges, parameters: F64, blur: int = -1) -> F64:
    """(n,) gradient of colour at the edges, bilinear."""
    image = edges.gradients[blur]
    h, w = image.shape[1:]
    x, y = np.clip(project_edges(edges, parameters), 0.0, [w - 1.001, h - 1.001]).T
    column, row, k = x.astype(np.int64), y.astype(np.int64), edges.frames
    a, b = x - column, y - row
    upper = (1.0 - a) * image[k, row, column] + a * image[k, row, column + 1]
    lower = (1.0 - a) * image[k, row + 1, column] + a * image[k, row + 1, column + 1]
    return np.asarray((1.0 - b) * upper + b * lower, np.float64)


def block_scores(edges: Edges, parameters: F64) -> dict[int, float]:
    """Block -> mean gradient at its edges."""
    values = gradients_at(edges, parameters)
    return {int(block): float(values[edges.blocks == block].mean()) for block in np.unique(edges.blocks)}


def register_depth(edges: Edges, free: Sequence[int]) -> Registered:
    """Estimate the `free` parameters; the others are 0."""
    chosen = list(free)
    if not chosen:
        return Registered(np.zeros(len(NAMES)), np.zeros((len(NAMES), len(NAMES))))
    best = _search(edges, chosen)
    for blur in range(len(BLURS_PX)):

        def loss(steps: F64, blur: int = blur) -> float:
            return -_score(edges, _full(chosen, steps * STEPS[chosen]), blur)

        found = minimize(loss, best[chosen] / STEPS[chosen], method="L-BFGS-B", options={"eps": DIFFERENCE, "ftol": 1e-7, "maxiter": 40})
        best = _full(chosen, found.x * STEPS[chosen])
    return Registered(best, _covariance(edges, best, chosen))


def _full(chosen: list[int], values: F64) -> F64:
    parameters = np.zeros(len(NAMES))
    parameters[chosen] = values
    return parameters


def _score(edges: Edges, parameters: F64, blur: int = -1) -> float:
    return float(gradients_at(edges, parameters, blur).mean()) - PRIOR_WEIGHT * float(((parameters / PRIOR) ** 2).sum())


def _search(edges: Edges, chosen: list[int]) -> F64:
    """The best of a grid of scales and shifts, the latter as offsets where these are free and shifts are not."""
    best, best_score = np.zeros(len(NAMES)), _score(edges, np.zeros(len(NAMES)), 0)
    thin = edges.select(np.arange(len(edges.pixels)) % 8 == 0)
    if 1 not in chosen:
        return best
    for scale in SCALES if 0 in chosen else (1.0,):
        for y in ROWS_PX:
            for x in COLUMNS_PX:
                parameters = _full([0, 1, 2], np.array([np.log(scale), x, y]))
                score = _score(thin, parameters, 0)
                if score > best_score + 0.02:
                    best, best_score = parameters, score
    return best


def _covariance(edges: Edges, best: F64, chosen: list[int]) -> F64:
    """Sandwich covariance over blocks, by central differences."""
    n, blocks = len(chosen), np.unique(edges.blocks)
    steps = [_full(chosen, STEPS[chosen] * np.eye(n)[k]) for k in range(n)]
    rows = edges.blocks[:, None] == blocks
    total = len(edges.pixels)
    gradient = np.array([(gradients_at(edges, best + s) - gradients_at(edges, best - s)) / (2.0 * STEPS[k]) for k, s in zip(chosen, steps)])
    of_block = (gradient @ rows) / total
    of_block -= of_block.mean(axis=1, keepdims=True)
    hessian = np.diag(-2.0 * PRIOR_WEIGHT / PRIOR[chosen] ** 2)
    for i in range(n):
        for j in range(i + 1):
            corners = [gradients_at(edges, best + a * steps[i] + b * steps[j]).mean() for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            second = (corners[0] - corners[1] - corners[2] + corners[3]) / (4.0 * STEPS[chosen[i]] * STEPS[chosen[j]])
            hessian[i, j] += second
            hessian[j, i] = hessian[i, j]
    values, vectors = np.linalg.eigh(-hessian * np.outer(STEPS[chosen], STEPS[chosen]))
    inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-6)) @ vectors.T * np.outer(STEPS[chosen], STEPS[chosen])
    spread = of_block @ of_block.T * len(blocks) / max(len(blocks) - 1, 1)
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(chosen, chosen)] = inverse @ spread @ inverse
    return covariance
