"""The graph: stages and the wires between them, checked whole before a frame is read."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from trihedron.pipeline.core.errors import GraphError, did_you_mean
from trihedron.pipeline.core.registry import name_of, parameters_of_method
from trihedron.pipeline.core.slots import CAMERA, FOLDS, RNG, SLOTS, accepts_none, default_wires, inputs_of, output_of, strip_none
from trihedron.pipeline.core.types import Frame
from trihedron.pipeline.core.wires import Wire, parse_wire

NOTHING = "none"  # name of the plugins that leave a slot's topic empty
TRAJECTORY = "trajectory"  # the output made of the topics `pose` and `map`


@dataclass(frozen=True)
class Stage:
    """One plugin in the graph. `inputs` are the wires of the parameters it takes (`camera` reads the frame's); `required` those whose None skips the
    stage; `absent` the optional ones without a wire: always None."""

    name: str  # slot, configuration group and topic
    plugin: Any
    inputs: Mapping[str, Wire]
    required: frozenset[str]
    absent: frozenset[str]
    wants_rng: bool

    @property
    def fold(self) -> bool:
        """True if the stage gathers frames into a result written at the end."""
        return self.name in FOLDS


@dataclass(frozen=True)
class Graph:
    """Stages in an order in which each comes after those whose value of the same frame it reads."""

    stages: Mapping[str, Stage]
    outputs: tuple[str, ...]

    def required_stages(self, targets: Iterable[str], given: Container[str] = ()) -> set[str]:
        """Return the stages that `targets` depend on, delayed wires included, and the targets; without those `given`, and what only they need."""
        found: set[str] = set()
        pending = list(targets)
        while pending:
            name = pending.pop()
            if name not in found and name not in given:
                found.add(name)
                pending += [wire.topic for wire in self.stages[name].inputs.values()]
        return found


def build_graph(plugins: Mapping[str, Any], outputs: Iterable[str], wiring: Mapping[str, Mapping[str, str | None]] | None = None) -> Graph:
    """Join plugins (slot -> instance) by their slots' default wires, except where `wiring` (stage -> input -> wire) states another, None = not wired,
    and retain the stages that `outputs` need. An optional input whose default topic no stage writes is None.

    Raises GraphError, one line each: a stage without plugin, an unknown input or topic, a missing wire, a type that does not fit, a delayed wire
    into an input that cannot be None, an input of the plugin's `needs` that nothing writes, a cycle within one frame, an unknown output."""
    wiring = wiring or {}
    names = [*plugins, *(name for name in wiring if name not in plugins)]
    stages = {name: _stage(name, wiring.get(name) or {}, plugins) for name in names}
    for stage in stages.values():
        for parameter, wire in stage.inputs.items():
            _check_wire(stage, parameter, wire, stages)
    graph = Graph({name: stages[name] for name in _topological_order(stages)}, tuple(outputs))
    needed = graph.required_stages(_targets(graph))
    return Graph({name: stage for name, stage in graph.stages.items() if name in needed}, graph.outputs)


def _stage(name: str, wires: Mapping[str, str | None], plugins: Mapping[str, Any]) -> Stage:
    place = f"graph.{name}"
    if name not in SLOTS:
        raise GraphError(place, f"there is no slot '{name}'", did_you_mean(name, SLOTS))
    plugin = plugins.get(name)
    if plugin is None:
        raise GraphError(place, "no plugin is chosen for this stage", f"give {name}=PLUGIN (see trihedron plugins)")
    given, defaults = inputs_of(name), default_wires(name)
    for parameter in wires:
        if parameter not in given:
            raise GraphError(f"{place}.{parameter}", f"the slot '{name}' has no input '{parameter}'", did_you_mean(parameter, given))
    taken = parameters_of_method(name, type(plugin))
    inputs, absent = {}, set()
    for parameter in taken:
        if parameter == CAMERA:
            inputs[parameter] = Wire("dataset")
        if parameter in (CAMERA, RNG):
            continue
        optional, text = accepts_none(given[parameter]), wires.get(parameter)
        if parameter not in wires and (defaults[parameter].topic in plugins or not optional):
            inputs[parameter] = defaults[parameter]
        elif text is not None:
            inputs[parameter] = parse_wire(text, f"{place}.{parameter}")
        elif optional:
            absent.add(parameter)
        else:
            cause = f"the input is not wired, and {type(plugin).__name__} takes it"
            raise GraphError(f"{place}.{parameter}", cause, f"give graph.{name}.{parameter}=TOPIC")
    for parameter in getattr(plugin, "needs", ()):
        topic = inputs.get(parameter, defaults[parameter]).topic
        missing = "it is not wired" if parameter in absent else f"{topic}={NOTHING} writes nothing"
        if parameter in absent or name_of(topic, plugins.get(topic)) == NOTHING:
            cause = f"{name}={name_of(name, plugin)} needs it, and {missing}"
            raise GraphError(f"{place}.{parameter}", cause, f"choose another plugin for {topic}, or for {name}")
    required = frozenset(p for p in inputs if p == CAMERA or not accepts_none(given[p]))
    return Stage(name, plugin, inputs, required, frozenset(absent), RNG in taken)


def _check_wire(stage: Stage, parameter: str, wire: Wire, stages: Mapping[str, Stage]) -> None:
    place = f"graph.{stage.name}.{parameter}"
    if wire.topic not in stages:
        cure = f"choose a plugin with +{wire.topic}=PLUGIN" if wire.topic in SLOTS else did_you_mean(wire.topic, stages)
        raise GraphError(place, f"no stage writes topic '{wire.topic}'", cure)
    expected, written = strip_none({CAMERA: Frame, **inputs_of(stage.name)}[parameter]), output_of(wire.topic)
    if expected is not written:
        fitting = [name for name in stages if output_of(name) is expected]
        cure = f"wire it to {' or '.join(fitting)}" if fitting else f"no stage of this graph writes {expected.__name__}"
        raise GraphError(place, f"topic '{wire.topic}' is {written.__name__}, the input takes {expected.__name__}", cure)
    if wire.delay and parameter in stage.required:
        cause = f"'{wire}' is None at first, and the input cannot be None"
        raise GraphError(place, cause, f"wire it to '{wire.topic}', or take the input as optional")


def _topological_order(stages: Mapping[str, Stage]) -> list[str]:
    """Sort topologically by the wires within a frame, ties in the order of the slots. Raises GraphError naming a cycle."""
    order: list[str] = []
    waiting = [name for name in SLOTS if name in stages]
    while waiting:
        ready = [n for n in waiting if all(w.delay or w.topic in order for w in stages[n].inputs.values())]
        if not ready:
            cycle = _cycle(waiting[0], stages, set(waiting))
            raise GraphError("graph", f"{' -> '.join(cycle)} need each other within one frame", "put @prev on one of these wires")
        order.append(ready[0])
        waiting.remove(ready[0])
    return order


def _cycle(start: str, stages: Mapping[str, Stage], among: set[str]) -> list[str]:
    path = [start]
    while True:
        following = next(w.topic for w in stages[path[-1]].inputs.values() if not w.delay and w.topic in among)
        if following in path:
            return [*path[path.index(following) :], following]
        path.append(following)


def _targets(graph: Graph) -> list[str]:
    """Return the stages behind the outputs."""
    targets = []
    for output in graph.outputs:
        if output == TRAJECTORY:
            if "pose" not in graph.stages:
                raise GraphError("outputs", "a trajectory needs the stage 'pose', which this graph lacks", "leave it out or add the stage")
            targets += [name for name in ("pose", "map") if name in graph.stages]
        elif output in graph.stages:
            targets.append(output)
        else:
            raise GraphError("outputs", f"no stage writes '{output}'", did_you_mean(output, [TRAJECTORY, *graph.stages]))
    if not targets:
        raise GraphError("outputs", "is empty, so nothing would run", "give 'outputs=[trajectory]'")
    return targets
