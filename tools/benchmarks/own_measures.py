"""Own measures of the plugins of a sweep: each slot's by `trihedron ablate` in the open loop, and those of surfaces and buildings by the true ones.

The open loop takes the recording of the unchanged graph on each sequence, and computes the alternatives of one slot on what was recorded of the
others. Its results are kept in FOLDER/open_loop, so that the same call again computes only what is missing. All measures are errors: less is better.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trihedron.pipeline.core.config import Feedback
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.slots import FOLDS, SLOTS, output_of, strip_none
from trihedron.pipeline.core.types import ManhattanFrame, Pose
from trihedron.tools.ablate import Options, ablate
from trihedron.tools.ablation_differences import FALSE_AXES, OPEN_LOOP
from trihedron.tools.ablation_tables import FIGURES
from trihedron.tools.benchmarks.building_benchmark import judged_run
from trihedron.tools.evaluate_surface import FIGURES as SURFACE_JSON
from trihedron.tools.evaluate_surface import RECORDING
from trihedron.tools.stage_measures import MEASURES

FOLDER = "open_loop"
MEASURED = [slot for slot in SLOTS if slot not in FOLDS and strip_none(output_of(slot)) in {*MEASURES, ManhattanFrame} - {Pose}]
OPEN = [name for name in FIGURES if name in (*OPEN_LOOP, FALSE_AXES)]
BUILDING = {  # column -> key of the figures, the value where it is perfect, factor
    "walls mm": ("wall_m", 0.0, 1e3),
    "missed rooms %": ("room_recall", 1.0, 100.0),
    "false rooms %": ("room_precision", 1.0, 100.0),
}
DECIMALS = {name: FIGURES[name].decimals for name in OPEN}  # of every column
DECIMALS |= {"surface mm": 2, "missed surface %": 1, "walls mm": 1, "missed rooms %": 0, "false rooms %": 0}
Measures = dict[str, float]  # error by column


def open_loop(run: Path, slot: str, plugins: Sequence[str], out: Path) -> dict[str, Measures]:
    """Return the measures of a slot's plugins on the recorded inputs of a run, by plugin; "" is the recorded one. Raises TrihedronError."""
    options = Options((run / RECORDING,), (f"{slot}={','.join(plugins)}",), out, Feedback.recorded, pictures=False)
    found = {}
    for variant in ablate(options)[0].variants:
        name = "".join(variant.combination.words).partition("=")[2]
        found[name] = {key: variant.figures[key] for key in OPEN if np.isfinite(variant.figures.get(key, np.nan))}
    return found


def of_surface(run: Path) -> Measures:
    """`surface mm`: mean distance of the mesh from the true surface. `missed surface %`: share of the seen true surface farther than 5 cm from it.
    Empty where the run has no figures of `judge_surfaces`."""
    if not (run / SURFACE_JSON).exists():
        return {}
    whole = json.loads((run / SURFACE_JSON).read_text())["parts"]["all"]
    found = {"surface mm": (0.0, 1e3, whole["mean_m"]), "missed surface %": (100.0, -100.0, whole["within_5_cm"])}
    return {name: offset + factor * value for name, (offset, factor, value) in found.items() if value is not None}


def of_building(run: Path) -> Measures:
    """`walls mm`: median offset of walls from the true ones. `missed rooms %`, `false rooms %`: of the true ones, of those that are found.
    Empty where the data set has no true plan."""
    try:
        figures = judged_run(run)
    except DataError:
        return {}
    found = {name: factor * abs(figures[key] - perfect) for name, (key, perfect, factor) in BUILDING.items()}
    return {name: value for name, value in found.items() if np.isfinite(value)}


OF_FOLDS = {"surface": of_surface, "building": of_building}
