"""Buildings made again of what a run recorded."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trihedron as th
from trihedron.pipeline.record.reader import Recording
from trihedron.recorded_building import fold_recording


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    words = ["dataset.length=60", "dataset.fps=7.5", "dataset.width=160", "dataset.height=120", "outputs=[trajectory,building]", f"out={out}"]
    th.run(*words, quiet=True)
    return out


def test_the_maps_of_a_recording_are_in_memory_one_at_a_time(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk of ten minutes has hundreds, of 25 MB each."""
    read, alive = Recording.values, list[int]()
    maps: list[weakref.ref[Any]] = []

    def watched(recording: Recording, topic: str, *options: Any) -> Iterator[Any]:
        for value in read(recording, topic, *options):
            if topic == "map":
                maps.append(weakref.ref(value))
                gc.collect()
                alive.append(sum(ref() is not None for ref in maps))
            yield value

    monkeypatch.setattr(Recording, "values", watched)
    fold, state, final = fold_recording(Recording(run / "run.mcap"), "manhattan_layout")
    assert len(maps) > 8 and max(alive) <= 4 and final is not None
    assert len(fold.finish(state, final).walls_m) > 0


def test_the_plan_of_a_recording_is_that_of_the_run(run: Path) -> None:
    recording = Recording(run / "run.mcap")
    (recorded,) = recording.values("building")
    fold, state, final = fold_recording(recording, "manhattan_layout")
    again = fold.finish(state, final)
    assert np.array_equal(again.walls_m, recorded.walls_m) and np.array_equal(again.areas_m2, recorded.areas_m2)
