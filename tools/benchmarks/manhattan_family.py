"""Compare every estimator of the Manhattan frame on rendered rooms with known axes, and time it on 640×480 views.

A room is rendered at uniformly random orientations and goes through the default feature stages, with exact depth and with a Kinect's. Each estimator
is asked twice: with no previous frame, and with one up to 10° off. An answer is right when it is claimed (`supported`) and within 1° of the true
axes, by whichever of their 24 names; of several frames in view the nearest counts. The median error is that of what was claimed. A view counts for a
case only when it shows, by its exact normals, what the case asks for. The third table is about the covariance: the median NEES of the rotation, 2.37
(the median of χ² with three degrees of freedom) when the covariance is right; estimators expect walls to be off by tenths of a degree, and these are
not. The last table holds views that show no Manhattan frame: every claim is false. mean_shift is also tried with normals alone and with
lines alone. Times are of whole views with noisy depth, and as multiples of the reference workload of `trihedron benchmark` (ORB and LSD) on the same
views.

Example: trihedron benchmark manhattan --orientations 100 --json family.json
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.registry import load_plugins, plugin_class, plugins_of
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, ManhattanFrame
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks import manhattan_views as seen

START_DEG, RIGHT_DEG = 10.0, 1.0
STARTS = ("none", "near")
ORIENTATIONS = range(1, 10_001)
VARIANTS: dict[str, dict[str, bool]] = {  # of mean_shift
    "normals only": {"use_lines": False, "use_planes": False},
    "lines only": {"use_normals": False, "use_planes": False},
}


class Answer(NamedTuple):
    """Result of an estimator on one view."""

    error_deg: float
    square: float  # the error's, in units of the covariance
    claimed: bool
    ms: float


Answers = dict[tuple[str, str, str, str], list[Answer]]  # by estimator, depth, case and start


def main(argv: list[str]) -> int:
    """Print the tables; returns the exit code. Raises UsageError for an unknown estimator or a number out of range."""
    from trihedron.tools.benchmark import machine, reference_ms

    parser = Parser("benchmark manhattan", __name__)
    parser.add_argument("--orientations", type=int, default=100, metavar="N", help="views of each room (default: 100)")
    parser.add_argument("--estimators", default="", metavar="A,B", help="some of them (default: all that are registered)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    options = parser.parse(argv)
    if options.orientations not in ORIENTATIONS:
        raise UsageError("benchmark manhattan", f"--orientations {options.orientations} is out of range", f"give 1 to {ORIENTATIONS[-1]}")
    load_plugins()
    chosen = estimators([name for name in options.estimators.split(",") if name])
    rows = figures(measure(chosen, options.orientations))
    reference = reference_ms(seen.gray_images(min(options.orientations, 40)))
    print(report(rows, reference))
    if options.json:
        values = {"orientations": options.orientations, "reference_ms": reference, "machine": machine(), "rows": rows}
        write_file(options.json, json.dumps(values, indent=2) + "\n")
    return 0


def estimators(names: Sequence[str] = ()) -> dict[str, Any]:
    """Name -> estimator at its defaults, of all that are registered or of `names`; mean_shift in its variants too. Load the plugins first."""
    known = [name for name in plugins_of("manhattan") if name != "none"]
    for name in names:
        if name not in known:
            raise UsageError("benchmark manhattan", f"there is no estimator '{name}'", did_you_mean(name, known))
    found: dict[str, Any] = {}
    for name in names or known:
        found[name] = plugin_class("manhattan", name)()
        if name == "mean_shift":
            found |= {f"{name}, {variant}": plugin_class("manhattan", name)(**options) for variant, options in VARIANTS.items()}
    return found


def measure(
    chosen: dict[str, Any], count: int, cases: Sequence[str] = (*seen.CASES, *seen.WITHOUT_FRAME), done: Callable[[int], object] | None = None
) -> Answers:
    """Measure each estimator on `count` orientations, case by case; `done` is called after each orientation."""
    answers: Answers = defaultdict(list)
    scenes = seen.scenes()
    _warm_up(chosen, scenes[seen.WHOLE])
    for index in range(count):
        for name in (seen.WHOLE, *seen.WITHOUT_FRAME):
            without = name in seen.WITHOUT_FRAME
            wanted = [case for case in cases if (case == name if without else case in seen.CASES)]
            for depth, view in seen.views(scenes[name], index, without) if wanted else ():
                for case in wanted:
                    part = view if without else seen.case_of(view, case)
                    if part is not None:
                        _ask(answers, chosen, depth, case, part)
        if done is not None:
            done(index)
    return answers


def _warm_up(chosen: dict[str, Any], scene: seen.Scene) -> None:
    """Compile what the estimators call, with and without a previous frame."""
    for _, view in seen.views(scene, 0, False):
        _ask(defaultdict(list), chosen, "", "", view)


def _ask(answers: Answers, chosen: dict[str, Any], depth: str, case: str, view: seen.DirectionView) -> None:
    for name, estimator in chosen.items():
        for start in STARTS:
            given: dict[str, Any] = {"normals": view.normals, "segments": view.segments, "planes": view.planes}
            given["previous"] = None if start == "none" else _start(view)
            inputs = seen.inputs_of(estimator, "manhattan", view.normals.index, given)
            began = time.perf_counter()
            found = estimator(**inputs)
            ms = 1e3 * (time.perf_counter() - began)
            answers[name, depth, case, start].append(Answer(*error_of(found, view.truth), found is not None and found.supported, ms))


def _start(view: seen.DirectionView) -> ManhattanFrame:
    """A previous frame up to 10° from the truth, about any axis."""
    rng = np.random.default_rng([11, view.normals.index])
    axis = rng.standard_normal(3)
    R = exp_so3(axis / np.linalg.norm(axis) * np.radians(rng.uniform(0.0, START_DEG))) @ view.truth
    known = np.eye(3)[None] * np.radians(1.0) ** 2
    counts, spread, ids = np.full((1, 3), 20, np.int32), np.full((1, 3), 0.05), np.zeros(1, np.int32)
    return ManhattanFrame(view.normals.index - 1, view.normals.stamp_ns - 33_333_333, R[None], ids, known, counts, spread, True)


def error_of(found: ManhattanFrame | None, truth: F64) -> tuple[float, float]:
    """Angle (deg) to the nearest of the 24 names of the true axes, of the nearest frame in view, and its square in units of that one's covariance;
    180° and NaN for none."""
    rows = np.flatnonzero(found.inliers.any(axis=1)) if found is not None else np.zeros(0, np.intp)
    if found is None or len(rows) == 0:
        return 180.0, float("nan")
    traces = np.einsum("kji,jm,nmi->kn", found.rotations[rows], truth, CUBE)
    k, name = np.unravel_index(int(np.argmax(traces)), traces.shape)
    phi = log_so3(truth @ CUBE[name] @ found.rotations[rows[k]].T)
    square = float(phi @ np.linalg.solve(found.covariance[rows[k]], phi))
    return float(np.degrees(np.linalg.norm(phi))), square


def figures(answers: Answers) -> list[dict[str, Any]]:
    """One row for each estimator, depth, case and start: shares of the views, errors of what was claimed (None without claims), times."""
    rows = []
    for (name, depth, case, start), found in answers.items():
        error, square, claimed, ms = (np.array(column) for column in zip(*found))
        known = error[claimed]
        rows.append(
            {
                "estimator": name,
                "depth": depth,
                "case": case,
                "start": start,
                "views": len(found),
                "claimed": float(claimed.mean()),
                "within_1_deg": float(np.mean(claimed & (error <= RIGHT_DEG))),
                "median_deg": float(np.median(known)) if len(known) else None,
                "p95_deg": float(np.percentile(known, 95)) if len(known) else None,
                "nees": float(np.median(square[claimed])) if len(known) else None,
                "p50_ms": float(np.median(ms)),
                "p95_ms": float(np.percentile(ms, 95)),
            }
        )
    return rows


def report(rows: Sequence[dict[str, Any]], reference_ms: float) -> str:
    """The figures as tables; the rows are the estimators."""
    cells = {(row["estimator"], row["depth"], row["case"], row["start"]): row for row in rows}
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    parts = []
    for depth in seen.DEPTHS:
        cases = [case for case in seen.CASES if any(key[1:3] == (depth, case) for key in cells)]
        if cases:
            heads = [f"{case} ({cells[names[0], depth, case, 'none']['views']})" for case in cases]
            lines = [[name, *(_accuracy([cells[name, depth, case, start] for start in STARTS]) for case in cases)] for name in names]
            title = f"{depth.capitalize()} depth: share within 1° from no start and from up to 10° off, median error in degrees (views)"
            parts.append(title + "\n" + table([["estimator", *heads], *lines], "l" + "r" * len(cases)))
    cases = [case for case in seen.CASES if any(key[1:3] == ("noisy", case) for key in cells)]
    if cases:
        lines = [[name, *(_nees([cells[name, "noisy", case, start] for start in STARTS]) for case in cases)] for name in names]
        title = "Noisy depth: median NEES of the rotation, 2.37 when the covariance is right"
        parts.append(title + "\n" + table([["estimator", *cases], *lines], "l" + "r" * len(cases)))
    keys = [(depth, case) for case in seen.WITHOUT_FRAME for depth in seen.DEPTHS if (names[0], depth, case, "none") in cells]
    heads = [f"{case}, {depth} ({cells[names[0], depth, case, 'none']['views']})" for depth, case in keys]
    lines = []
    for name in names:
        claims = [_claims([cells[name, depth, case, start] for start in STARTS]) for depth, case in keys]
        lines.append([name, *claims, *_times(cells, name, reference_ms)])
    title = f"Share of false claims where no Manhattan frame is in view, and ms a call (one reference workload: {reference_ms:.1f} ms)"
    times = ["p50 none", "p95", "p50 near", "p95", "× reference"]
    parts.append(title + "\n" + table([["estimator", *heads, *times], *lines], "l" + "r" * (len(keys) + len(times))))
    return "\n\n".join(parts)


def _accuracy(pair: Sequence[dict[str, Any]]) -> str:
    medians = [row["median_deg"] for row in pair if row["median_deg"] is not None]
    error = f"{np.mean(medians):.2f}" if medians else "   -"
    return " ".join([*(f"{row['within_1_deg']:.3f}" for row in pair), error])


def _nees(pair: Sequence[dict[str, Any]]) -> str:
    known = [row["nees"] for row in pair if row["nees"] is not None]
    return f"{np.mean(known):.2f}" if known else "-"


def _claims(pair: Sequence[dict[str, Any]]) -> str:
    return " ".join(f"{row['claimed']:.3f}" for row in pair)


def _times(cells: dict[Any, dict[str, Any]], name: str, reference_ms: float) -> list[str]:
    """Times of whole views with noisy depth: p50 and p95 from no start and from near, and the latter's p50 in reference workloads."""
    pair = [cells.get((name, "noisy", seen.WHOLE, start)) for start in STARTS]
    if pair[0] is None or pair[1] is None:
        return ["-"] * 5
    times = [f"{row[key]:.2f}" for row in pair if row is not None for key in ("p50_ms", "p95_ms")]
    return [*times, f"{pair[1]['p50_ms'] / reference_ms:.3f}"]
