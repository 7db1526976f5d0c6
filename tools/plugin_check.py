"""The contract test of plugins: what `trihedron check` runs, and the tests for every plugin of this package."""

from __future__ import annotations

import hashlib
import inspect
import io
import logging
import re
import statistics
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.config import compose_run, default_plugins, graph_of
from trihedron.pipeline.core.errors import RecordingError, TrihedronError
from trihedron.pipeline.core.graph import Graph, Stage
from trihedron.pipeline.core.options import OneOf, Range, check_options, constraints_of
from trihedron.pipeline.core.registry import check_value, options_of
from trihedron.pipeline.core.slots import CAMERA, FOLDS, RNG, SLOTS, accepts_none, inputs_of, output_of
from trihedron.pipeline.core.types import LOST, Frame, Pose, Trajectory, Value
from trihedron.pipeline.core.value_checks import check_together, validate_value
from trihedron.pipeline.core.wires import PREVIOUS, Wire
from trihedron.pipeline.record.codec import Encoder
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.run.live import is_camera
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.scheduler import single_threaded_libraries
from trihedron.tools.judged_calls import Call, Figure, figures_of_frames, worst
from trihedron.tools.meanings import meanings_of
from trihedron.tools.new_plugin import TEMPLATE_SENTENCE
from trihedron.tools.plugins import first_sentence

ROOM = ("dataset=synthetic", "dataset.width=320", "dataset.height=240", "dataset.length=8")
BEFORE = 3  # ordinary frames of an adverse scene, from which there are a map and previous values
AFTER = 3  # adverse ones
REPEATS = 10  # noisy ones of one view
SAMPLED = 10  # frames of a data set that are read
SLOWEST_MS = 10_000.0  # a call, beyond which a plugin hangs
NEEDED = {  # slot -> words without which its plugins lack an input, or have nothing to do
    "pose": ("model=tsdf",),
    "map": ("dataset.fps=5", "dataset.length=12"),
    "bundle": ("dataset.fps=5", "dataset.length=12"),
    "loop": ("dataset.fps=5", "dataset.length=120"),
}
SILENT = ("bundle", "loop", "relocalise", "model")  # slots whose plugins may return nothing in a short sequence
LIBRARIES = {"OpenCV": "cv2", "Open3D": "open3d", "COLMAP": "pycolmap", "SciPy": "scipy", "ONNX Runtime": "onnxruntime"}  # in docstrings -> module
CLAUSES = ("What ", "Whether ", "How ", "Of ", "Where ", "Which ", "As ", "Those ")  # no docstring begins with
WORKERS = 4


@dataclass(frozen=True)
class Result:
    """The outcome of one check."""

    name: str
    good: bool
    detail: str
    judged: bool = True  # False where there was nothing to judge

    @property
    def status(self) -> str:
        """A word for the page: "-" is neither a success nor a failure."""
        return ("ok" if self.good else "WRONG") if self.judged else "-"


@dataclass(frozen=True)
class Scene:
    """A short sequence: its values, topic -> one a frame."""

    name: str
    graph: Graph
    values: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Frames:
    """A data set of frames that are there already."""

    frames: tuple[Frame, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def __call__(self, index: int) -> Frame | None:
        """Return a frame."""
        return self.frames[index]

    def truth(self) -> Trajectory | None:
        """None."""
        return None


# Adverse frames: each makes another frame of an ordinary one.


def _noise(frame: Frame) -> Frame:
    rng = np.random.default_rng(frame.index)
    color = rng.integers(0, 256, frame.color.shape).astype(np.uint8)
    return replace(frame, color=color, depth_m=rng.uniform(0.3, 10.0, frame.depth_m.shape).astype(np.float32))


def _one_row(frame: Frame) -> Frame:
    depth = np.zeros_like(frame.depth_m)
    depth[len(depth) // 2] = frame.depth_m[len(depth) // 2]
    return replace(frame, depth_m=depth)


ADVERSE: dict[str, Callable[[Frame], Frame]] = {
    "no depth": lambda frame: replace(frame, depth_m=np.zeros_like(frame.depth_m)),
    "depth that is not finite": lambda frame: replace(frame, depth_m=np.full_like(frame.depth_m, np.nan)),
    "darkness": lambda frame: replace(frame, color=np.zeros_like(frame.color)),
    "nothing at all": lambda frame: replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m)),
    "noise": _noise,
    "one row of depth": _one_row,
    "depth of hundreds of metres": lambda frame: replace(frame, depth_m=frame.depth_m * np.float32(100.0)),
}
REPEATED = "a frame that repeats"
FEW: dict[str, dict[str, str]] = {  # scenes in which other stages find little: slot -> word
    "no features": {"keypoints": "keypoints=none", "lines": "lines=none", "planes": "planes=none", "normals": "normals=none"},
    "one of each feature": {"keypoints": "keypoints.features=1", "lines": "lines.segments=1", "planes": "planes.planes=1"},
}


@dataclass(frozen=True)
class PluginCheck:
    """The checks of one plugin. `words` are overrides, as for `trihedron run`."""

    slot: str
    name: str
    words: tuple[str, ...] = ()
    given: Any = None  # the plugin itself, where it is not registered

    @cached_property
    def plugin(self) -> Any:
        """The plugin with its options. Raises TrihedronError."""
        if self.given is not None:
            return self.given
        outputs = [] if self.slot == "dataset" else [f"outputs=[{self.slot}]"]
        return graph_of(compose_run([f"{self.slot}={self.name}", *outputs, *NEEDED.get(self.slot, ()), *self.words])).stages[self.slot].plugin

    @property
    def summary(self) -> str:
        """The first sentence of its docstring."""
        return first_sentence(inspect.getdoc(type(self.plugin)) or "without a docstring")

    def results(self, quick: bool = False) -> list[Result]:
        """Run the checks. Raises PluginError and ConfigError where the plugin cannot run here: a library or a file that it needs is missing."""
        static = self.static()
        if self.slot == "dataset":
            return [*static, *self._frames()]
        if (failure := self._values()).good is False:
            return [*static, failure]
        checks = [failure, *self.meanings(), self._adverse(), self._inputs(), self._state(), self._threads()]
        checks += [] if quick else [self._processes(), self._replay()]
        return [*static, *checks, self._library(), self._differs(), self._time()]

    def static(self) -> list[Result]:
        """Run the checks that need no call."""
        return [self._check_documentation(), self._options()]

    def digest(self) -> str:
        """SHA-256 of the plugin's values in the room."""
        return hashlib.sha256(b"".join(self._call_on_scene(room(self._upstream)))).hexdigest()

    # The graph that feeds the plugin has the default plugin in its place.

    @property
    def _upstream(self) -> tuple[str, ...]:
        """The words that do not configure this plugin, and those without which its inputs would be missing."""
        return (*NEEDED.get(self.slot, ()), *(word for word in self.words if not word.startswith((f"{self.slot}.", f"{self.slot}="))))

    def _call_on_scene(self, scene: Scene) -> list[bytes]:
        """Bytes of the plugin's values in a scene, frame by frame; its own earlier values are its own."""
        return [encode_value(value) for value in values_of(self.plugin, self.slot, scene)]

    def _check_documentation(self) -> Result:
        kind = type(self.plugin)
        text, comments, ranges = inspect.getdoc(kind) or "", field_comments(kind), constraints_of(kind)
        own = "__doc__" in vars(kind) and text and not text.startswith(f"{kind.__name__}(")
        silent = [
            option.name for option in options_of(kind) if option.name not in comments and option.name not in ranges and _is_number(option.default)
        ]
        if not own or not re.match(r"[A-Z`'\"]", text) or text.startswith(CLAUSES):
            return Result("documented", False, "the class has no docstring that opens with what it does")
        if text.partition("\n")[0] == TEMPLATE_SENTENCE:
            return Result("documented", True, "the docstring is the template's; state what the method computes", judged=False)
        if silent:
            return Result("documented", False, f"neither a range nor a comment: {', '.join(silent)}")
        return Result("documented", True, f"{len(options_of(kind))} options")

    def _options(self) -> Result:
        tried = 0
        for option, value in _out_of_range(type(self.plugin)):
            tried += 1
            try:
                check_options(replace(self.plugin, **{option: value}))
            except (ValueError, TypeError):
                continue
            return Result("options", False, f"{option}={value!r} is out of range and is taken")
        return Result("options", True, f"{tried} values out of range are refused")

    def _frames(self) -> list[Result]:
        """Frames of a data set: read in any order, with stamps in order, of one size, with depth."""
        path = any(word.startswith("dataset.path=") for word in self.words)
        if hasattr(self.plugin, "path") and not path:
            return [Result("frames", True, "not read; give dataset.path=FOLDER", judged=False)]
        if is_camera(self.plugin):
            return [Result("frames", True, "not read: a camera", judged=False)]
        try:
            rows = np.unique(np.linspace(0, len(self.plugin) - 1, SAMPLED).round().astype(int)).tolist()
            frames = [self.plugin(index=k) for k in rows]
            again = [self.plugin(index=k) for k in reversed(rows)][::-1]
            truth = self.plugin.truth()
        except TrihedronError as error:
            return [Result("frames", False, str(error))]
        for row, frame, other in zip(rows, frames, again):
            if not isinstance(frame, Frame) or not isinstance(other, Frame):
                return [Result("frames", False, f"{self._words}: frame {row} of {len(self.plugin)} cannot be read")]
            if encode_value(frame) != encode_value(other):
                return [Result("frames", False, f"{self._words}: frame {row} that is read twice is not the same")]
        found = [Result("frames", True, f"{len(frames)} of {len(self.plugin)} frames, read twice")]
        return [*found, *(self._judge(name, worst(list(figures))) for name, figures in figures_of_frames(frames, truth).items())]

    def _values(self) -> Result:
        scene, found = room(self._upstream), 0
        try:
            for arguments, value in calls_of(self.plugin, self.slot, scene):
                if value is None:
                    continue
                found += 1
                validate_value(self.slot, value, "value")
                check_together({**arguments, self.slot: value}, "value", {})
        except RecordingError as error:
            return Result("values", False, f"{error.cause}, frame {value.index}")
        except TrihedronError:
            raise
        except Exception as error:
            return Result("values", False, f"{type(error).__name__}: {error}")
        calls = 1 if self.slot in FOLDS else len(scene.values)
        silent = found == 0 and self.slot not in SILENT and self.name != "none"
        return Result("values", not silent, f"{found} of {calls} calls gave {output_of(self.slot).__name__}")

    def meanings(self) -> Iterator[Result]:
        """Judge what the slot promises beyond types and shapes, by the truth of rendered frames."""
        if self.name == "none":
            return
        calls: dict[bool, list[Call]] = {}
        for meaning in meanings_of(self.slot):
            scene = repeats(self.slot, self._upstream) if meaning.repeats else room(self._upstream)
            if not isinstance(scene.graph.stages["dataset"].plugin, Synthetic):
                yield Result(meaning.name, True, "needs dataset=synthetic, whose truth is known", judged=False)
                continue
            try:
                if meaning.repeats not in calls:
                    calls[meaning.repeats] = judged_calls(self.plugin, self.slot, scene)
                with np.errstate(all="ignore"):  # a figure that is not finite is outside of its limits
                    figure = worst(list(meaning.check(calls[meaning.repeats])))
            except RecordingError as error:
                yield Result(meaning.name, False, f"{self._words}: {error.cause}")
            except Exception as error:
                yield Result(meaning.name, False, f"{self._words}: {type(error).__name__}: {' '.join(str(error).split())}")
            else:
                yield self._judge(meaning.name, figure)

    def _judge(self, name: str, figure: Figure | None) -> Result:
        if figure is None:
            return Result(name, True, "no value that it could be judged on", judged=False)
        return Result(name, figure.good, str(figure) if figure.good else f"{self._words}: {figure}")

    @property
    def _words(self) -> str:
        return f"{self.slot}={self.name}"

    def _adverse(self) -> Result:
        count = 0
        for scene in adverse(self.slot, self._upstream):
            count += 1
            try:
                for arguments, value in calls_of(self.plugin, self.slot, scene):
                    if value is not None:
                        validate_value(self.slot, value, "value")
                        check_together({**arguments, self.slot: value}, "value", {})
            except RecordingError as error:
                return Result("adverse scenes", False, f"{scene.name}: {error.cause}")
            except Exception as error:
                return Result("adverse scenes", False, f"{scene.name}: {type(error).__name__}: {' '.join(str(error).split())}")
        return Result("adverse scenes", True, f"{count} scenes")

    def _inputs(self) -> Result:
        for arguments, value in calls_of(self.plugin, self.slot, room(self._upstream), watch=True):
            if value == "changed":
                return Result("inputs", False, f"a call changes its inputs: {', '.join(arguments)}")
        return Result("inputs", True, "unchanged")

    def _state(self) -> Result:
        scene = room(self._upstream)
        if self.slot in FOLDS:
            return Result("no hidden state", self._call_on_scene(scene) == self._call_on_scene(scene), "a second fold gives the same bytes")
        calls = [(arguments, encode_value(value)) for arguments, value in calls_of(self.plugin, self.slot, scene) if arguments is not None]
        same = all(encode_value(self.plugin(**_fresh(arguments))) == before for arguments, before in reversed(calls))
        return Result("no hidden state", same, "calls in the opposite order give the same bytes" if same else "calls depend on earlier ones")

    def _threads(self) -> Result:
        scene = room(self._upstream)
        expected = self._call_on_scene(scene)
        with ThreadPoolExecutor(WORKERS) as pool, single_threaded_libraries():
            same = all(found == expected for found in pool.map(lambda _: self._call_on_scene(scene), range(WORKERS)))
        return Result("threads", same, f"{WORKERS} at once give {'the same' if same else 'other'} bytes")

    def _processes(self) -> Result:
        words = [sys.executable, "-m", "trihedron", "check", self.slot, self.name, *self.words, "--digest"]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            return Result("processes", False, (done.stderr.strip().splitlines() or ["failed"])[-1])
        same = done.stdout.split()[-1] == self.digest()
        return Result("processes", same, f"another one gives {'the same' if same else 'other'} bytes")

    def _replay(self) -> Result:
        from trihedron.pipeline.app.cli import run_once

        given = [f"{self.slot}={self.name}", f"outputs=[trajectory,{self.slot}]", f"record.topics=[{self.slot}]", *self._upstream, *self.words]
        with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            try:
                run_once([*ROOM, *given, f"out={folder}/run"], time.perf_counter())
                only = [f"replay={folder}/run/run.mcap", f"only=[{self.slot}]", f"record.topics=[{self.slot}]", f"out={folder}/again"]
                run_once(only, time.perf_counter())
            except TrihedronError as error:
                return Result("replay", False, str(error))
            first, second = ([encode_value(v) for v in _topic(Path(folder) / run / "run.mcap", self.slot)] for run in ("run", "again"))
        if not first and not second:
            return Result("replay", True, "no value to compare", judged=False)
        return Result("replay", first == second, f"{len(first)} values are {'the same' if first == second else 'others'}")

    @property
    def _named_modules(self) -> list[str]:
        """Modules of the libraries that the docstring names."""
        text = inspect.getdoc(type(self.plugin)) or ""
        return [module for name, module in LIBRARIES.items() if re.search(rf"Librar(y|ies): [^.]*{name}", text)]

    def _library(self) -> Result:
        named = self._named_modules
        if not named:
            return Result("library", True, "none is named")
        scene, called = room(self._upstream), set[str]()
        with modules_called(called):
            found = values_of(self.plugin, self.slot, scene)
        missing = [module for module in named if module not in called]
        if missing and self.slot in SILENT and not any(value is not None for value in found):
            return Result("library", True, f"no value, and no call of {', '.join(missing)}", judged=False)
        return Result("library", not missing, f"{', '.join(missing)} is named and not called" if missing else f"{', '.join(named)} called")

    def _differs(self) -> Result:
        default = default_plugins().get(self.slot)
        if default == self.name:
            return Result("differs", True, "it is the default")
        scene = room(self._upstream)
        plugin = graph_of(compose_run([f"outputs=[{self.slot}]", *self._upstream])).stages[self.slot].plugin
        pairs = list(zip(values_of(self.plugin, self.slot, scene), values_of(plugin, self.slot, scene)))
        pairs = [(a, b) for a, b in pairs if a is not None or b is not None]
        differing = sum(encode_value(a) != encode_value(b) for a, b in pairs)
        if differing:
            return Result("differs", True, f"from {default} in {differing} of {len(pairs)} values")
        if not pairs:
            return Result("differs", True, f"no value of it or of {default} to compare", judged=False)
        good = not self._named_modules or self.slot in SILENT  # other methods may agree in a plain room
        return Result("differs", good, f"all {len(pairs)} values are those of {default}, the default", judged=not good)

    def _time(self) -> Result:
        scene, spent = room(self._upstream), list[float]()
        for _ in calls_of(self.plugin, self.slot, scene, spent=spent):
            pass
        median, most = 1e3 * statistics.median(spent), 1e3 * max(spent)
        return Result("time", most < SLOWEST_MS, f"{median:.1f} ms a call (median; {most:.1f} at most)")


# Scenes, computed once in a process.


@lru_cache(maxsize=64)
def room(words: tuple[str, ...]) -> Scene:
    """The room, seen by the default graph with these words."""
    return _scene("room", words, None)


@lru_cache(maxsize=8)
def repeats(slot: str, words: tuple[str, ...]) -> Scene:
    """Noisy repeats of one view of the room, as far as the slot's inputs need it."""
    return _scene("repeats", (*words, "dataset.scene=room", "dataset.motion=still", f"dataset.length={REPEATS}"), None)


def adverse(slot: str, words: tuple[str, ...]) -> Iterator[Scene]:
    """The adverse scenes."""
    yield from (_changed_scene(name, words) for name in (*ADVERSE, REPEATED))
    for name, few in FEW.items():
        free = [word for of, word in few.items() if of != slot and not any(given.startswith((f"{of}=", f"{of}.")) for given in words)]
        yield replace(room((*words, f"dataset.length={BEFORE}", *free)), name=name)


@lru_cache(maxsize=64)
def _changed_scene(name: str, words: tuple[str, ...]) -> Scene:
    """The room whose last frames are changed."""
    ordinary = tuple(value["dataset"] for value in room(words).values)
    if name == REPEATED:
        return _scene(name, words, tuple(replace(ordinary[0], index=f.index, stamp_ns=f.stamp_ns) for f in ordinary[:AFTER]))
    return _scene(name, words, (*ordinary[:BEFORE], *(ADVERSE[name](frame) for frame in ordinary[BEFORE : BEFORE + AFTER])))


def _scene(name: str, words: tuple[str, ...], frames: tuple[Frame, ...] | None) -> Scene:
    """Run the default graph, without folds, on the room or on other frames."""
    config = compose_run([*ROOM, *words])
    config.outputs = [topic for topic in config.graph if topic not in FOLDS and config.get(topic) is not None and topic in SLOTS]
    graph = graph_of(config)
    if frames is not None:
        graph = Graph({**graph.stages, "dataset": replace(graph.stages["dataset"], plugin=Frames(frames))}, graph.outputs)
    with mute_warnings():
        return Scene(name, graph, tuple(dict(step.values) for step in Runner(graph, threads=1).steps(None, frozenset())))


# Calls of a plugin on the values of a scene.


def values_of(plugin: Any, slot: str, scene: Scene) -> list[Any]:
    """The plugin's values: one a frame, or the single one of a fold."""
    return [value for _, value in calls_of(plugin, slot, scene)]


def calls_of(plugin: Any, slot: str, scene: Scene, watch: bool = False, spent: list[float] | None = None) -> Iterator[tuple[Any, Any]]:
    """Call the plugin in order: (arguments, value) of each call, None for both where an input that it requires is missing.

    With `watch` the value is "changed" where a call changed its inputs; `spent` takes the seconds of each call."""
    stage = _stage(plugin, slot, scene)
    own: list[Any] = []
    state = plugin.start() if slot in FOLDS else None
    with single_threaded_libraries():
        for position in range(len(scene.values)):
            arguments = _arguments(stage, slot, scene, position, own)
            value = None
            if arguments is not None:
                before = [encode_value(item) for item in arguments.values()] if watch else []
                began = time.perf_counter()
                if slot in FOLDS:
                    state = plugin.add(state, **_fresh(arguments))
                else:
                    value = plugin(**_fresh(arguments))
                if spent is not None:
                    spent.append(time.perf_counter() - began)
                if value is not None:
                    check_value(slot, value, _index(scene, position))
                own.append(value)
                if watch and before != [encode_value(item) for item in arguments.values()]:
                    yield arguments, "changed"
                    continue
            else:
                own.append(None)
            if slot not in FOLDS:
                yield (arguments, value) if arguments is not None else (None, None)
        if slot in FOLDS:
            maps = [value["map"] for value in scene.values if value.get("map") is not None]
            yield {}, plugin.finish(state, maps[-1] if maps else None)


def judged_calls(plugin: Any, slot: str, scene: Scene) -> list[Call]:
    """The calls that gave a value, with the truth of a synthetic scene."""
    data, found, map = scene.graph.stages["dataset"].plugin, list[Call](), None
    for position, value in enumerate(values_of(plugin, slot, scene)):
        at = len(scene.values) - 1 if slot in FOLDS else position
        topics, previous = scene.values[at], scene.values[at - 1] if at else {}
        if value is not None and isinstance(topics.get("dataset"), Frame):
            found.append(Call(value, topics["dataset"], topics, previous, map, data, at))
        map = topics["map"] if topics.get("map") is not None else map
    return found


def _stage(plugin: Any, slot: str, scene: Scene) -> Stage:
    """The plugin as a stage of the scene's graph."""
    from trihedron.pipeline.core.graph import build_graph

    plugins = {name: stage.plugin for name, stage in scene.graph.stages.items()}
    return build_graph({**plugins, slot: plugin}, [slot]).stages[slot]


def _arguments(stage: Stage, slot: str, scene: Scene, position: int, own: list[Any]) -> dict[str, Any] | None:
    """The inputs of one call by the stage's wires; None where a required one is missing."""
    index = _index(scene, position)
    hints, arguments = inputs_of(slot), dict.fromkeys(stage.absent)
    for parameter, wire in stage.inputs.items():
        topic = own if wire.topic == slot else [value.get(wire.topic) for value in scene.values]
        value = _delayed_value(topic, wire, position)
        if value is None and (parameter == CAMERA or not accepts_none(hints[parameter])):
            return None
        if slot == "relocalise" and isinstance(value, Pose) and position >= BEFORE:
            value = replace(value, status=LOST)  # for which the slot is there
        arguments[parameter] = value.camera if parameter == CAMERA else value
    if stage.wants_rng:
        arguments[RNG] = [0, index, zlib.crc32(slot.encode())]
    return arguments


def _delayed_value(topic: list[Any], wire: Wire, position: int) -> Any:
    if wire.delay == PREVIOUS:
        return next((value for value in reversed(topic[:position]) if value is not None), None)
    return topic[position - wire.delay] if position >= wire.delay else None


def _fresh(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments with a generator of random numbers that nothing was drawn from."""
    return {name: np.random.default_rng(value) if name == RNG else value for name, value in arguments.items()}


def _index(scene: Scene, position: int) -> int:
    frame = scene.values[position].get("dataset")
    return frame.index if isinstance(frame, Frame) else position


def encode_value(value: Any) -> bytes:
    """A value as the bytes of a recording; anything else by its text."""
    return Encoder().encode(value) if isinstance(value, Value) else repr(value).encode()


def _topic(path: Path, slot: str) -> list[Any]:
    recording = Recording(str(path))
    return list(recording.values(slot)) if slot in recording.topics else []


def _is_number(default: Any) -> bool:
    return isinstance(default, (int, float)) and not isinstance(default, bool)


def _out_of_range(kind: type[Any]) -> Iterator[tuple[str, Any]]:
    """(option, value) for each bound of an option."""
    for option, constraints in constraints_of(kind).items():
        for constraint in constraints:
            if isinstance(constraint, Range):
                bounds = ((constraint.low, -1), (constraint.high, 1), (constraint.above, 0), (constraint.below, 0))
                yield from ((option, bound + step) for bound, step in bounds if bound is not None)
            elif isinstance(constraint, OneOf):
                yield option, "none of them"


@contextmanager
def mute_warnings() -> Iterator[None]:
    """Within this the program's warnings, which adverse frames deserve, are not shown."""
    logger = logging.getLogger("trihedron")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


class modules_called:
    """Context within which the top-level modules whose functions this thread calls are added to a set."""

    def __init__(self, found: set[str]) -> None:
        self._found = found

    def __enter__(self) -> None:
        sys.setprofile(self._profile)

    def __exit__(self, *exception: object) -> None:
        sys.setprofile(None)

    def _profile(self, frame: Any, event: str, function: Any) -> None:
        if event == "call":
            name = frame.f_globals.get("__name__")
        elif event == "c_call":
            name = getattr(function, "__module__", None) or type(getattr(function, "__self__", None)).__module__
        else:
            return
        if isinstance(name, str):
            self._found.add(name.split(".")[0])
