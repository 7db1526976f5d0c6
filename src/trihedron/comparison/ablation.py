"""Ablations: alternatives of recorded runs, their figures, and the files of both."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison import ablation_tables as tables
from trihedron.comparison.ablation_tables import NEES, RESULT, Case, Variant
from trihedron.comparison.attribution import nees_of
from trihedron.comparison.fold_measures import of_folds
from trihedron.comparison.frame_errors import Errors, errors_file, of_result, read_errors, write_errors
from trihedron.comparison.partings import Parting, StageErrors, changed_by_code, reference_of
from trihedron.comparison.swaps import Combination, combinations_of, folder_name, parse_swaps, single_swaps, without_repeats
from trihedron.pipeline.app.alternatives import Alternatives, Outcome, alternatives_of
from trihedron.pipeline.app.execute import MAX_THREADS
from trihedron.pipeline.core.config import Feedback
from trihedron.pipeline.core.errors import ConfigError, DataError, TrihedronError, UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.slots import FOLDS
from trihedron.pipeline.record.mcap_file import RECORDING, recording_file
from trihedron.pipeline.record.reader import Recording, TopicReader
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.pipeline.run.replay import RECORDED
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import with_unpacked_poses
from trihedron.pipeline.sweep.jobs import key_of

PICTURE = "differs.png"
ERRORS = {  # column -> key of the final metrics, factor
    "ATE mm": ("ate_rmse_m", 1e3),
    "RPE 1 frame mm": ("rpe_frame_rmse_m", 1e3),
    "RPE 1 s mm": ("rpe_second_rmse_m", 1e3),
    "RPE 1 s deg": ("rpe_second_rmse_deg", 1.0),
}
SETTINGS = ("out", "feedback", "threads")


@dataclass(frozen=True)
class Options:
    """The recordings, the swaps, and the settings of an ablation."""

    recordings: tuple[Path, ...]
    swaps: tuple[str, ...]
    out: Path
    feedback: Feedback = Feedback.new
    threads: int = 2
    budget: bool = False
    pictures: bool = True  # of the worst frame of each alternative


@dataclass(frozen=True)
class Work:
    """The alternatives of one recording, their folders with the prefix of the recording, the key of their figures, and the errors of their frames:
    None where these are to compute."""

    computing: Alternatives
    combinations: Sequence[Combination]
    prefix: str
    folders: Sequence[Path]
    key: str
    errors: list[Errors] | None


def options_of(words: Sequence[str], budget: bool = False) -> Options:
    """Sort words into recordings, swaps and settings. A run folder whose name has an equals sign, as those of an ablation have, is one with its path:
    `runs/axes/manhattan=mixture`, `./manhattan=mixture`. Raises UsageError, and DataError for a recording that is not there."""
    recordings = [word for word in words if "=" not in word or Path(word).is_file() or ("/" in word and Path(word).is_dir())]
    rest = [word for word in words if word not in recordings]
    settings = {key: value for key, _, value in (word.partition("=") for word in rest) if key in SETTINGS}
    swaps = tuple(word for word in rest if word.partition("=")[0] not in SETTINGS)
    if not recordings:
        raise UsageError("ablate", "no recording is given", "give RUN.mcap first")
    if budget and len(recordings) > 1:
        raise UsageError("--budget", f"is of one run, and {len(recordings)} recordings are given", "give one of them")
    if not swaps:
        raise UsageError("ablate", "nothing is swapped", "give STAGE=PLUGIN,PLUGIN or STAGE.OPTION=VALUE,VALUE")
    paths = tuple(recording_file(Path(word).expanduser()) for word in recordings)
    if (missing := next((path for path in paths if not path.exists()), None)) is not None:
        raise DataError(str(missing), "there is no such recording", "give RUN.mcap or a run folder")
    if not settings.get("out"):
        raise UsageError("out", "is not given", "give out=DIR for the alternatives")
    feedback = settings.get("feedback", Feedback.new.name)
    if feedback not in Feedback.__members__:
        raise UsageError("feedback", f"is '{feedback}'", did_you_mean(feedback, Feedback.__members__))
    threads = settings.get("threads", "2")
    if not threads.isdigit() or not 1 <= int(threads) <= MAX_THREADS:
        raise ConfigError("threads", f"{threads} is not a number of threads", f"give 1 to {MAX_THREADS}")
    return Options(paths, swaps, Path(settings["out"]).expanduser(), Feedback[feedback], int(threads), budget)


def ablate(options: Options) -> list[Case]:
    """Compute what is missing of an ablation; returns the figures of every recording. Raises TrihedronError."""
    known, keys, cases = known_cases(options.out), [], []
    for number, work in enumerate(works_of(options, known), 1):
        recording = work.computing.recording
        if work.errors is not None:
            print(f"{recording.path}: done already", file=sys.stderr)
            case = tables.case_from_dict(known[work.key])
            for variant, one in zip(case.variants, work.errors):
                variant.errors = one
        else:
            print(f"{recording.path} ({number} of {len(options.recordings)}): {len(work.combinations)} alternatives", file=sys.stderr)
            case = _compute_case(work.computing, work.combinations, work.folders)
            if options.pictures and "manhattan" in case.stages and options.feedback is Feedback.recorded:
                _draw_axes(options.out, work)
            if options.budget:
                case.budget, case.remarks = _budget(recording)
            write_errors(errors_file(options.out, work.key), [variant.errors for variant in case.variants])
        case.swaps, case.feedback, case.recorded = list(options.swaps), options.feedback.name, _state(recording.path)
        cases.append(case)
        keys.append(work.key)
        _write(options.out, {**known, **dict(zip(keys, map(tables.case_to_dict, cases)))})
    for key, other in known.items():
        if key not in keys:
            print(f"{options.out}: keeps what it holds of {other['recording']} besides: {' '.join(other.get('swaps', []))}", file=sys.stderr)
    if options.pictures:
        _draw_farthest(cases)
    _write(options.out, {**known, **dict(zip(keys, map(tables.case_to_dict, cases)))})
    return cases


def works_of(options: Options, known: Mapping[str, Any]) -> Iterator[Work]:
    """Compose the alternatives of one recording after the other; `known` has the figures in out=DIR by key."""
    recordings = [Recording(path) for path in options.recordings]
    swaps = without_repeats(parse_swaps(options.swaps), recordings)
    combinations = single_swaps(swaps) if options.feedback is Feedback.recorded else combinations_of(swaps)
    for recording, prefix in zip(recordings, _prefixes(options.recordings)):
        alternatives = alternatives_of(recording, [combination.words for combination in combinations])
        computing = Alternatives(recording, alternatives, options.feedback, options.threads)
        key = _key(recording, computing, options)
        errors = read_errors(errors_file(options.out, key), len(combinations)) if key in known else None
        folders = [options.out / folder_name(prefix, combination) for combination in combinations]
        _check_folders(options.out, folders, recording, known.values())
        yield Work(computing, combinations, prefix, folders, key, errors)


def _check_folders(out: Path, folders: Sequence[Path], recording: Recording, known: Iterable[Mapping[str, Any]]) -> None:
    """Raise DataError where the folders hold alternatives of another recording, or the outer one is that of a run."""
    if (out / RECORDING).exists():
        raise DataError(str(out), "is the folder of a run", "give another out=DIR")
    for case in known:
        if not _is_of(case, recording) and not {str(folder) for folder in folders}.isdisjoint(one["folder"] for one in case["variants"]):
            raise DataError(str(out), f"holds the ablation of {case['recording']}", "give another out=DIR")


def _is_of(case: Mapping[str, Any], recording: Recording) -> bool:
    return Path(case["recording"]).resolve() == recording.path.resolve()


def _state(recording: Path) -> str:
    """Size and time of a recording, which change when it is made anew."""
    found = recording.stat()
    return f"{found.st_size} {found.st_mtime_ns}"


def _prefixes(paths: Sequence[Path]) -> list[str]:
    """Tell the folders of several recordings apart: the names of their runs, or numbers."""
    if len(paths) == 1:
        return [""]
    names = [path.resolve().parent.name for path in paths]
    return names if len(set(names)) == len(names) else [str(number) for number in range(len(paths))]


def _key(recording: Recording, computing: Alternatives, options: Options) -> str:
    """Hash of all that the figures depend on."""
    parts = [str(recording.path.resolve()), _state(recording.path), options.feedback.name, options.budget]
    configs = [key_of(alternative.config) for alternative in computing.alternatives]
    return hashlib.sha256(json.dumps([*parts, *configs, str(options.out.resolve())]).encode()).hexdigest()


def known_cases(out: Path) -> Mapping[str, Any]:
    """Return the cases that are in an ablation's folder already, by key, without those of which a run folder is missing or the recording was made
    anew."""
    known = read_results(out / RESULT)
    return {key: case for key, case in known.items() if all(Path(one["folder"]).is_dir() for one in case["variants"]) and not _is_stale(case)}


def _is_stale(case: Mapping[str, Any]) -> bool:
    path = Path(case["recording"])
    return bool(case.get("recorded")) and path.exists() and case["recorded"] != _state(path)


def _write(out: Path, cases: Mapping[str, Any]) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_file(out / RESULT, json.dumps(cases, indent=2) + "\n")
    except OSError as error:
        raise DataError(str(out), f"cannot be written: {error.strerror}", "give another out=DIR") from error


def _compute_case(computing: Alternatives, combinations: Sequence[Combination], folders: Sequence[Path]) -> Case:
    """Compute all alternatives of a recording."""
    recording, graphs = computing.recording, [alternative.graph for alternative in computing.alternatives]
    topics = [name for name in graphs[0].stages if name in computing.stages]
    alone = computing.feedback is Feedback.recorded
    known, true = reference_of(recording) if alone else ({}, True)
    measured = [name for name in topics if name not in FOLDS] if alone else []
    of_nodes: dict[str, StageErrors] = {}  # by the node that computes a stage, for one alternative or several
    partings = [Parting() for _ in folders]
    images = TopicReader(recording, "dataset").at if alone and "dataset" in recording.topics else lambda index: None

    def on_frame(index: int, values: Sequence[Mapping[str, Any]]) -> None:
        embedded = {RECORDED + "dataset": image} if (image := images(index)) is not None else {}
        for one, parting in zip(values, partings):
            parting.compare(index, topics, values[0], one)
        computed = {nodes[topic]: (topic, one) for nodes, one in zip(computing.node_of, values) for topic in measured if topic in nodes}
        for node, (topic, one) in computed.items():
            of_nodes.setdefault(node, StageErrors(known)).take(topic, {**embedded, **one})

    computing.run(folders, on_frame)
    errors = [StageErrors.merge_stages([of_nodes[nodes[topic]] for topic in measured if topic in nodes]) for nodes in computing.node_of]
    of_stages = [found.of_frames() for found in errors]
    own = [found.figures(of_frames) if alone else {} for found, of_frames in zip(errors, of_stages)]
    folds = of_folds(topics, folders, recording.path)
    figures = [{**_alternative_figures(outcome), **of_stage, **of_fold} for outcome, of_stage, of_fold in zip(computing.outcomes, own, folds)]
    reference = attached_truth(recording.attachments, str(recording.path))
    judged = [
        {
            **of_result(with_unpacked_poses(runner.result), reference if outcome.metrics.get("final") else None, ERRORS),
            **of_frames,
            "ms": outcome.frame_ms,
        }
        for runner, outcome, of_frames in zip(computing.runners, computing.outcomes, of_stages)
    ]
    full_s = read_results(recording.path.parent / "timing.json").get("cpu_s")
    variants = [
        Variant(combination, str(folder), one, outcome.stages_s, outcome.total_s, outcome.rest_s, parting, errors=of_frames)
        for combination, folder, one, outcome, parting, of_frames in zip(combinations, folders, figures, computing.outcomes, partings, judged)
    ]
    case = Case(
        str(recording.path),
        computing.runners[0].count,
        topics,
        list(computing.shared),
        full_s or np.nan,
        computing.cpu_s,
        variants,
        changed_by_code(recording, Recording(folders[0] / RECORDING)),
        fps=computing.runners[0].result.fps,
        true=true,
    )
    if case.changed:
        print(f"trihedron: warning: {recording.path} was recorded by other code: as recorded gives another {case.changed}", file=sys.stderr)
    return case


def _alternative_figures(outcome: Outcome) -> dict[str, float]:
    """Figures of an alternative by column, NaN where there is none."""
    final, status = outcome.metrics.get("final") or {}, outcome.metrics.get("status") or {}
    figures = _errors(final)
    if status:
        figures["ok %"] = 100.0 * status["ok"] / max(1, outcome.metrics["frames"])
    if (nees := nees_of(outcome.metrics)) is not None:
        figures[NEES] = nees
    return {**figures, "ms": float(outcome.frame_ms.mean())}


def _errors(final: Mapping[str, Any]) -> dict[str, float]:
    """Columns of the metrics of a trajectory, NaN where there are none."""
    return {name: factor * final[key] if final.get(key) is not None else np.nan for name, (key, factor) in ERRORS.items()}


def _budget(recording: Recording) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Errors with the truth in the place of stages, by their names, and sentences on those that mean nothing; empty where it cannot be judged."""
    from trihedron.comparison.error_budget import remarks, reruns

    try:
        found = reruns(recording)
    except TrihedronError as error:
        print(f"no error budget: {error}", file=sys.stderr)
        return {}, []
    return {" + ".join(stages): _errors(one.metrics) for stages, one in found.items()}, remarks(found)


def _draw_axes(out: Path, work: Work) -> None:
    """Draw the errors of all estimators of the Manhattan frame, and their axes on the sphere, where there is ground truth."""
    from trihedron.comparison.axes import common_world, draw, read_runs

    try:
        runs = read_runs(out, work.folders)
        world = common_world(runs)
        files = draw(runs, world, [run.errors_deg(world) for run in runs], out, work.prefix and f"{work.prefix},")
        print(f"drawn: {', '.join(map(str, files))}", file=sys.stderr)
    except DataError as error:
        print(f"no pictures of the axes: {error}", file=sys.stderr)


def _draw_farthest(cases: Sequence[Case]) -> None:
    """Draw the worst frame of each alternative, in the recording where it is farthest from the recorded configuration."""
    from trihedron.comparison.pictures import draw_pair

    for number in range(1, len(cases[0].variants)):
        case, variant = tables.farthest([(case, case.variants[number]) for case in cases])
        if variant.picture or variant.parting.worst is None:
            continue
        original, base = Recording(case.recording), Recording(Path(case.variants[0].folder) / RECORDING)
        out, own = Path(variant.folder) / PICTURE, Recording(Path(variant.folder) / RECORDING)
        draw_pair([("as recorded", [base, original]), (variant.combination.label, [own, original])], variant.parting.worst, out)
        variant.picture = str(out)
