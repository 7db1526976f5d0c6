"""Time the parts of the feature stages that OpenCV has too, on views of the synthetic room, and their multiple of OpenCV's time.

FAST corners at threshold 7, binary descriptors of their ORB pyramid, line segments at half the size, and the matching of 1000 binary descriptors
(OpenCV's brute force compares all pairs; ours those within 20 px). One thread each. Times of whole stages are those of `trihedron benchmark`, those
of the estimators of the Manhattan frame of `trihedron benchmark manhattan`.

Example: trihedron benchmark parts --calls 50
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import U8
from trihedron.plugins.keypoints.orb import brief_tests, image_pyramid
from trihedron.plugins.keypoints.orb_kernels import fast_corners, oriented_corners, steered_brief
from trihedron.plugins.lines.lsd_kernels import line_support_segments
from trihedron.plugins.shared.feature_matching import match_near
from trihedron.tools.arguments import Parser

CALLS = range(2, 10_001)
MARGIN, SCALE, LEVELS = 19, 1.2, 8
Pair = tuple[Callable[[], object], Callable[[], object]]  # ours, OpenCV's


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises UsageError for a number of calls out of range."""
    parser = Parser("benchmark parts", __name__)
    parser.add_argument("--calls", type=int, default=50, metavar="N", help="calls of each part (default: 50)")
    options = parser.parse(argv)
    if options.calls not in CALLS:
        raise UsageError("benchmark parts", f"--calls {options.calls} is out of range", f"give {CALLS[0]} to {CALLS[-1]}")
    cv2.setNumThreads(1)
    frame = Synthetic()(0)
    assert frame is not None  # of a rendered room none is missing
    rows = [row(name, pair, options.calls) for name, pair in parts(frame.gray).items()]
    print(table([["part", "p50 ms", "p95 ms", "OpenCV p50 ms", "× OpenCV"], *rows], "lrrrr"))
    return 0


def parts(image: U8) -> dict[str, Pair]:
    """Return calls of each part on a grey image (h, w), ours and OpenCV's."""
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    corners, segments = cv2.FastFeatureDetector_create(7, True), cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0)
    pyramid, tests = image_pyramid(image, SCALE, LEVELS, 2 * MARGIN + 1), brief_tests()
    cells, levels, angles = oriented_corners(pyramid, 20, 7, MARGIN, 64, 1000, np.power(SCALE, -2.0 * np.arange(LEVELS, dtype=np.float64)))
    factors = SCALE**levels
    points = [
        cv2.KeyPoint(x * f, y * f, 31 * f, a, 1.0, o) for (x, y), f, a, o in zip(cells.tolist(), factors.tolist(), angles.tolist(), levels.tolist())
    ]
    orb = cv2.ORB_create(1000, SCALE, LEVELS, edgeThreshold=MARGIN)
    rng = np.random.default_rng(4)
    px, descriptors = (rng.random((1000, 2)) * image.shape[::-1]).astype(np.float32), rng.integers(0, 256, (1000, 32), dtype=np.uint8)
    octaves, radius = rng.integers(0, LEVELS, 1000).astype(np.uint8), np.full(1000, 20.0, np.float32)
    described, brute = (px, descriptors, octaves), cv2.BFMatcher(cv2.NORM_HAMMING)
    return {
        "FAST corners": (lambda: fast_corners(image, 7, MARGIN), lambda: corners.detect(image)),
        "binary descriptors": (lambda: steered_brief(pyramid, cells, levels, angles, tests), lambda: orb.compute(image, points)),
        "line segments, half size": (lambda: line_support_segments(half, np.radians(22.5), 2.0, 0.7), lambda: segments.detect(half)),
        "matching": (
            lambda: match_near(*described, *described, radius, 1, 60, 0.9),
            lambda: brute.knnMatch(descriptors, descriptors, k=2),
        ),
    }


def row(name: str, pair: Pair, calls: int) -> list[str]:
    """Return a row of the table: p50 and p95 of our calls, OpenCV's p50 and the multiple; the calls take turns, after one of each."""
    ms = np.empty((2, calls))
    for call in pair:
        call()
    for k in range(calls):
        for which, call in enumerate(pair):
            began = time.perf_counter()
            call()
            ms[which, k] = 1e3 * (time.perf_counter() - began)
    ours, theirs = np.median(ms, axis=1)
    return [name, f"{ours:.2f}", f"{np.percentile(ms[0], 95):.2f}", f"{theirs:.2f}", f"{ours / theirs:.2f}"]
