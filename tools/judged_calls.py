"""Calls of a plugin on rendered frames, beside what is true there, and the figures by which they are judged."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import log_se3
from trihedron.pipeline.core.types import F64, I32, Frame, Map, Trajectory

INDEFINITE = 1e-9  # of the largest eigenvalue of a covariance: one that is as much below zero is rounding


@dataclass(frozen=True)
class Figure:
    """A measured number and its limits, of a frame or of several together."""

    what: str
    value: float
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf
    frame: int | None = None

    @property
    def good(self) -> bool:
        """False outside of the limits, and for NaN."""
        return self.least <= self.value <= self.most

    @property
    def limits(self) -> str:
        """The limits in words."""
        if self.least == self.most:
            return f"{self.least:g}"
        if math.isinf(self.most):
            return f"at least {self.least:g}"
        return f"at most {self.most:g}" if math.isinf(self.least) else f"{self.least:g} to {self.most:g}"

    def __str__(self) -> str:
        of_frame = "" if self.frame is None else f", frame {self.frame}"
        return f"{self.what} is {' '.join(f'{self.value:.3g} {self.unit}'.split())}, must be {self.limits}{of_frame}"


@dataclass(frozen=True)
class Call:
    """One call of a plugin: its value (not None), the topics of the scene at this frame and at the previous one, the map before it, and the truth."""

    value: Any
    frame: Frame
    topics: Mapping[str, Any]
    previous: Mapping[str, Any]
    map: Map | None
    data: Synthetic
    position: int  # in the scene

    @cached_property
    def _view(self) -> tuple[F64, I32, F64]:
        return self.data.true_planes(self.position)

    @property
    def depth_m(self) -> F64:
        """(h, w) exact depth."""
        return self._view[0]

    @property
    def labels(self) -> I32:
        """(h, w) row of `planes` that a pixel shows, -1 where it is curved."""
        return self._view[1]

    @property
    def planes(self) -> F64:
        """(k, 4) exact planes, camera frame, `d >= 0`."""
        return self._view[2]

    @property
    def T_room_camera(self) -> F64:
        """(4, 4) exact pose in the room, whose axes are those of its Manhattan frame."""
        return self.data.true_pose(self.position)

    @property
    def T_world_camera(self) -> F64:
        """(4, 4) exact pose in the world, which is the first camera."""
        return self.true_pose(self.position)

    def true_pose(self, position: int) -> F64:
        """(4, 4) exact pose of any frame of the scene, in the world."""
        return np.asarray(invert(self.data.true_pose(0)) @ self.data.true_pose(position), np.float64)

    def depths_around(self, pixels: NDArray[Any], reach: int = 1, measured: bool = True) -> tuple[F64, F64]:
        """Least and greatest depth, measured or exact, within `reach` pixels of (n, 2) pixels; NaN where there is none."""
        image = np.where(self.frame.depth_m > 0.0, self.frame.depth_m, np.nan) if measured else self.depth_m
        height, width = image.shape
        steps = np.arange(-reach, reach + 1)
        around = np.stack([step.ravel() for step in np.meshgrid(steps, steps)], axis=-1)
        places = np.clip(np.rint(pixels).astype(int)[:, None] + around, 0, [width - 1, height - 1])
        depths = image[places[..., 1], places[..., 0]].astype(np.float64)
        missing = np.isnan(depths)
        low, high = np.where(missing, np.inf, depths).min(axis=1), np.where(missing, -np.inf, depths).max(axis=1)
        return np.where(missing.all(axis=1), np.nan, low), np.where(missing.all(axis=1), np.nan, high)


Check = Callable[[Sequence[Call]], Iterator[Figure]]


def each(check: Callable[[Call], Iterator[Figure]]) -> Check:
    """Make a check of a sequence out of one of a single call."""

    def check_each(calls: Sequence[Call]) -> Iterator[Figure]:
        for call in calls:
            yield from (replace(figure, frame=call.frame.index) for figure in check(call))

    return check_each


def worst(figures: Sequence[Figure]) -> Figure | None:
    """The first figure outside of its limits, else the one that is nearest to its limit in proportion, None without figures."""
    outside = next((figure for figure in figures if not figure.good), None)
    return outside or max(figures, key=_used_share, default=None)


def _used_share(figure: Figure) -> float:
    """A good figure as a share of its upper limit, or its lower limit as a share of it; 0 where either is 0 or infinite."""
    upper = figure.value / figure.most if 0.0 < figure.most < math.inf else 0.0
    return max(upper, figure.least / figure.value) if figure.value > 0.0 and figure.least > 0.0 else upper


# Figures that several slots have in common.


def definite(name: str, covariances: F64, strict: bool = False) -> Iterator[Figure]:
    """Figures of covariances (..., d, d): symmetric and positive semidefinite, or definite. Those with NaN are not judged."""
    known = covariances.reshape(-1, *covariances.shape[-2:]).astype(np.float64)
    known = known[np.isfinite(known).all(axis=(1, 2))]
    if not len(known):
        return
    largest = np.maximum(np.abs(known).max(axis=(1, 2)), 1e-300)
    yield Figure(f"asymmetry of {name}", float((np.abs(known - known.swapaxes(1, 2)).max(axis=(1, 2)) / largest).max()), most=1e-4)
    scale = np.sqrt(np.maximum(np.abs(np.einsum("nii->ni", known)), 1e-300))
    values = np.linalg.eigvalsh(known / scale[:, :, None] / scale[:, None, :])  # of the correlations: metres and radians differ
    yield Figure(f"smallest eigenvalue of {name}, by its diagonal,", float(values.min()), least=INDEFINITE if strict else -1e-6)


def pose_errors(estimate: F64, truth: F64) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    xi = log_se3(np.asarray(invert(estimate) @ truth, np.float64))
    return float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3])), float(np.degrees(np.linalg.norm(xi[3:])))


def most_often(rows: NDArray[Any]) -> float:
    """Return the number of times that the most frequent id occurs."""
    return float(np.bincount(rows).max()) if len(rows) else 0.0


def figures_of_frames(frames: Sequence[Frame], truth: Trajectory | None) -> dict[str, list[Figure]]:
    """Figures of frames of a data set, in order, by name: stamps, sizes, depth; and those of the ground truth."""
    found: dict[str, list[Figure]] = {"stamps": [], "size": [], "depth": []}
    for before, frame in pairwise(frames):
        step = 1e-9 * (frame.stamp_ns - before.stamp_ns)
        found["stamps"].append(Figure("time since the frame before", step, "s", least=1e-9, frame=frame.index))
    for frame in frames:
        for name in ("height", "width"):
            size, first = float(getattr(frame.camera, name)), float(getattr(frames[0].camera, name))
            found["size"].append(Figure(f"{name} of the image", size, "px", least=first, most=first, frame=frame.index))
        wrong = float((~(np.isfinite(frame.depth_m) & (frame.depth_m >= 0.0))).sum())
        found["depth"].append(Figure("number of depths that are not finite, or negative,", wrong, most=0.0, frame=frame.index))
        found["depth"].append(Figure("greatest depth", float(np.nanmax(frame.depth_m, initial=0.0)), "m", least=1e-3, frame=frame.index))
    if truth is not None and len(truth) > 1:
        found["truth"] = [Figure("least step of the stamps of the ground truth", 1e-9 * int(np.diff(truth.stamps_ns).min()), "s", least=1e-9)]
    return found
