"""SLAM as an object: push frames, read the pose and every topic, save.

The graph of the command line runs in a thread of its own on the frames that are pushed. The same frames with the same stamps give the same bytes on
every topic as a run over a folder.
"""

from __future__ import annotations

import atexit
import copy
import functools
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

from trihedron.buildings import Building
from trihedron.camera import Camera
from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.images import Frames, stamp_of
from trihedron.pipeline.app.budgets import budget_of
from trihedron.pipeline.app.compilation import compile_once
from trihedron.pipeline.app.execute import check_settings, metadata_of, recorded_topics, remembered_of, source_of, write_files, write_models
from trihedron.pipeline.app.viewers import Viewer, opened_viewer
from trihedron.pipeline.core import types
from trihedron.pipeline.core.config import RerunView, check_added, compose_run, graph_of
from trihedron.pipeline.core.errors import ConfigError, UsageError, did_you_mean
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.types import FrameReference, Map, Surface, Value
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.mcap_writer import new_recording
from trihedron.pipeline.record.rescue import recover
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run import results
from trihedron.pipeline.run.budget import EFFORT_TOPIC, Budget
from trihedron.pipeline.run.map_file import save_map
from trihedron.pipeline.run.replay import TOPICS
from trihedron.pipeline.run.run_folder import claim_folder, write_configuration
from trihedron.pipeline.run.runner import Runner, Step
from trihedron.pipeline.run.sinks import MemorySink, Sink
from trihedron.pipeline.run.warm_up import WARM_UP_FRAMES, compilation_reported, warm_up_budgeted
from trihedron.trajectory import Trajectory
from trihedron.words import words_of

REFUSED = ("replay", "only", "live", "real_time", "save_map", "calibrate", "sequences")  # root keys of a run that make no sense for pushed frames
WARM_UP_PX = 640  # the largest width of the images of the warm-up
P = ParamSpec("P")
R = TypeVar("R")


def _of_one_thread(method: Callable[Concatenate[Slam, P], R]) -> Callable[Concatenate[Slam, P], R]:
    """Refuse a call while another thread is within one (decorator): each would wait for the other's frame."""

    @functools.wraps(method)
    def call(self: Slam, /, *args: P.args, **kwargs: P.kwargs) -> R:
        if not self._caller.acquire(blocking=False):
            raise UsageError("Slam", "another thread is using it", "make one Slam for each thread, or hold a lock of your own around all calls")
        try:
            return method(self, *args, **kwargs)
        finally:
            self._caller.release()

    return call


class Slam:
    """Track a camera frame by frame.

    One thread at a time uses it, another gets an error at once; several threads may each have their own. Used as a context manager it is closed at
    the end of the block. Constructing compiles what is not compiled yet, and a message names it. While one is open, OpenCV and BLAS use one thread in
    this process.

    Args:
        camera: intrinsics of both images, which are registered; a camera file's distortion and unit of depth are applied.
        overrides: words of the command line, as "manhattan.cone_deg=8" or "graph=points".
        out: a folder to which the recording is streamed, and in which `close` writes trajectory, times and surface, as `out=` of the command line.
        history: number of frames whose images and values `save` writes where there is no `out`; at least 1.
        options: root keys and plugins by name, as `manhattan="mean_shift"`, `threads=2`, `outputs=["surface"]`.

    Raises:
        DataError: `camera` is none, or another run writes to the folder `out`.
        UsageError: a word is no override, or makes no sense for pushed frames, as that of a data set.
        ConfigError: a key, plugin or option is unknown, an option out of range, or the folder cannot be written.
        GraphError: the wires of the graph do not fit together.

    Examples:
        The images of a synthetic room stand for those of a camera.

        >>> import trihedron as th
        >>> room = th.dataset.synthetic(length=6, width=160, height=120)
        >>> with th.Slam(room(0).camera, manhattan="mean_shift", outputs=["trajectory", "surface"]) as slam:
        ...     for number in range(6):
        ...         frame = room(number)
        ...         pose = slam.track(frame.color, frame.depth_m, frame.stamp_ns / 1e9)
        ...     slam.save("run.mcap")
        >>> pose.status
        'ok'
        >>> len(slam.trajectory), len(slam.mesh().triangles) > 100
        (6, True)
        >>> th.Recording("run.mcap").frames
        (0, 1, 2, 3, 4, 5)
    """

    def __init__(self, camera: types.Camera | Calibration, *overrides: str, out: str | Path | None = None, history: int = 10, **options: Any) -> None:
        began = time.perf_counter()
        self._frames = Frames(Camera.of(camera))
        words = words_of(overrides, options)
        _check_words(words)
        self._config = compose_run(["dataset=pushed", *words])
        self._words = words
        check_settings(self._config)
        graph = graph_of(self._config)
        self._queue = graph.stages["dataset"].plugin.queue
        self._caller, self._changed = threading.RLock(), threading.Condition()
        self._closing = threading.Lock()
        self._values: dict[str, dict[int, Value | None]] = {name: {} for name in graph.stages}  # stage -> position -> value
        self._last = -1  # position of the last frame pushed
        self._settled = -1  # and of the last one with which all stages are done
        self._last_ns: int | None = None
        self._plan: tuple[int, Building | None] = 0, None  # the last one returned, and the time of the last frame then
        self._failure: BaseException | None = None
        self._ended = self._closed = False
        self._earlier = False  # whether `out` is the folder of an earlier run
        self._topics = recorded_topics(self._config, graph, None)
        self._memory = MemorySink(max(history, 1) if out is None else 1, {"dataset", EFFORT_TOPIC} | self._topics)
        self._stack = ExitStack()
        self._writer: RecordingWriter | None = None
        self._out = Path(out).expanduser().absolute() if out is not None else None
        try:
            viewer = self._stack.enter_context(opened_viewer(self._config))
            initial, period, budget = remembered_of(self._config, graph), viewer.preview_period, budget_of(self._config, graph)
            self._runner = Runner(
                graph, self._config.seed, self._config.threads, None, "", initial, on_value=self._note, preview_period=period, budget=budget
            )  # fmt: skip
            self._sinks: tuple[Sink, ...] = (self._memory, *viewer.sinks)
            self._open(graph, viewer, budget)
        except BaseException:
            self._stack.close()
            raise
        self._began, self._started = began, time.perf_counter()
        self._thread = threading.Thread(target=self._work, name="trihedron", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def _open(self, graph: Graph, viewer: Viewer, budget: Budget | None) -> None:
        """Open the run folder and its recording, then compile and load what the first frames need."""
        if self._out is not None:
            self._config.out = str(self._out)
            self._earlier = self._stack.enter_context(claim_folder(self._out, self._config, self._runner.computed))
            write_configuration(self._out, self._config, self._words)
        compile_once(self._runner.computed, None)
        with compilation_reported():
            warm_up_budgeted(functools.partial(Runner, _on_synthetic_images(graph, self.camera), self._config.seed, self._config.threads), budget)
        if self._out is not None or viewer.server is not None:
            file = self._out / RECORDING if self._out is not None else None
            self._writer = RecordingWriter(file, self._metadata(), viewer.server)
            self._stack.callback(self._writer.close)

    @property
    def camera(self) -> Camera:
        """The camera whose images are pushed."""
        return self._frames.camera

    @_of_one_thread
    def track(self, rgb: Any, depth: Any, t: float) -> Any:
        """Track one frame and return its `Pose`; slow stages, such as bundle adjustment, may still work on it. A graph without the stage `pose`
        gives the value of its last stage.

        Args:
            rgb: (h, w, 3) uint8, red first; copied. None: this frame has no colour image, and is tracked as one of a run whose colour is missing.
            depth: (h, w) float metres or uint16 divided by the camera's `depth_scale`, 0 where there is none; copied. None: this frame has no depth.
            t: seconds, later than that of the frame before.

        Returns:
            The `Pose`: `T_world_camera` (4, 4), where the world is the frame of the first camera, with covariance and status.

        Raises:
            DataError: an argument does not fit; it names it.
            UsageError: the object is closed, or another thread is using it.
            StageError: a stage failed, at this frame or one before.

        Examples:
            >>> import trihedron as th
            >>> room = th.dataset.synthetic(length=2, width=160, height=120)
            >>> with th.Slam(room(0).camera) as slam:
            ...     poses = [slam.track(room(k).color, room(k).depth_m, room(k).stamp_ns / 1e9) for k in range(2)]
            ...     coefficients = slam.values["planes"].coefficients
            >>> poses[1].T_world_camera.shape, poses[1].covariance.shape, coefficients.shape[1]
            ((4, 4), (6, 6), 4)
            >>> float(abs(poses[0].T_world_camera[:3, 3]).max())  # the world begins at the first camera
            0.0
        """
        self._check_open()
        stamp_ns = stamp_of(t, self._last_ns)
        frame = self._frames(self._last + 1, stamp_ns, rgb, depth)
        with self._changed:
            for values in self._values.values():
                values.clear()
            self._last, self._last_ns = frame.index, stamp_ns
        self._queue.push(frame)
        return self._value("pose" if "pose" in self._values else list(self._values)[-1])

    @property
    def values(self) -> Values:
        """The values of the last frame by topic, as `slam.values["planes"]`; None where a stage wrote nothing."""
        return Values(self._values, self._read)

    @property
    @_of_one_thread
    def map(self) -> Map | None:
        """The map after the last frame; None before there is one."""
        self._settle()
        return self._runner.result.map

    @property
    @_of_one_thread
    def trajectory(self) -> Trajectory:
        """The poses of all tracked frames, relative to the keyframes of the map as it is now."""
        self._settle()
        return Trajectory.of(results.final_trajectory(self._runner.result))

    @property
    @_of_one_thread
    def causal_trajectory(self) -> Trajectory:
        """The poses of all tracked frames as they were estimated at the time."""
        self._settle()
        return Trajectory.of(results.causal_trajectory(self._runner.result))

    def mesh(self) -> Surface:
        """Return the surface so far, in the world frame.

        Raises:
            ConfigError: `surface` is not among the outputs.
        """
        surface: Surface = self._fold("surface")
        return surface

    @_of_one_thread
    def building(self, max_age_s: float = 1.0) -> Building:
        """Return the plan of the building so far: before `close`, of some of the keyframes only.

        Args:
            max_age_s: until a frame that is so much later, in seconds of the frames' times, the last plan is returned again, which costs no time; 0
                makes each anew.

        Returns:
            The plan; the final one after `close`.

        Raises:
            ConfigError: `building` is not among the outputs.
        """
        last_ns = self._last_ns or 0
        made_ns, plan = self._plan
        if plan is None or self._closed or last_ns - made_ns >= 1e9 * max_age_s:
            plan = Building(self._fold("building", preview=True))
            self._plan = last_ns, plan
        return plan

    @_of_one_thread
    def _fold(self, name: str, preview: bool = False) -> Any:
        """Return the result of a fold, or what it has so far: as a viewer sees it if `preview`, which is quicker."""
        if name not in self._values:
            raise ConfigError("outputs", f"has no {name}, so none is made", f'give outputs=["trajectory", "{name}"]')
        self._settle()
        finished = self._runner.result.folds.get(name)
        if finished is None:
            plugin, state = self._runner.graph.stages[name].plugin, self._runner.fold_state(name)
            finished = (
                plugin.preview(state) if preview and hasattr(plugin, "preview") else plugin.finish(copy.deepcopy(state), self._runner.result.map)
            )
        return finished

    @_of_one_thread
    def show(self, port: int = RerunView.port, web_port: int = RerunView.web_port) -> None:
        """Show the run in rerun, as `view=rerun view.web=true` does: a page of this machine, whose address is printed. It has what there is now, then
        each further frame until `close`.

        Args:
            port: of the data.
            web_port: of the page.

        Raises:
            LibraryError: rerun is not installed.
            ConfigError: a port is in use.
            UsageError: the object is closed, or another thread is using it.
        """
        self._check_open()
        self._settle()
        words = ["view=rerun", "view.web=true", f"view.port={port}", f"view.web_port={web_port}"]
        viewer = self._stack.enter_context(opened_viewer(compose_run(words)))
        values = {name: self._value(name) for name in self._values} | {"map": self._runner.result.map}
        values |= {name: self._fold(name, preview=True) for name in {"surface", "building"} & set(self._values)}
        for sink in viewer.sinks:
            for name, value in values.items():
                if value is not None:
                    sink.preview(name, value)
        self._runner.sinks = (*self._runner.sinks, *viewer.sinks)

    @_of_one_thread
    def save(self, path: str | Path) -> None:
        """Write a recording: all of it so far where frames are streamed to `out`; else all poses, the surface so far, and the images and values of
        the last `history` frames.

        Args:
            path: the file, as "run.mcap", in a folder that exists; it is overwritten.

        Raises:
            RecordingError: the file cannot be written.
            DataError: it cannot be written, where frames are streamed to `out`.
            UsageError: no frame was tracked yet, or another thread is using the object.
        """
        if self._last < 0:
            raise UsageError("Slam.save", "no frame was tracked, so there is nothing to save", "call track first")
        self._settle()
        file = Path(path).expanduser()
        if self._out is not None and self._writer is not None:
            self._writer.flush()
            recover(self._out / RECORDING, file, being_written=True)
            return
        with new_recording(file, "give another path") as new:
            writer = RecordingWriter(new, self._metadata("dataset"))
            try:
                self._write_history(writer)
            finally:
                writer.close()

    @_of_one_thread
    def save_map(self, path: str | Path) -> None:
        """Write the map, to localise or to go on in it with `load_map=`.

        Args:
            path: the file, as "office.mcap", in a folder that exists; it is overwritten.

        Raises:
            RecordingError: there is no map, or the file cannot be written.
        """
        self._settle()
        save_map(Path(path).expanduser(), self._runner.state, metadata_of(self._config, self._words), source_of(self._config))

    def close(self) -> None:
        """End the run: finish the surface, and write the files of `out`. Any thread may close it; closing twice does nothing.

        Raises:
            TrihedronError: a stage failed, or the recording could not be written.
        """
        with self._closing:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self.close)
        self._queue.close()
        self._thread.join()
        with self._stack:
            if self._out is not None and self._last >= 0:
                write_files(self._runner, None, self._out, self._started, self._began, self._earlier)
                write_models(self._out, self._runner, self._earlier)
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Slam:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        try:
            self.close()
        except Exception:
            if error is None:  # else it is the consequence
                raise

    def __repr__(self) -> str:
        status = f"{self._last + 1} frames, {len(self._runner.result.poses)} poses"
        return f"Slam({self.camera.width}×{self.camera.height}, {status}{', closed' if self._closed else ''})"

    # the run's thread

    def _work(self) -> None:
        try:
            with compilation_reported():
                for step in self._runner.steps(self._writer, self._topics, "dataset" in self._topics, sinks=self._sinks):
                    self._take(step)
        except BaseException as error:  # raised where the caller is
            self._failure = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _take(self, step: Step) -> None:
        with self._changed:
            self._settled = step.position
            self._changed.notify_all()

    def _note(self, position: int, stage: str, value: Value | None) -> None:
        with self._changed:
            if position == self._last:
                self._values[stage][position] = value
                self._changed.notify_all()

    # the caller's thread

    @_of_one_thread
    def _read(self, stage: str) -> Value | None:
        return self._value(stage)

    def _value(self, stage: str) -> Value | None:
        """Wait until a stage is done with the last frame, and return its value."""
        if self._last < 0:
            return None
        with self._changed:
            self._changed.wait_for(lambda: self._last in self._values[stage] or self._ended)
            if self._last in self._values[stage]:
                return self._values[stage][self._last]
        self._check_failure()
        return None

    def _settle(self) -> None:
        """Wait until all stages are done with the last frame."""
        with self._changed:
            self._changed.wait_for(lambda: self._settled >= self._last or self._ended)
        if not self._closed:
            self._check_failure()

    def _check_open(self) -> None:
        self._check_failure()
        if self._closed:
            raise UsageError("Slam", "is closed, and tracks no more frames", "make another")

    def _check_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _metadata(self, *more: str) -> dict[str, str]:
        return {**metadata_of(self._config, self._words), TOPICS: json.dumps(sorted({*self._topics, *more}))}

    def _write_history(self, writer: RecordingWriter) -> None:
        """Write the poses that are no longer in the history, then its frames."""
        frames = self._memory.frames
        first = frames[0][0] if frames else 0
        for pose in self._runner.result.poses:
            if pose.index < first:
                writer.write("pose", pose)
        for _, values in frames:
            frame = values.get("dataset")
            if isinstance(frame, types.Frame):
                writer.write(FRAMES_TOPIC, FrameReference(frame.index, frame.stamp_ns, frame.camera))
            for name, value in values.items():
                writer.write(name, value)
        for name in {"surface", "building"} & set(self._values):
            writer.write(name, self._fold(name))


class Values(Mapping[str, Any]):
    """The values of the last frame by topic; reading one waits until its stage is done."""

    def __init__(self, stages: Mapping[str, Any], read: Callable[[str], Value | None]) -> None:
        self._stages, self._read = stages, read

    def __getitem__(self, topic: str) -> Any:
        if topic not in self._stages:
            raise UsageError(f"values[{topic!r}]", "no stage of this graph writes it", did_you_mean(topic, self._stages))
        return self._read(topic)

    def __contains__(self, topic: object) -> bool:
        return topic in self._stages

    def get(self, topic: str, default: Any = None) -> Any:
        """Return the value of a topic, or the default for one that no stage writes.

        Args:
            topic: the name of a stage of the graph.
            default: returned where the graph has no such stage.

        Returns:
            The value at the last frame, once its stage is done; None where that wrote nothing.
        """
        return self._read(topic) if topic in self._stages else default

    def __iter__(self) -> Iterator[str]:
        return iter(self._stages)

    def __len__(self) -> int:
        return len(self._stages)

    def __repr__(self) -> str:
        return f"Values({', '.join(self._stages)})"


def _check_words(words: list[str]) -> None:
    check_added(words)
    for word in words:
        key = word.partition("=")[0].lstrip("+~")
        if key.partition(".")[0] == "dataset":
            raise UsageError(key, "frames are pushed, so there is no data set to choose", "leave it out, or use trihedron.run")
        if key in REFUSED:
            raise UsageError(key, "is for runs over a data set", "leave it out, or use trihedron.run")


def _on_synthetic_images(graph: Graph, camera: types.Camera) -> Graph:
    """Return the graph on images of the built-in room, of the camera's size as far as that is not large."""
    width = min(camera.width, WARM_UP_PX)
    height = max(round(camera.height * width / camera.width), 16)
    room = Synthetic(length=WARM_UP_FRAMES, width=max(width, 16), height=height)
    return Graph({**graph.stages, "dataset": replace(graph.stages["dataset"], plugin=room)}, graph.outputs)
