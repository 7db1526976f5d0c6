"""Own measures of the plugins of a sweep: each slot's by `trihedron ablate` in the open loop, and those of surfaces and buildings by the true ones.

The open loop takes the recording of the unchanged graph on each sequence, and computes the alternatives of one slot on what was recorded of the
others. Its results are kept in FOLDER/open_loop, so that the same call again computes only what is missing. All measures are errors: less is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trihedron.comparison.ablation import Options, ablate
from trihedron.comparison.ablation_tables import FIGURES
from trihedron.comparison.fold_measures import COLUMNS, Measures, of_building, of_surface
from trihedron.comparison.partings import FALSE_AXES, OPEN_LOOP
from trihedron.comparison.stage_measures import MEASURES
from trihedron.pipeline.core.config import Feedback
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.slots import FOLDS, SLOTS, output_of, strip_none
from trihedron.pipeline.core.types import ManhattanFrame, Pose
from trihedron.pipeline.record.mcap_file import RECORDING

FOLDER = "open_loop"
MEASURED = [slot for slot in SLOTS if slot not in FOLDS and strip_none(output_of(slot)) in {*MEASURES, ManhattanFrame} - {Pose}]
OPEN = [name for name in FIGURES if name in (*OPEN_LOOP, FALSE_AXES)]
DECIMALS = {name: FIGURES[name].decimals for name in (*OPEN, *COLUMNS)}  # of every column


def open_loop(run: Path, slot: str, plugins: Sequence[str], out: Path) -> dict[str, Measures]:
    """Return the measures of a slot's plugins on the recorded inputs of a run, by plugin; "" is the recorded one. Raises TrihedronError."""
    options = Options((run / RECORDING,), (f"{slot}={','.join(plugins)}",), out, Feedback.recorded, pictures=False)
    found = {}
    for variant in ablate(options)[0].variants:
        name = "".join(variant.combination.words).partition("=")[2]
        found[name] = {key: variant.figures[key] for key in OPEN if np.isfinite(variant.figures.get(key, np.nan))}
    return found


def of_plan(run: Path) -> Measures:
    """Return the measures of a run folder's building; empty where the data set has no true plan."""
    try:
        return of_building(run)
    except DataError:
        return {}


OF_FOLDS = {"surface": of_surface, "building": of_plan}
