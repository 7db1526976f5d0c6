"""Alternatives of a recorded run: other plugins or options of some stages, computed side by side from the recording, each into a run folder.

What the alternatives have in common is read from the recording, or computed once where it is not recorded. `Feedback.new` computes the changed stages
and all that follows from them, delayed wires included, as a full run would; `Feedback.recorded` each changed stage by itself, on what was recorded.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.app.budgets import budget_of
from trihedron.pipeline.app.calibrated_run import recommended_words
from trihedron.pipeline.app.compilation import compile_once
from trihedron.pipeline.app.execute import (
    Warnings,
    close_writer,
    metadata_of,
    open_writer,
    recorded_topics,
    remembered_of,
    write_files,
    write_models,
)
from trihedron.pipeline.app.recorded_run import recorded_config_of
from trihedron.pipeline.core.config import Feedback, composed_each, graph_of
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.overrides import literal_text
from trihedron.pipeline.core.types import F64
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.memory import malloc_trim
from trihedron.pipeline.run.recorder import Recorder
from trihedron.pipeline.run.replay import TOPICS, Replay
from trihedron.pipeline.run.run_folder import claim_folder, write_configuration
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.side_by_side import SideBySide, changed_stages, swapped_stages, with_one_dataset
from trihedron.pipeline.run.timing import begin_together
from trihedron.pipeline.run.warm_up import WARM_UP_FRAMES, compilation_reported

NOT_REPEATED = ("out", "report", "replay", "only", "feedback", "view", "save_map", "live", "real_time", "calibrate", "threads")  # recorded words
FLUSH_SECONDS = 5.0  # between two writes of a recording: an alternative that is killed is computed again
Frames = Callable[[int, Sequence[Mapping[str, Any]]], None]


@dataclass(frozen=True)
class Alternative:
    """The recorded run with some words on top, composed and checked."""

    words: tuple[str, ...]
    config: DictConfig
    graph: Graph


@dataclass
class Outcome:
    """An alternative that was computed: its files' content; CPU seconds of the stages that are computed for it, as if for it alone; its share of all
    CPU seconds, those of stages that serve several included; and the part of that which is no stage: reading, recording, scheduling, results."""

    metrics: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, Any] = field(default_factory=dict)
    stages_s: float = 0.0
    total_s: float = 0.0
    rest_s: float = 0.0
    frame_ms: F64 = field(default_factory=lambda: np.zeros(0))  # CPU milliseconds of the recomputed stages in each frame, as if computed alone


def alternatives_of(recording: Recording, words: Sequence[Sequence[str]]) -> list[Alternative]:
    """Compose one alternative for each list of words. Raises TrihedronError, one line."""
    recorded = recorded_config_of(recording)
    configs = composed_each(words, recorded)
    graphs = with_one_dataset([graph_of(config) for config in configs])
    return [Alternative(tuple(some), config, graph) for some, config, graph in zip(words, configs, graphs)]


def recomputed_stages(alternatives: Sequence[Alternative], feedback: Feedback) -> frozenset[str]:
    """Return the stages that are computed again in every alternative that has them; empty where all alternatives are the same."""
    graphs = [alternative.graph for alternative in alternatives]
    return swapped_stages(graphs) if feedback is Feedback.recorded else changed_stages(graphs)


class Alternatives:
    """Alternatives that run side by side. `run` does the work; `node_of` then has, for each alternative, the node that computes a stage, shared with
    others or not, and `outcomes` the results afterwards."""

    def __init__(self, recording: Recording, alternatives: Sequence[Alternative], feedback: Feedback, threads: int) -> None:
        self.recording, self.alternatives, self.feedback, self.threads = recording, alternatives, feedback, threads
        self.stages = recomputed_stages(alternatives, feedback)
        self.runners = [self._runner(alternative) for alternative in alternatives]
        self.outcomes = [Outcome() for _ in alternatives]
        self.shared = tuple(sorted({name for runner in self.runners for name in runner.computed} - self.stages))  # computed, not recorded
        self.node_of: list[dict[str, str]] = []
        self.cpu_s = 0.0

    def _runner(self, alternative: Alternative) -> Runner:
        graph, config = alternative.graph, alternative.config
        only = tuple(name for name in graph.stages if name in self.stages)
        replay = Replay(self.recording, only, self.feedback is Feedback.recorded)
        frames, remembered, budget = str(config.dataset.get("frames", "")), remembered_of(config, graph), budget_of(config, graph)
        return Runner(graph, config.seed, self.threads, replay, frames, remembered, budget=budget)

    def run(self, folders: Sequence[Path], on_frame: Frames) -> None:
        """Compute all frames; each alternative's files go to its folder, the values of all to `on_frame(index, values)`. Raises TrihedronError."""
        compile_once(sorted({name for runner in self.runners for name in runner.computed}), max(runner.count for runner in self.runners))
        with Warnings() as warnings, compilation_reported():
            self._warm_up()
            warnings.muted = False
            self._compute(folders, on_frame)
            warnings.summarise()

    def _warm_up(self) -> None:
        """Call every stage on the first frames, with results that are discarded; an error is left to the run itself."""
        trial = SideBySide([self._runner(alternative) for alternative in self.alternatives], self.threads)
        trial.count = min(trial.count, WARM_UP_FRAMES)
        with suppress(TrihedronError):
            for _ in trial.steps():
                pass
        malloc_trim()

    def _compute(self, folders: Sequence[Path], on_frame: Frames) -> None:
        began, truth = time.perf_counter(), attached_truth(self.recording.attachments, str(self.recording.path))
        with ExitStack() as stack:
            claims = zip(folders, self.alternatives, self.runners)
            earlier = [stack.enter_context(claim_folder(folder, one.config, runner.computed)) for folder, one, runner in claims]
            writers = [self._open_recording(alternative, folder) for alternative, folder in zip(self.alternatives, folders)]
            cpu_began = time.process_time()
            together = SideBySide(self.runners, self.threads)
            self.node_of = together.node_of
            try:
                begin_together([runner.timing for runner in self.runners])
                for runner, alternative, writer in zip(self.runners, self.alternatives, writers):
                    topics = recorded_topics(self._as_run(alternative), alternative.graph, runner.replay) & self.stages
                    plan = replace(runner.plan, computed=tuple(name for name in runner.computed if name in self.stages))
                    runner.sinks = (Recorder(writer, plan, topics, False, truth),)
                for index, values in together.steps():
                    on_frame(index, values)
            finally:
                failures = [failure for writer in writers if (failure := close_writer(writer)) is not None]
            if failures:
                raise failures[0]
            for outcome, runner, folder, replaced in zip(self.outcomes, self.runners, folders, earlier):
                outcome.metrics, outcome.timing = write_files(runner, truth, folder, began, began, replaced, plot=False)
                write_models(folder, runner, replaced)
            self.cpu_s = time.process_time() - cpu_began
        self._account(together)

    def _as_run(self, alternative: Alternative) -> DictConfig:
        """The configuration with what makes it a replay, where it is one that no full run gives."""
        config = alternative.config.copy()
        if self.feedback is Feedback.recorded:
            config.replay, config.only, config.feedback = literal_text(str(self.recording.path.resolve())), sorted(self.stages), Feedback.recorded
        return config

    def _words(self, alternative: Alternative) -> list[str]:
        """The words of the `trihedron run` that gives the same values."""
        if self.feedback is Feedback.recorded:
            replay = [f"replay={self.recording.path.resolve()}", f"only=[{','.join(sorted(self.stages))}]", "feedback=recorded"]
            return [*replay, *alternative.words]
        calibrated = recommended_words(alternative.config) if "calibrate=true" in map(str.lower, self.recording.overrides()) else []
        changed = {word.lstrip("+").partition("=")[0] for word in (*calibrated, *alternative.words)}
        given = [word for word in self.recording.overrides() if word.lstrip("+").partition("=")[0] not in {*NOT_REPEATED, *changed}]
        return [*given, *calibrated, *alternative.words]

    def _open_recording(self, alternative: Alternative, folder: Path) -> RecordingWriter:
        config, words = self._as_run(alternative), self._words(alternative)
        config.out = literal_text(str(folder.absolute()))
        write_configuration(folder, config, words)
        metadata = {**metadata_of(config, words), TOPICS: json.dumps(sorted(self.stages & alternative.graph.stages.keys()))}
        return open_writer(folder / RECORDING, metadata, self.recording.attachments, flush_s=FLUSH_SECONDS)

    def _account(self, together: SideBySide) -> None:
        """Divide the CPU time: a node's among the alternatives it serves, the rest (reading, recording, scheduling, results) equally."""
        seconds, users = together.cpu_s, together.users
        stages = {node for nodes in together.node_of for name, node in nodes.items() if name in self.stages or name in self.shared}
        rest = self.cpu_s - sum(seconds[node] for node in stages)
        for outcome, nodes in zip(self.outcomes, together.node_of):
            own = [node for node in nodes.values() if node in stages]
            outcome.stages_s = sum(seconds[node] for node in own)
            outcome.rest_s = rest / len(self.runners)
            outcome.total_s = sum(seconds[node] / users[node] for node in own) + outcome.rest_s
            outcome.frame_ms = together.cpu_ms_of_frames([node for name, node in nodes.items() if name in self.stages])


def same(a: Alternative, b: Alternative) -> bool:
    """Return True if two alternatives compute the same."""
    return not changed_stages([a.graph, b.graph]) and bool(OmegaConf.to_container(a.config.outputs) == OmegaConf.to_container(b.config.outputs))
