"""Sweeps: every job of a cross product over given data sets, on all cores; what is done already is not done again.

A job's folder keeps its number as long as its overrides are the same; it is computed again when its key (`jobs.key_of`) changed, or it did not come
to its end. A job that fails, be it because its configuration is refused, leaves its reason in job.json and stops no other.
"""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper as HydraSweeper
from hydra.types import HydraContext, TaskFunction
from joblib.externals.loky import get_reusable_executor
from omegaconf import DictConfig

from trihedron.pipeline.core.config import graph_of, rewrite_error
from trihedron.pipeline.core.errors import DataError, TrihedronError, UsageError, did_you_mean
from trihedron.pipeline.core.files import make_folder, write_file
from trihedron.pipeline.core.libraries import library_error
from trihedron.pipeline.core.overrides import with_literal_paths
from trihedron.pipeline.core.registry import load_plugins, options_of, plugins_of
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.run.result_files import read_words
from trihedron.pipeline.sweep.cluster import all_awaited
from trihedron.pipeline.sweep.jobs import DONE, FAILED, RUNNING, key_of, read_job, write_job
from trihedron.pipeline.sweep.preview import Planned, common_words, preview, refused_job, state_of
from trihedron.pipeline.sweep.progress import Progress, reason

Overrides = list[str]
GRAPH_KEYS = frozenset({*SLOTS, "graph", "without"} - {"dataset"})  # of words that choose or change a graph
CHOICE = "alternatives="  # a word of a sequence: the alternatives that are tried on it
OF_SWEEPS = ("sequences=", "alternatives=", "dry_run=")  # words that no job has


@dataclass
class Outcome:
    """A sweep that ended: its folder, the command that reports on it, how many jobs it has, and why some of them failed."""

    folder: Path
    report: str
    jobs: int = 0
    failures: list[str] = field(default_factory=list)

    def raise_failures(self) -> None:
        """Raise TrihedronError when a job failed."""
        if self.failures:
            cause = f"{len(self.failures)} of {self.jobs} jobs failed"
            raise TrihedronError(str(self.folder), cause, "trihedron compare names the cause; the same command again runs those that are missing")


OUTCOMES: list[Outcome] = []  # of the sweeps of this process; Hydra has no other way to hand one over


class Sweeper(HydraSweeper):
    """Hydra's sweeper over comma-separated values, with sequences, that goes on where it was stopped."""

    def __init__(self, params: Mapping[str, Any] | None = None) -> None:
        """`params` are overrides of every sweep, key -> value or values, from the configuration."""
        self.params = dict(params or {})
        self.launcher: Launcher | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra prepared, before `sweep`."""
        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(hydra_context=hydra_context, task_function=task_function, config=config)

    def sweep(self, arguments: list[str]) -> None:
        """Run what is missing. Raises TrihedronError when no job can be composed."""
        jobs = self.jobs(arguments)
        if self.options.dry_run:
            print(preview([self._plan_job(job, self.folder / str(number)) for job, number in zip(jobs, _numbers(self.folder, jobs))]))
            return
        folders = self.run(jobs, len(jobs))
        failures = [why for folder in folders if (why := failure_of(folder))]
        OUTCOMES.append(Outcome(self.folder, str(self.options.report), len(jobs), failures))

    @property
    def options(self) -> DictConfig:
        """The configuration that all jobs begin with; Hydra sets it before it calls `sweep`."""
        assert self.config is not None
        return self.config

    @property
    def loader(self) -> ConfigLoader:
        """Loader that composes configurations, from Hydra too."""
        assert self.hydra_context is not None
        return self.hydra_context.config_loader

    @property
    def folder(self) -> Path:
        """The folder of the sweep."""
        return Path(str(self.options.hydra.sweep.dir))

    def run(self, jobs: Sequence[Overrides], total: int, before: int = 0) -> list[Path]:
        """Run those of the jobs that are not done, after `before` others of `total`; returns the folders of all. Raises TrihedronError when none
        can be composed, or the launcher fails."""
        self.folder.mkdir(parents=True, exist_ok=True)
        folders = [self.folder / str(number) for number in _numbers(self.folder, jobs)]
        missing: list[tuple[Overrides, Path]] = []
        errors: list[TrihedronError] = []
        composed: list[tuple[Overrides, Path]] = []
        for job, folder in zip(jobs, folders):
            words = [*job, f"hydra.sweep.subdir={folder.name}"]  # the last is its own alone
            try:
                key = key_of(self.compose_config(words))
            except Exception as error:
                errors.append(error if isinstance(error, TrihedronError) else rewrite_error(error))
                _keep_overrides(folder, job)
                write_job(folder, "", FAILED, str(errors[-1]))
                print(reason(folder, errors[-1]), file=sys.stderr)
                continue
            composed.append((job, folder))
            if read_job(folder) != {"key": key, "state": DONE, "error": ""}:
                (folder / "job.json").unlink(missing_ok=True)
                missing.append((words, folder))
        if len(errors) == len(jobs):
            raise errors[0]
        if already := len(jobs) - len(errors) - len(missing):
            print(f"sweep: {already} of {len(jobs)} jobs are done already", file=sys.stderr)
        if missing:
            with Progress([folder for _, folder in composed], changes_of([job for job, _ in composed]), before, total, len(errors)):
                self._launch(missing)
        return folders

    def _plan_job(self, job: Overrides, folder: Path) -> Planned:
        """The job as a dry run describes it."""
        try:
            config = self.compose_config([*job, f"hydra.sweep.subdir={folder.name}"])
            return Planned(folder, job, state_of(folder, key_of(config)), graph=graph_of(config))
        except Exception as error:
            return refused_job(folder, job, error)

    def compose_config(self, words: Overrides) -> DictConfig:
        """The configuration of a job."""
        return self.loader.load_sweep_config(self.options, words)

    def _launch(self, missing: list[tuple[Overrides, Path]]) -> None:
        """Hand the jobs and their folders to the launcher, and wait until they have ended."""
        assert self.launcher is not None
        try:
            with all_awaited():
                self.launcher.launch([words for words, _ in missing], initial_job_idx=0)
        except BrokenProcessPool as error:
            self._launch_apart(missing, error)
        except TrihedronError:
            raise
        except ModuleNotFoundError as error:  # the launcher's
            raise library_error((error.name or "").partition(".")[0], error) from error
        except Exception as error:  # of the engine; a job that fails leaves the reason in its folder
            raise _given_up(error) from error
        for words, folder in missing:
            _keep_overrides(folder, words[:-1])
            if read_job(folder).get("state") not in (DONE, FAILED):
                _record_death(folder)
        if self.options.hydra.launcher.get("n_jobs", 1) != 1:
            get_reusable_executor().shutdown()  # its processes would keep this folder and environment for the next sweep

    def _launch_apart(self, missing: list[tuple[Overrides, Path]], error: Exception) -> None:
        """A process that died took those beside it along. What had begun is run again, one at a time, so that only the job at fault fails; then
        what had not."""
        if len(missing) == 1:
            _record_death(missing[0][1])
            return
        begun = [job for job in missing if read_job(job[1]).get("state") == RUNNING]
        if not begun:
            raise _given_up(error) from error
        for job in begun:
            self._launch([job])
        if waiting := [job for job in missing if not read_job(job[1])]:
            self._launch(waiting)

    def jobs(self, arguments: list[str]) -> list[Overrides]:
        """The overrides of every job: the cross product of sequences, of all values given and of the alternatives."""
        parser = OverridesParser.create(config_loader=self.loader)
        words = [word for word in [*self.param_overrides, *arguments] if not word.startswith(OF_SWEEPS)]
        words += [] if any(word.startswith("threads=") for word in words) else [f"threads={self._threads}"]
        sequences = list(self.options.sequences)
        alternatives = words_of_alternatives(list(self.options.alternatives)) or [[]]
        of_each = [(words_of_sequence(text), alternatives_on(text, alternatives)) for text in sequences] or [([], alternatives)]
        given = [[*sequence, *words, *alternative] for sequence, some in of_each for alternative in some]
        if not given:
            raise UsageError("alternatives", "no sequence names any of these", "give 'sequences=[...]' too")
        return [job for one in given for job in _product(parser.parse_overrides(one))]

    @property
    def param_overrides(self) -> Overrides:
        """The overrides `params`."""
        return [f"{key}={value}" for key, value in self.params.items()]

    @property
    def _threads(self) -> int:
        """Threads of a job: the number that the cluster is asked for, two where jobs come one by one, else one."""
        launcher = self.options.hydra.launcher
        one_by_one = launcher.get("n_jobs") == 1 or self.options.hydra.runtime.choices["hydra/launcher"] == "basic"
        return int(launcher.get("cpus_per_task") or (2 if one_by_one else 1))


def words_of_sequence(text: str) -> Overrides:
    """Turn `KIND`, `KIND:FOLDER`, and options after blanks, into overrides: "tum:/data/desk frames=0:100" is dataset=tum dataset.path=/data/desk
    dataset.frames=0:100. Options of a data set underneath another (options.path=...) are added. Words of the graph, as without=loop or pose=icp, stay
    as they are. A folder with blanks is the longest that exists."""
    kind, path, options = _parts_of_sequence(text)
    keys = [_word_of_sequence(option) for option in options if not option.startswith(CHOICE)]
    return [f"dataset={kind}", *with_literal_paths(([f"dataset.path={path}"] if path else []) + keys)]


def _word_of_sequence(option: str) -> str:
    return option if is_graph_word(option) else f"{'+' * option.startswith('options.')}dataset.{option}"


def is_graph_word(word: str) -> bool:
    """Return True for a word that chooses a graph or a plugin other than the data set, or sets an option of one."""
    key, equals, _ = word.partition("=")
    return bool(equals) and key.partition(".")[0] in GRAPH_KEYS


def alternatives_on(text: str, alternatives: Sequence[Overrides]) -> list[Overrides]:
    """Return the alternatives that are tried on a sequence: all, or with `alternatives=A,B` among its words those that begin with a word of key A or
    B and the empty one beside them; none where there are no such. Raises UsageError for what can be no key."""
    chosen = {name for option in _parts_of_sequence(text)[2] if option.startswith(CHOICE) for name in option.removeprefix(CHOICE).split(",")}
    keys = [words[0].partition("=")[0] if words else "" for words in alternatives]
    for name in sorted(chosen - GRAPH_KEYS.union(keys)):
        raise UsageError("sequences", f"no alternative of '{text}' begins with '{name}='", did_you_mean(name, GRAPH_KEYS))
    if not chosen:
        return list(alternatives)
    return [words for words, key in zip(alternatives, keys) if key in chosen or not words] if chosen.intersection(keys) else []


def _parts_of_sequence(text: str) -> tuple[str, str, list[str]]:
    """Return kind, folder and options of a sequence. Raises UsageError."""
    match = re.fullmatch(r"(?P<kind>\w*)(:(?P<path>.*?))?(?P<options>(\s+[\w.]+=\S*)*)\s*", text, re.DOTALL)
    if match is None:
        raise UsageError("sequences", f"'{text}' is not a data set", 'write KIND:FOLDER KEY=VALUE ..., for example "tum:/data/desk frames=0:300"')
    kind, path, options = match["kind"], match["path"] or "", match["options"].split()
    words = re.split(r"(\s+)", path + match["options"])
    for count in range(len(words), 0, -2):  # blanks and `=` may be the folder's
        if path and Path(folder := "".join(words[:count])).expanduser().exists():
            path, options = folder, [word for word in words[count:] if word.strip()]
            break
    return kind, path, options


def words_of_alternatives(texts: Sequence[str]) -> list[Overrides]:
    """Turn texts into lists of overrides, each of which is tried with nothing else changed: words with blanks between them, or the name of a slot,
    which stands for each of its other plugins, but for `none` and those that need a file or another stage. The first list is empty: the configuration
    as it is."""
    found: list[Overrides] = [[]] if texts else []
    for text in texts:
        slot, *rest = text.split()
        if "=" in slot or slot not in SLOTS:
            found.append(with_literal_paths([slot, *rest]))
            continue
        found += [[f"{slot}={name}", *with_literal_paths(rest)] for name in plugins_alone(slot)]
    return found


def plugins_alone(slot: str) -> list[str]:
    """Return the names of a slot's plugins that can be chosen with nothing else: all but `none` and those that need a file or another stage."""
    load_plugins()
    named = {name: plugin for name, plugin in plugins_of(slot).items() if name != "none" and not hasattr(plugin, "needs")}
    return [name for name, plugin in named.items() if not any(option.name == "model" for option in options_of(plugin))]


def _numbers(folder: Path, jobs: Sequence[Overrides]) -> list[int]:
    """The folder of each job: the one that has its overrides, else the next free number."""
    files = [file for file in folder.glob("*/.hydra/overrides.yaml") if file.parent.parent.name.isdigit()]
    numbers = [int(file.parent.parent.name) for file in files]
    known: dict[tuple[str, ...], int] = {}
    for file, number in zip(files, numbers):
        with suppress(DataError):  # a crash left it empty
            known[tuple(read_words(file))] = number
    free = itertools.count(max(numbers, default=-1) + 1)
    return [known[tuple(job)] if tuple(job) in known else next(free) for job in jobs]


def changes_of(jobs: Sequence[Overrides]) -> list[str]:
    """Return the words of each job that not all of them have."""
    common = common_words(jobs)
    return [" ".join(word for word in job if word not in common) for job in jobs]


def _product(overrides: list[Override]) -> list[Overrides]:
    """The cross product of all values given; a later override replaces an earlier one of its key. Raises UsageError for a space to search in."""
    values: dict[str, Overrides] = {}
    for override in overrides:
        key = override.get_key_element()
        if override.is_sweep_override() and not override.is_discrete_sweep():
            raise UsageError(key, f"'{override.input_line}' is a space to search in", "give values A,B or hydra/sweeper=optuna")
        texts = override.sweep_string_iterator() if override.is_sweep_override() else [override.get_value_element_as_str()]
        values[key] = [f"{key}={text}" for text in texts]
    return [list(job) for job in itertools.product(*values.values())]


def _given_up(error: Exception) -> TrihedronError:
    """Error of an engine of Hydra's, as one line."""
    cause = next(iter(str(error).splitlines()), type(error).__name__)
    return TrihedronError("hydra.launcher", cause, "what is done is kept; the same command again runs the rest")


def failure_of(folder: Path) -> str:
    """Why the job of a folder came to no end; empty for one that did."""
    job = read_job(folder)
    return "" if job.get("state") == DONE else str(job.get("error") or "was stopped before its end")


def _keep_overrides(folder: Path, job: Overrides) -> None:
    """Write the overrides that identify a job which ended before it could write them itself: it has no run then, but a reason."""
    file = folder / ".hydra" / "overrides.yaml"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        make_folder(file.parent)
        write_file(file, yaml.safe_dump(job))


def _record_death(folder: Path) -> None:
    """Say so of a job that cannot."""
    write_job(folder, "", FAILED, f"{folder}: its process died; it crashed, or memory ran out")
