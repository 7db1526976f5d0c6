"""The command `trihedron`: `run` here, every other command from the entry-point group `trihedron.commands`.

Exit codes: 0 done, 1 an error in configuration, data or a stage, 2 wrong usage, 128 + the signal's number when one ended it (130 SIGINT, 143 SIGTERM,
129 SIGHUP). Errors are one line; `--debug` shows the traceback.
"""

from __future__ import annotations

import ast
import errno
import gc
import io
import os
import shlex
import sys
import textwrap
import time
from collections.abc import Callable, Iterable
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial
from importlib.abc import InspectLoader
from importlib.metadata import EntryPoint, entry_points, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError, TrihedronError, UsageError, did_you_mean
from trihedron.pipeline.core.libraries import library_error
from trihedron.pipeline.core.overrides import literal_text, path_of, with_literal_paths
from trihedron.pipeline.run import memory
from trihedron.pipeline.run.interrupts import Interruption, ending_signals_interrupt

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from trihedron.pipeline.core.config import RecordedConfig
    from trihedron.pipeline.sweep.sweep import Outcome

_FAILURES: list[Exception] = []  # of this process's runs
_BEGAN = time.perf_counter()
COMMAND_GROUP = "trihedron.commands"
RUN_FLAGS = ("-m", "--multirun")
CURES = {  # of a file that cannot be written, by the number of the error
    errno.ENOSPC: "make room, or give another place",
    errno.ENOENT: "make its folder first, or give another place",
    errno.EISDIR: "give the name of a file in it",
}
DRY_RUN = "--dry-run", "dry_run=true"  # a flag of sweeps, and the word that it stands for
RUN_HELP = """Track a sequence: compose the configuration, run the graph, write the run folder.

Usage: trihedron run [-m] [key=value ...]

  FOLDER | FILE.mcap | FILE.bag      what to track; the data set is known by its files, else: dataset=NAME dataset.path=FOLDER
                                     a relative path begins in the working folder; nothing else is searched
  dataset=NAME                       {datasets}
  dataset.frames=A:B, A:B:S          half-open range; every S-th of it  dataset.camera=PRESET|FILE  the camera
  graph=NAME                         {graphs}
  without=PART                       {without}
  experiment=NAME (with -m)          {experiments}
  STAGE=PLUGIN STAGE.OPTION=VALUE    swap a method, set its options (trihedron plugins lists them all)
  graph.STAGE.INPUT=TOPIC            change a wire: topic, topic@prev or topic@5
  'outputs=[trajectory]'             what must be computed           threads=2  seed=0
  out=FOLDER                         the run folder (default runs/<date>/<time>; runs/latest points at the newest)
  'record.topics=[normals]'          record dense topics too         record.frames=true  embed the input frames
  replay=FILE.mcap 'only=[STAGE]'    compute these stages again, read the rest from a recording
  save_map=FILE.mcap                 keep the map, to go on from    load_map=FILE.mcap  go on from it, or find the camera in it
  localise_only=true                 the loaded map stays as it is
  calibrate=true                     track twice: first to calibrate the camera, then with what is recommended (OUT/camera.yaml)
  view=foxglove | view=rerun         watch the run; view.web=true serves rerun to a browser; view.port=8765, view.host=127.0.0.1
                                     what is served stays until Ctrl-C, with view.keep=false it ends with the run
  live=true                          play the data set in real time; frames that come while it is busy are dropped, latency is reported
  real_time=true                     the same without dropping any
  budget_ms=33                       a frame may take that long on average; else the words of 'budget_order=[...]' hold, one after the other:
                                     keypoints.features=600, bundle=none, loop=none; each decision is recorded
  feedback=recorded                  each recomputed stage by itself: all its inputs are as recorded
  -m                                 sweep over comma-separated values, on all cores; the same again does what is missing
  -m ... --dry-run                   say which jobs a sweep has, which are done, and which stages they share; run nothing
  'sequences=[KIND:FOLDER,...]'      of a sweep: several data sets, for example 'sequences=["tum:/data/desk frames=0:300",synthetic]'
  hydra/launcher=dask                of a sweep: on a cluster; hydra/sweeper=optuna: a search (README)
  report=COMMAND                     what to do with the folder of a sweep at its end, for example: report="benchmark methods"

Example: trihedron run rgbd_dataset_freiburg3_structure_notexture_far
Example: trihedron run replay=runs/latest/run.mcap 'only=[manhattan,rotation]' manhattan.cone_deg=8"""


def main(argv: list[str] | None = None) -> int:
    """Entry point of the command; returns the exit code."""
    memory.configure_malloc()
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where the terminal has no such letter
    try:
        with ending_signals_interrupt():
            memory.check_address_space()
            code = _dispatch([word for word in words if word != "--debug"])
            sys.stdout.flush()
            return code
    except KeyboardInterrupt as error:
        print("; ".join(["trihedron: interrupted", *getattr(error, "__notes__", [])]), file=sys.stderr)
        return error.exit_code if isinstance(error, Interruption) else 130
    except BrokenPipeError:
        _discard_stdout()
        return 0
    except Exception as error:
        mistake = _of_the_machine(error)
        if debug or mistake is None:
            raise
        print(f"trihedron: {mistake}", file=sys.stderr)
        return mistake.exit_code


def _of_the_machine(error: Exception) -> TrihedronError | None:
    """The error as one line where the user or the machine caused it: no memory, no thread, no room, no permission, no library; None for a defect."""
    if isinstance(error, TrihedronError):
        return error
    if isinstance(error, OSError) and error.strerror:
        if error.filename is None and error.errno in (errno.ENOSPC, errno.EIO, errno.EBADF):
            _discard_stdout()
        cure = CURES.get(error.errno or 0, "give another place")
        return DataError(str(error.filename or "standard output"), f"cannot be used: {error.strerror}", cure)
    if (exhausted := memory.exhaustion(error)) is not None:
        return exhausted
    if isinstance(error, RuntimeError) and "home directory" in str(error):  # Path.expanduser
        return DataError("path", "begins with ~ and the name of nobody", "write ./~NAME for a file of that name")
    if isinstance(error, ModuleNotFoundError) and (library := str(error.name).partition(".")[0]) != "trihedron":
        return library_error(library, error)
    return None


def _open_closed_streams() -> None:
    """Open the null device as standard input, output and error where the caller closed them (`>&-`): the run's own files would take their numbers,
    and what libraries print would go there."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))


def _discard_stdout() -> None:
    """Send what is still buffered nowhere, so that the interpreter's end does not complain of it."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(words: list[str]) -> int:
    commands = {entry.name: entry for entry in entry_points(group=COMMAND_GROUP)}
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help(commands))
        return 0
    if words[0] == "--version":
        print(f"trihedron {version('trihedron')}")
        return 0
    name, rest = words[0], words[1:]
    if name == "run":
        return _run(rest)
    if name not in commands:
        raise UsageError(name, "there is no such command", did_you_mean(name, ["run", *commands]))
    command: Callable[[list[str]], int] = commands[name].load()
    return command(rest)


def _help(commands: dict[str, EntryPoint]) -> str:
    lines = ["RGB-D SLAM for man-made scenes: swappable stages, recorded topics, single-stage replay.", "", "Usage: trihedron COMMAND ...", ""]
    documents = {"run": RUN_HELP} | {name: _document(entry) for name, entry in sorted(commands.items())}
    for name, text in documents.items():
        lines.append(f"  {name:12} {text.splitlines()[0] if text else ''}")
        lines += [f"               {line.strip()}" for line in text.splitlines() if line.strip().startswith("Example: ")][:1]
    return "\n".join([*lines, "", "trihedron COMMAND --help explains a command; --debug shows the traceback of an error."])


def _document(entry: EntryPoint) -> str:
    """The docstring of the command's module, read and not run: importing what all commands need takes half a second."""
    try:
        return ast.get_docstring(ast.parse(_source(entry))) or ""
    except ImportError as error:
        return f"cannot be loaded: {error}"


def _source(entry: EntryPoint) -> str:
    """The text of the command's module, empty where it has none. Raises ImportError."""
    spec = find_spec(entry.module)
    return (spec.loader.get_source(entry.module) if spec and isinstance(spec.loader, InspectLoader) else None) or ""


def _run(words: list[str]) -> int:
    """Compose the configuration and execute it, once or as a sweep."""
    if "-h" in words or "--help" in words:
        print(run_help())
        return 0
    for word, following in zip(words, [*words[1:], ""]):
        if word.startswith("-") and word not in (*RUN_FLAGS, DRY_RUN[0]):
            raise _unknown_flag(word, following)
    words = [given for word in words for given in _data_set(DRY_RUN[1] if word == DRY_RUN[0] else word)]
    for word in words:
        if word.startswith("=") or word == "out=":
            raise UsageError(word, "lacks a " + ("key" if word.startswith("=") else "folder"), "write key=value, for example out=runs/mine")
    with memory.gc_paused():
        words = _in_current_names(words)
    if _is_sweep(words):
        from trihedron.pipeline.core.config import check_added

        check_added(words)
        return _sweep(words, _recorded_config(words))
    run_once(words, _BEGAN, keep=True)
    return 0


def _unknown_flag(word: str, following: str) -> UsageError:
    """Return the error of a word that is an option of no run: a key is written as key=value, and an option may be another command's."""
    from trihedron.pipeline.core.config import is_key, is_switch

    flag, equals, value = word.partition("=")
    key = flag.lstrip("-")
    if is_key(key):
        if not equals:
            value = "true" if is_switch(key) else following if following and "=" not in following and not following.startswith("-") else "VALUE"
        return UsageError(flag, "is not an option of run", f"write {shlex.quote(f'{key}={value}')}")
    if having := sorted(entry.name for entry in entry_points(group=COMMAND_GROUP) if _has_option(entry, flag)):
        return UsageError(flag, "is not an option of run", f"it belongs to trihedron {' and '.join(having)}")
    return UsageError(word, "is not an option of run", f"known: {', '.join((*RUN_FLAGS, DRY_RUN[0]))}; everything else is key=value")


def _has_option(entry: EntryPoint, flag: str) -> bool:
    """Say if a command has an option, by the text of its module."""
    with suppress(ImportError):
        return f'add_argument("{flag}"' in _source(entry)
    return False


def _in_current_names(words: list[str]) -> list[str]:
    """The words with the names of earlier versions replaced, each with a warning."""
    from trihedron.pipeline.core.registry import load_packages, load_plugins, options_of, plugins_of
    from trihedron.pipeline.core.renamed import current_words

    def options_of_slot(slot: str) -> dict[str, set[str]]:
        load_plugins()
        return {name: {option.name for option in options_of(plugin)} for name, plugin in plugins_of(slot).items()}

    load_packages()
    words, warnings = current_words(words, options_of_slot)
    for warning in warnings:
        print(f"trihedron: warning: {warning}", file=sys.stderr)
    return words


def run_help() -> str:
    """Return the help of `run`, with the names of all data sets and graphs."""
    from importlib.resources import files

    from trihedron.pipeline.core.registry import load_plugins, plugins_of

    load_plugins()
    groups = {
        group: sorted(entry.name.removesuffix(".yaml") for entry in (files("trihedron.conf") / group).iterdir() if entry.name.endswith(".yaml"))
        for group in ("graph", "without", "experiment")
    }
    return RUN_HELP.format(
        datasets=_list_names(plugins_of("dataset"), "synthetic"),
        graphs=_list_names(groups["graph"], "structural"),
        without=", ".join(groups["without"]),
        experiments=", ".join(groups["experiment"]),
    )


def _list_names(names: Iterable[str], default: str) -> str:
    """The names, the default first, as lines of the help's second column."""
    others = [f"{default} (default)", *(name for name in sorted(names) if name not in (default, "pushed"))]
    return textwrap.fill(", ".join(others), 110).replace("\n", "\n" + " " * 37)


def _data_set(word: str) -> list[str]:
    """A word of run as overrides: a path chooses the data set, and prints which. Raises UsageError for a word that is neither."""
    from trihedron.pipeline.core.layouts import SOURCES, data_set_words

    words = data_set_words(word)
    if words == [word] and "=" not in word and not word.startswith(("-", "~", "+")):
        searched = "there is no such path" if Path(word).is_absolute() else f"there is no such path in {Path.cwd()}"
        raise UsageError(word, f"is not key=value, and {searched}", f"give {SOURCES}, or key=value (quote lists: 'only=[pose]')")
    if words != [word]:
        print(*words, file=sys.stderr)
    return words


def run_once(words: list[str], began: float, keep: bool = False) -> tuple[Path, dict[str, Any]]:
    """Make one run of these words, which began at a time (perf_counter), and keep its viewer if `keep`, as `execute` does. Returns its folder and its
    metrics. Raises TrihedronError."""
    with memory.gc_paused():
        from trihedron.pipeline.core.config import check_added, compose_run, rewrite_error

        check_added(words)
        config = compose_run(words, _recorded_config(words))
        from trihedron.pipeline.app.execute import execute

        gc.freeze()  # what is imported stays: no collection looks at it again
    if config.dry_run:
        raise UsageError(DRY_RUN[0], "is of a sweep, and this is one run", "add -m to run once with each of several values")
    try:
        out = Path(config.out).expanduser().absolute()
    except Exception as error:  # an interpolation of the user's that leads nowhere
        raise rewrite_error(error) from error
    config.out = literal_text(str(out))  # with the time of its beginning
    return out, execute(config, out, with_literal_paths(words), began, keep)


def _sweep(words: list[str], recorded: RecordedConfig | None) -> int:
    """Let Hydra's multirun carry the jobs; then report."""
    import hydra

    from trihedron.pipeline.core.config import register_configs, rewrite_error

    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions come to us instead of being printed
    register_configs(recorded)
    overrides = with_literal_paths(words, sweep=True)
    outcomes = _run_sweep(words)
    _FAILURES.clear()
    sys.argv = ["trihedron run", *sorted(overrides, key=lambda word: word not in RUN_FLAGS)]  # flags first
    try:
        hydra.main(config_path="pkg://trihedron.conf", config_name="root", version_base="1.3")(_task)()
    except Exception as error:
        raise error if isinstance(error, TrihedronError) else rewrite_error(error) from error
    for outcome in outcomes:
        if len(outcome.failures) < outcome.jobs:
            _dispatch([*(shlex.split(outcome.report) or ["compare"]), str(outcome.folder)])
            print(f"next: trihedron report {shlex.quote(str(outcome.folder))} draws the runs of this table")
        outcome.raise_failures()
    if _FAILURES and not outcomes:
        raise _FAILURES[0]
    return 0


def _run_sweep(words: list[str]) -> list[Outcome]:
    """Path of the outcomes of the sweeps that the words ask for; a single run does not wait for the engines of sweeps to be imported."""
    if not _is_sweep(words):
        return []
    from trihedron.pipeline.sweep.engines import register_engines

    return register_engines()


def _is_sweep(words: list[str]) -> bool:
    return any(word in RUN_FLAGS or word.lstrip("+").startswith("hydra.mode=") for word in words)


def _task(config: DictConfig) -> float | None:
    """One run, or one job of a sweep, which may be in a process of its own. Returns the ATE in metres, for sweepers that search."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from trihedron.pipeline.app.execute import execute

    runtime = HydraConfig.get()
    out = Path(runtime.runtime.output_dir)
    work = partial(execute, config, out, list(runtime.overrides.task), _BEGAN)
    try:
        metrics: dict[str, Any] = _job(config, out, work) if runtime.mode == RunMode.MULTIRUN else work()
    except Exception as error:  # one job of a sweep must not stop the others, and Hydra would print its overrides
        _FAILURES.append(error)
        return None
    return metrics["final"]["ate_rmse_m"] if "final" in metrics else None


def _job(config: DictConfig, out: Path, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Do the work of a job, keeping what it prints in its folder, and how it ended in job.json."""
    from trihedron.pipeline.core.files import open_anew
    from trihedron.pipeline.core.registry import load_packages
    from trihedron.pipeline.sweep.jobs import DONE, FAILED, RUNNING, key_of, write_job

    load_packages()
    key = key_of(config)
    write_job(out, key, RUNNING)
    try:
        with open_anew(out / "log.txt") as log, redirect_stdout(log), redirect_stderr(log):
            metrics = work()
    except Exception as error:
        write_job(out, key, FAILED, str(error) or type(error).__name__)
        raise
    write_job(out, key, DONE)
    return metrics


def _recorded_config(words: list[str]) -> RecordedConfig | None:
    """The configuration of the recording that the words replay, or None."""
    from trihedron.pipeline.app.recorded_run import recorded_config_of
    from trihedron.pipeline.record.reader import Recording

    source = next((found[1] for word in reversed(words) if (found := path_of(word)) is not None and found[0] == "replay"), "")
    return recorded_config_of(Recording(source)) if source else None
