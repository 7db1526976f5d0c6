"""Execution of `trihedron run`: from a composed configuration to a finished run folder."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from trihedron.pipeline.app.budgets import budget_of
from trihedron.pipeline.app.calibrated_run import UNCALIBRATED, calibrated_config, check_calibrated, check_camera_file, comparison_line, uncalibrated
from trihedron.pipeline.app.compilation import compile_once
from trihedron.pipeline.app.trajectory_plot import trajectory_figure
from trihedron.pipeline.app.viewers import Viewer, opened_viewer
from trihedron.pipeline.core.config import Feedback, graph_of
from trihedron.pipeline.core.errors import ConfigError, DataError, LibraryError, RecordingError, StageError, did_you_mean, printable
from trihedron.pipeline.core.files import sha256_of
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.options import frame_range
from trihedron.pipeline.core.overrides import literal_text, path_of, quote
from trihedron.pipeline.core.registry import write_files_of
from trihedron.pipeline.core.slots import SLOTS, output_of
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.mcap_writer import FLUSH_SECONDS
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import TRUTH, attached_truth, format_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run import results
from trihedron.pipeline.run.interrupts import defer_interrupts
from trihedron.pipeline.run.live import Pace, shows_once
from trihedron.pipeline.run.map_file import load_map, save_map
from trihedron.pipeline.run.replay import TOPICS, Replay
from trihedron.pipeline.run.run_folder import FolderBefore, check_replaced, claim_folder, point_latest, remove_models, write_configuration
from trihedron.pipeline.run.runner import Runner, Step
from trihedron.pipeline.run.state import DelayLines, max_delays
from trihedron.pipeline.run.stated_sigma import sigma_line
from trihedron.pipeline.run.timing import forget_peak
from trihedron.pipeline.run.warm_up import compilation_reported, warm_up_budgeted

NETWORKS = tuple(f"{slot}.model" for slot in SLOTS)  # files of networks, of the plugins that run one
READ_PATHS = ("dataset.path", "dataset.camera", "dataset.options.path", "dataset.options.camera", "load_map", "building.edits", *NETWORKS)
PLAIN_PROGRESS_SECONDS = 5.0
MAX_THREADS = 256


def execute(config: DictConfig, out: Path, overrides: list[str], began: float, keep: bool = False) -> dict[str, Any]:
    """Run the configuration into folder `out`; `began` is when the program started (perf_counter). Returns the metrics. With `keep` a viewer that is
    served stays after the run until the user ends it, unless `view.keep=false`.

    Raises TrihedronError. Whatever happens after the first frame, the recording is closed and the trajectory so far is written."""
    with opened_viewer(config) as viewer:
        metrics = _execute_twice(config, out, overrides, began, viewer) if config.calibrate else _execute(config, out, overrides, began, viewer)
        if not config.replay:  # a part of a run, and no run to look at
            point_latest(out)
        if keep and config.get("view") is not None and config.view.keep:
            viewer.keep()
        return metrics


def _execute_twice(config: DictConfig, out: Path, overrides: list[str], began: float, viewer: Viewer) -> dict[str, Any]:
    """Track with the stated camera, calibrate from that, and run with what is recommended. What the run would be refused for is refused before."""
    check_settings(config)
    graph = graph_of(config)
    check_calibrated(config)
    remembered_of(config, graph), recorded_topics(config, graph, None)
    check_replaced(out, config, graph.stages)
    check_camera_file(config, out)
    first = out / UNCALIBRATED
    print(f"calibrate: the stated camera is tracked first, into {first}", flush=True)
    before = _execute(*uncalibrated(config, first, overrides), began, Viewer())
    calibrated = calibrated_config(config, out)
    after = _execute(calibrated, out, overrides, time.perf_counter(), viewer)
    if calibrated is not config:
        print(comparison_line(before, after, out))
    return after


def _execute(config: DictConfig, out: Path, overrides: list[str], began: float, viewer: Viewer) -> dict[str, Any]:
    forget_peak()
    check_settings(config)
    graph = graph_of(config)
    replay = _replay(config, graph)
    frames = str(config.dataset.get("frames", "")) if config.dataset is not None else ""
    remembered, source = remembered_of(config, graph), source_of(config)
    budget, period = budget_of(config, graph), viewer.preview_period
    runner = Runner(graph, config.seed, config.threads, replay, frames, remembered, _pace(config), preview_period=period, budget=budget)
    topics = recorded_topics(config, graph, replay)
    if replay is not None:
        _check_words(overrides, graph, runner)
    _announce(runner)
    trial = partial(Runner, graph, config.seed, config.threads, replay, frames, remembered)
    before = FolderBefore.of(out / RECORDING)
    with claim_folder(out, config, runner.computed) as earlier, _removed_without_frames(runner, before):
        compile_once(runner.computed, runner.count if runner.feed is None else None)
        write_configuration(out, config, overrides)
        with Warnings() as warnings, compilation_reported():
            warm_up_budgeted(trial, budget if replay is None else None)
            warnings.muted = False
            metadata = {**metadata_of(config, overrides), TOPICS: json.dumps(sorted(topics))}
            attachments = _attachments(graph, replay)
            truth = attached_truth(attachments, str(out / RECORDING))
            started, writer, failure = time.perf_counter(), None, None
            try:
                with defer_interrupts():
                    writer = open_writer(out / RECORDING, metadata, attachments, viewer.server)
                for _ in _progress(runner.steps(writer, topics, "dataset" in topics, truth, viewer.sinks)):
                    pass
                if config.save_map:
                    save_map(Path(config.save_map).expanduser(), runner.state, metadata_of(config, overrides), source)
            finally:
                with defer_interrupts():
                    if writer is not None:
                        failure = close_writer(writer)
                        metrics, timing = write_files(runner, truth, out, started, began, earlier)
                    warnings.summarise()
        if replay is not None:
            print(_replay_summary(replay, runner, timing))
        _report(out, metrics, timing, write_models(out, runner, earlier), bool(config.calibrate))
    if failure is not None:
        raise failure
    return metrics


def check_settings(config: DictConfig) -> None:
    """Raise ConfigError for a number of threads, or a seed, that is none."""
    if not 1 <= config.threads <= MAX_THREADS:
        raise ConfigError("threads", f"{config.threads} is not a number of threads", f"give 1 to {MAX_THREADS}")
    if config.seed < 0:
        raise ConfigError("seed", f"{config.seed} is negative", "give 0 or more")


def _check_words(words: Sequence[str], graph: Graph, runner: Runner) -> None:
    """Raise ConfigError for a word of a replay that changes a stage whose values are read: it would change nothing."""
    read = set(graph.stages) - set(runner.computed) - {"dataset"}
    for word in words:
        key = word.lstrip("+~").partition("=")[0]
        stage = key.removeprefix("graph.").partition(".")[0]
        if stage in read:
            computed = ",".join([*(runner.replay.only if runner.replay is not None else ()), stage])
            raise ConfigError(key, f"{stage} is read from the recording, so this changes nothing", f"add it to the stages: 'only=[{computed}]'")


def open_writer(
    path: Path, metadata: Mapping[str, str], attachments: Mapping[str, str], server: FoxgloveServer | None = None, flush_s: float = FLUSH_SECONDS
) -> RecordingWriter:
    """Open the recording and attach its texts."""
    writer = RecordingWriter(path, metadata, server, flush_s)
    for name, text in attachments.items():
        writer.attach(name, text)
    return writer


@contextmanager
def _removed_without_frames(runner: Runner, before: FolderBefore) -> Iterator[None]:
    """Remove what the block adds to the run folder where it ends before a frame is done; the note of an interruption names what is left. What a stage
    failed on is kept, to repeat it."""
    try:
        yield
    except BaseException as error:
        count, out = len(runner.result.stamps_ns), before.folder
        if not count and not isinstance(error, StageError):
            before.restore()
        if isinstance(error, KeyboardInterrupt):
            left = f"{out} is removed" if before.missing else f"{out} was there before and is kept"
            note = f"frames done: {count}, kept in {out}" if count else f"nothing was computed{', and' if before.missing else ';'} {left}"
            error.__notes__ = [*getattr(error, "__notes__", []), note]  # as `add_note` does, which Python 3.10 has not
        raise


def close_writer(writer: RecordingWriter) -> RecordingError | None:
    """Close the recording; what goes wrong must not cost the trajectory."""
    try:
        writer.close()
    except RecordingError as error:
        return error
    return None


def remembered_of(config: DictConfig, graph: Graph) -> Callable[[int], DelayLines] | None:
    """Initial memory of a run: nothing, or the map file it continues."""
    if config.save_map and config.replay:
        raise ConfigError("save_map", "a replay makes no map to go on from", "save the map of the run itself")
    if config.save_map and not (folder := Path(config.save_map).expanduser().absolute().parent).is_dir():
        raise ConfigError("save_map", f"the folder {folder} does not exist", "make it first")
    if not config.load_map:
        if config.localise_only:
            raise ConfigError("localise_only", "needs a map to find the camera in", "give load_map=FILE.mcap too")
        return None
    if "map" not in max_delays(graph.stages.values()):
        raise ConfigError("load_map", "no stage of this graph reads a map", "choose another graph")
    saved, source, stride = load_map(config.load_map), source_of(config), _frames_of(config).step
    return lambda first: saved.delay_lines(first, stride, source)


def _frames_of(config: DictConfig) -> range:
    """The numbers of the frames that a run takes of its data set."""
    return frame_range(str(config.dataset.get("frames", "")) if config.dataset is not None else "")


def _pace(config: DictConfig) -> Pace:
    if (config.live or config.real_time) and config.replay:
        raise ConfigError("live" if config.live else "real_time", "a replay has its frames already", "leave it out")
    if config.live and config.real_time:
        raise ConfigError("real_time", "a live run is in real time, and drops frames", "give one of the two")
    return Pace.live if config.live else Pace.real_time if config.real_time else Pace.none


def source_of(config: DictConfig) -> str:
    """Data set that is tracked, whichever part of it: its options with absolute paths, and the stride where not every frame is."""
    options: Any = OmegaConf.to_container(config.dataset, resolve=True, enum_to_str=True) if config.dataset is not None else {}
    options = {name: _absolute(value) if f"dataset.{name}" in READ_PATHS else str(value) for name, value in options.items() if name != "frames"}
    options |= {"stride": step} if (step := _frames_of(config).step) > 1 else {}
    return json.dumps(options, sort_keys=True)


def _replay(config: DictConfig, graph: Graph) -> Replay | None:
    if not config.replay:
        if config.only:
            raise ConfigError("only", "chooses stages of a replay, and there is none", "give replay=FILE.mcap too")
        return None
    for name in config.only:
        if name not in graph.stages:
            raise ConfigError("only", f"this graph has no stage '{name}'", did_you_mean(name, graph.stages))
    only = tuple(config.only) or tuple(graph.stages)
    return Replay(Recording(config.replay), only, config.feedback is Feedback.recorded)


def recorded_topics(config: DictConfig, graph: Graph, replay: Replay | None) -> frozenset[str]:
    """All computed topics that are not dense, and the dense ones that were named."""
    known = set(graph.stages) | (replay.recording.topics if replay is not None else set())  # a replay may leave out stages of the run
    for name in config.record.topics:
        if name not in known:
            raise ConfigError("record.topics", f"no stage writes '{name}'", did_you_mean(name, known))
    names = {name for name in graph.stages if not output_of(name).dense} | (set(config.record.topics) & set(graph.stages))
    names |= {"dataset"} if config.record.frames or shows_once(graph.stages["dataset"].plugin) else set()
    return frozenset(names if replay is None else names & set(replay.only))


def _announce(runner: Runner) -> None:
    """Say which topics a replay lacks and computes after all."""
    if runner.replay is not None:
        extra = [name for name in runner.computed if name not in runner.replay.only]
        if extra:
            print(f"not in {runner.replay.recording.path}, computed again: {', '.join(extra)}")


def metadata_of(config: DictConfig, overrides: list[str]) -> dict[str, str]:
    """Describe the run: version, commit, the words of its command, and its composed configuration, from which a replay is made."""
    config = config.copy()
    for key in READ_PATHS:
        if isinstance(path := OmegaConf.select(config, key), str):
            OmegaConf.update(config, key, literal_text(_absolute(path)))
    for key in NETWORKS:
        options = config.get(key.partition(".")[0])
        if isinstance(options, DictConfig) and "sha256" in options and options.get("model"):
            options.sha256 = sha256_of(options.model)  # a replay demands the same file
    if isinstance(options := config.get("building"), DictConfig) and options.get("edits"):
        options.edits_sha256 = sha256_of(options.edits)  # likewise
    return {
        "version": importlib.metadata.version("trihedron"),
        "commit": _commit(),
        "overrides": json.dumps([_absolute_word(word) for word in overrides]),
        "config": OmegaConf.to_yaml(config, resolve=True),
    }


def _absolute(path: str) -> str:
    """The path as seen from anywhere, so that a replay finds it from another folder; text that names nothing stays as it is."""
    return str(Path(path).expanduser().resolve()) if path and Path(path).expanduser().exists() else path


def _absolute_word(word: str) -> str:
    found = path_of(word)
    return word if found is None or found[0].lstrip("+") not in READ_PATHS else f"{found[0]}={quote(_absolute(found[1]))}"


@cache
def _commit() -> str:
    """The git commit of the source tree when this process first asked, or nothing for an installed package."""
    folder = Path(__file__).resolve().parent
    try:
        top = subprocess.run(["git", "-C", str(folder), "ls-files", "--error-unmatch", str(Path(__file__).resolve())], capture_output=True, timeout=5)
        head = subprocess.run(["git", "-C", str(folder), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return head.stdout.strip() if top.returncode == 0 else ""


def _progress(steps: Iterator[Step]) -> Iterator[Step]:
    """A bar with the frame rate on a terminal, a plain line every few seconds on another standard output."""
    bar: Any = None
    began = printed = time.perf_counter()
    for step in steps:
        if sys.stderr.isatty() and sys.stdout.isatty():
            bar = bar or tqdm(total=step.count, unit="frame", dynamic_ncols=True)
            bar.update()
        elif time.perf_counter() - printed > PLAIN_PROGRESS_SECONDS:
            printed = time.perf_counter()
            print(f"frame {step.position + 1}/{step.count}, {(step.position + 1) / (printed - began):.1f} frames/s", flush=True)
        yield step
    if bar is not None:
        bar.close()


def write_files(
    runner: Runner, truth: Trajectory | None, out: Path, started: float, began: float, earlier: bool, plot: bool = True
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write the files beside the recording, in the place of an `earlier` run's where the folder is that of one; returns metrics and times. A
    trajectory is there only with poses, its picture if `plot` only with two."""
    metrics: dict[str, Any] = {}
    timing = runner.timing.summary(runner.threads, time.perf_counter() - started, started - began)
    if runner.feed is not None:
        timing["live"] = runner.feed.summary(timing["frame_ms"])
    if runner.budgeted is not None:
        timing["budget"] = runner.budgeted.summary()
    try:
        for name in results.OF_POSES if earlier and runner.result.stamps_ns else ():
            (out / name).unlink(missing_ok=True)
        if "pose" in runner.computed:
            result = results.with_unpacked_poses(runner.result)
            final = results.final_trajectory(result)
            metrics = results.write_results(out, result, final, truth)
            if plot and len(final) > 1:
                try:
                    trajectory_figure(final, truth, out / results.PLOT, [(pose.stamp_ns, pose.status) for pose in result.poses])
                except LibraryError as error:
                    print(f"trihedron: warning: {results.PLOT} is not drawn: {error}", file=sys.stderr)
        results.write_json(out / results.TIMING, timing)
    except OSError as error:
        raise DataError(str(error.filename or out), f"cannot be written: {error.strerror}", "make room, or give another out=FOLDER") from error
    return metrics, timing


def _attachments(graph: Graph, replay: Replay | None) -> dict[str, str]:
    """The ground truth as text: of the recording that is replayed, else of the data set. A run is judged by that text, so a replay agrees."""
    if replay is not None:
        return replay.recording.attachments
    truth: Trajectory | None = graph.stages["dataset"].plugin.truth()
    return {TRUTH: format_trajectory(truth)} if truth is not None else {}


def write_models(out: Path, runner: Runner, earlier: bool) -> list[str]:
    """Write the files of a run's folds (surface, building), in the place of an `earlier` run's where the folder is that of one, and return lines that
    describe them."""
    removed = remove_models(out) if earlier else set()
    lines = [line for slot, value in runner.result.folds.items() for line in write_files_of(slot, out, value)]
    stale = ", ".join(sorted(name for name in removed if not (out / name).exists()))
    return [*lines, *([f"removed, as it was of an earlier run: {stale}"] if stale else [])]


def _replay_summary(replay: Replay, runner: Runner, timing: dict[str, Any]) -> str:
    """Describe in one line what a replay computed."""
    counts = [f"{name} ({stage['calls']} calls)" for name, stage in timing["stages"].items() if name in runner.computed]
    return f"computed: {', '.join(counts) or 'nothing'}; the rest is read from {replay.recording.path}"


def _report(out: Path, metrics: dict[str, Any], timing: dict[str, Any], surfaces: list[str], calibrated: bool) -> None:
    status = metrics.get("status", {})
    if status:
        print("frames: " + ", ".join(f"{count} {name}" for name, count in status.items() if count))
    if sigma := metrics.get("sigma"):
        print(sigma_line(sigma, out, calibrated))
    for name, reason in metrics.get("reasons", {}).items():
        print(f"{name}, most of them: {reason}")
    if live := timing.get("live"):
        late = live["latency_ms"]
        counts = f"{live['came']} frames came, {live['taken']} were taken, {live['dropped']} dropped"
        print(f"live: {counts}; a pose is ready {late['p50']:.0f} ms after its frame came (median; at most {late['max']:.0f} ms)")
    if budget := timing.get("budget"):
        print(budget_line(budget))
    if "final" in metrics:
        print(f"ATE {metrics['final']['ate_rmse_m']:.4f} m (as tracked {metrics['causal']['ate_rmse_m']:.4f} m)")
    for line in surfaces:
        print(line)
    for path in sorted(out.iterdir()):
        if path.is_file():
            print(f"  {path}")


def budget_line(budget: Mapping[str, Any]) -> str:
    """Say in one line how many frames had all of a graph, and how many had less to keep the budget."""
    counts = [f"{count} frames with {word}" for word, count in zip(["all stages as configured", *budget["words"]], budget["frames"]) if count]
    return f"budget {budget['ms']:g} ms: {', '.join(counts)}" + (" and what is before it" if sum(map(bool, budget["frames"][2:])) else "")


class Warnings(logging.Handler):
    """Collects the warnings of a run, once it is no longer `muted`: the first of each kind is shown when it comes, all are counted at the end."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}
        self.muted = True

    def emit(self, record: logging.LogRecord) -> None:
        if not self.muted:
            kind = str(record.msg)
            if kind not in self.first:
                self.first[kind] = printable(record.getMessage(), 1000)
                print(f"trihedron: warning: {self.first[kind]}", file=sys.stderr)
            self.counts[kind] += 1

    def summarise(self) -> None:
        """Print the count of each kind that came more than once."""
        for kind, count in self.counts.items():
            if count > 1:
                print(f"trihedron: {count} such warnings, the first: {self.first[kind]}", file=sys.stderr)

    def __enter__(self) -> Warnings:
        logger = logging.getLogger("trihedron")
        logger.addHandler(self)
        logger.propagate = False
        return self

    def __exit__(self, *exception: object) -> None:
        logging.getLogger("trihedron").removeHandler(self)
