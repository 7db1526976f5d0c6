"""Hyper-parameter search by Optuna behind Hydra: `trihedron run -m hydra/sweeper=optuna KEY=interval(a,b) ...`.

What is searched are Hydra's own `interval(a,b)`, `range(a,b,step)`, `choice(a,b,c)`, and `tag(log,interval(a,b))`. Plain values A,B and `sequences`
are not searched but averaged over: a trial is a job for each. The default configuration is tried first, so the best is never worse than that.

Nothing is stored but the jobs' folders. The sampler is seeded, so that the same command asks for the same trials again, and those that are done are
not run again: a search goes on where it was stopped, and comes to the end that it would have come to. A replay computes what is searched and what
follows from it, up to the outputs, and reads the rest from the recording.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.core.config import graph_of
from trihedron.pipeline.core.errors import ConfigError, UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.plugin_configs import PLUGIN_KEY
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import METRICS, flatten_dict
from trihedron.pipeline.sweep.sweep import OUTCOMES, Outcome, Overrides, Sweeper, failure_of

SEARCH_FILE = "search.json"
SHARE = "final.tracked_share"


@dataclass(frozen=True)
class Trial:
    """Values by key, the mean objective over the jobs (None without), the jobs' folders, and why there is no value."""

    values: dict[str, Any]
    objective: float | None
    jobs: list[str]
    reason: str = ""
    tracked_share: float = 1.0  # the least of the jobs


class Search(Sweeper):
    """Hydra's sweeper that asks Optuna's TPE sampler which jobs to run."""

    def __init__(self, trials: int, batch: int, objective: str, direction: str, seed: int, params: Any = None) -> None:
        """Raises UsageError for a number or direction that makes no sense."""
        super().__init__(params)
        if trials < 1 or batch < 1:
            raise UsageError("hydra.sweeper", f"{trials} trials in batches of {batch} are none", "give 1 or more of each")
        if direction not in ("minimize", "maximize"):
            raise UsageError("hydra.sweeper.direction", f"'{direction}' is no direction", "give minimize or maximize")
        self.trials, self.batch, self.objective, self.direction, self.seed = trials, batch, objective, direction, seed

    def sweep(self, arguments: list[str]) -> None:
        """Run the default configuration and the trials, and write search.json. Raises TrihedronError when the default gives no value."""
        optuna = _optuna()
        if self.options.dry_run:
            raise UsageError("--dry-run", "a search chooses its jobs from the results of earlier ones", "leave it out, or give values A,B")
        searched, words = self._split(arguments)
        first = self.compose_config(self.jobs(words)[0])
        space = {key: _distribution(override, _chosen(first, key)) for key, override in searched.items()}
        words += self._what_follows(first, list(space))
        default = self._run_trials([{key: _chosen(first, key) for key in space}], [words], 0)[0]
        if default.objective is None:
            raise ConfigError("hydra.sweeper", f"the default configuration gives no value: {default.reason}", "search from one that does")
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=self.seed, constant_liar=True), direction=self.direction)
        _tell_default(study, space, default)
        tried = [default]
        while len(tried) <= self.trials:
            asked = [study.ask(space) for _ in range(min(self.batch, self.trials + 1 - len(tried)))]
            values = [dict(trial.params) for trial in asked]
            for trial, found in zip(asked, self._run_trials(values, [words + _words(of_trial) for of_trial in values], len(tried))):
                found = _discard_incomparable(found, default)
                study.tell(trial, found.objective, state=None if found.objective is not None else optuna.trial.TrialState.FAIL)
                tried.append(found)
        self._conclude(tried, words)

    def _split(self, arguments: list[str]) -> tuple[dict[str, Override], Overrides]:
        """Split words into search spaces, by key, and all others; a later word replaces an earlier one of its key."""
        parser = OverridesParser.create(config_loader=self.loader)
        words, self.params = [*self.param_overrides, *arguments], {}
        parsed = {override.get_key_element(): (override, word) for word, override in zip(words, parser.parse_overrides(words))}
        searched = {key: override for key, (override, _) in parsed.items() if _is_searched(override)}
        if not searched:
            raise UsageError("hydra/sweeper=optuna", "nothing is searched", "give KEY=interval(a,b), range(a,b,step) or choice(a,b) in quotes")
        return searched, [word for key, (_, word) in parsed.items() if key not in searched]

    def _what_follows(self, config: DictConfig, keys: list[str]) -> Overrides:
        """In a replay, `only` with what is searched and all that depends on it."""
        if not config.replay:
            return []
        graph = graph_of(config)
        stages = [parts[1] if (parts := key.split("."))[0] == "graph" else parts[0] for key in keys]
        again = followers(graph, [*stages, *config.only])
        read = [name for name in graph.stages if name not in again]
        print(f"search: computes {', '.join(again)} again; reads {', '.join(read)} from {config.replay}", file=sys.stderr)
        return [f"only=[{','.join(again)}]"]

    def _run_trials(self, values: list[dict[str, Any]], words: list[Overrides], before: int) -> list[Trial]:
        """The trials of given values and words, after `before` others; their jobs are run unless they are done."""
        jobs = [self.jobs(of_trial) for of_trial in words]
        each = len(jobs[0])
        folders = self.run([job for of_trial in jobs for job in of_trial], each * (self.trials + 1), each * before)
        return [self._trial_from_jobs(of_trial, folders[i * each : (i + 1) * each]) for i, of_trial in enumerate(values)]

    def _trial_from_jobs(self, values: dict[str, Any], folders: list[Path]) -> Trial:
        """The trial whose jobs are in the folders."""
        jobs = [folder.name for folder in folders]
        if why := next((why for folder in folders if (why := failure_of(folder))), ""):
            return Trial(values, None, jobs, why)
        metrics = [_job_metrics(folder / METRICS) for folder in folders if (folder / METRICS).exists()]
        if len(metrics) < len(folders) or any(self.objective not in found for found in metrics):
            known = did_you_mean(self.objective, metrics[0]) if metrics else "no pose was computed"
            return Trial(values, None, jobs, f"no {self.objective} in {METRICS}, {known}")
        share = min(found.get(SHARE, 1.0) for found in metrics)
        return Trial(values, sum(found[self.objective] for found in metrics) / len(metrics), jobs, tracked_share=share)

    def _conclude(self, tried: list[Trial], words: Overrides) -> None:
        """Write search.json, and say what was found."""
        valued = [(trial.objective, trial) for trial in tried if trial.objective is not None]
        best = sorted(valued, key=lambda pair: pair[0], reverse=self.direction == "maximize")[0][1]  # the first of equals
        content = {"objective": self.objective, "direction": self.direction, "seed": self.seed, "overrides": words}
        content |= {"best": asdict(best), "default": asdict(tried[0]), "trials": [asdict(trial) for trial in tried[1:]]}
        write_file(self.folder / SEARCH_FILE, json.dumps(content, indent=2) + "\n")
        failed = sum(trial.objective is None for trial in tried)
        print(f"search: {len(tried) - 1} trials{f', {failed} of them without a value' * bool(failed)}; {self.folder / SEARCH_FILE}")
        print(f"default  {self.objective} {tried[0].objective:.6g}  {' '.join(_words(tried[0].values))}")
        print(f"best     {self.objective} {best.objective:.6g}  {' '.join(_words(best.values))}")
        OUTCOMES.append(Outcome(self.folder, str(self.options.report), len(tried)))


def _discard_incomparable(trial: Trial, default: Trial) -> Trial:
    """A trial that tracks fewer frames than the default has no value: errors are of what was tracked."""
    if trial.objective is None or trial.tracked_share >= default.tracked_share:
        return trial
    reason = f"tracks {trial.tracked_share:.1%} of the frames, the default {default.tracked_share:.1%}"
    return replace(trial, objective=None, reason=reason)


def followers(graph: Graph, stages: list[str]) -> list[str]:
    """The stages given and those that read from them, over any number of wires, delayed ones too; in the graph's order. Raises UsageError for a stage
    that the graph lacks."""
    for name in stages:
        if name not in graph.stages:
            raise UsageError(name, "is searched, and no output depends on it", did_you_mean(name, graph.stages))
    found: set[str] = set()
    while more := {n for n, s in graph.stages.items() if n in stages or found & {w.topic for w in s.inputs.values()}} - found:
        found |= more
    return [name for name in graph.stages if name in found]


def _optuna() -> Any:
    with imports_of("optuna"):
        import optuna
    import warnings

    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _is_searched(override: Override) -> bool:
    """Return True for a search space, False for plain values A,B."""
    value = override.value()
    return override.is_sweep_override() and not (isinstance(value, ChoiceSweep) and value.simple_form)


def _chosen(config: DictConfig, key: str) -> Any:
    """The value of a key in a configuration; of a group, the option's name."""
    value = OmegaConf.select(config, key.lstrip("+"))
    return value.get(PLUGIN_KEY) if isinstance(value, DictConfig) else value


def _distribution(override: Override, default: Any) -> Any:
    """Optuna's distribution of an override: whole numbers where the default is one, else real numbers; texts of a choice."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    space: Any = override.value()
    if override.is_interval_sweep():
        log = "log" in space.tags
        if isinstance(default, int) and not isinstance(default, bool):
            return IntDistribution(int(space.start), int(space.end), log=log)
        return FloatDistribution(float(space.start), float(space.end), log=log)
    if override.is_range_sweep() and not space.shuffle:
        numbers = list(space.range())
        if all(isinstance(number, int) for number in numbers):
            return IntDistribution(numbers[0], numbers[-1], step=int(space.step))
        return FloatDistribution(float(numbers[0]), float(numbers[-1]), step=float(space.step))
    return CategoricalDistribution(list(override.sweep_string_iterator()))


def _tell_default(study: Any, space: dict[str, Any], default: Trial) -> None:
    """Let the sampler know the default configuration, where it lies in the space."""
    from optuna.distributions import CategoricalDistribution
    from optuna.trial import create_trial

    params = {key: str(value) if isinstance(space[key], CategoricalDistribution) else value for key, value in default.values.items()}
    try:
        study.add_trial(create_trial(params=params, distributions=space, value=default.objective))
    except (ValueError, TypeError):  # outside
        return


def _words(values: Mapping[str, Any]) -> Overrides:
    return [f"{key}={value}" for key, value in values.items()]


def _job_metrics(file: Path) -> dict[str, float]:
    """The numbers of a job's metrics, by dotted name."""
    return {name: value for name, value in flatten_dict(read_results(file)).items() if isinstance(value, (int, float))}
