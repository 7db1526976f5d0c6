"""The graph checks: one line each, in full."""

from dataclasses import dataclass

import pytest

from trihedron.pipeline.core.errors import GraphError
from trihedron.pipeline.core.graph import build_graph
from trihedron.pipeline.core.types import Frame, Keypoints, ManhattanFrame, Normals, Planes, Pose, Rotation, Segments, Tracks


@dataclass(frozen=True)
class DatasetStub:
    def __call__(self, index: int) -> Frame | None: ...


@dataclass(frozen=True)
class NormalsStub:
    def __call__(self, frame: Frame) -> Normals | None: ...


@dataclass(frozen=True)
class PlanesStub:
    def __call__(self, frame: Frame, normals: Normals) -> Planes | None: ...


@dataclass(frozen=True)
class RotationStub:
    def __call__(self, planes: Planes, previous: Rotation | None, previous_pose: Pose | None) -> Rotation | None: ...


@dataclass(frozen=True)
class ManhattanStub:
    def __call__(self, normals: Normals, previous: ManhattanFrame | None) -> ManhattanFrame | None: ...


PLUGINS = {"dataset": DatasetStub(), "normals": NormalsStub(), "planes": PlanesStub(), "manhattan": ManhattanStub()}
WIRING = {
    "dataset": {},
    "normals": {"frame": "dataset"},
    "planes": {"frame": "dataset", "normals": "normals"},
    "manhattan": {"normals": "normals", "planes": "planes", "previous": "manhattan@prev"},
}


def message(outputs=("manhattan",), plugins=PLUGINS, **changes):
    wiring = {stage: dict(wires) for stage, wires in WIRING.items()}
    for stage, wires in changes.items():
        wiring.setdefault(stage, {}).update(wires)
    with pytest.raises(GraphError) as error:
        build_graph(wiring, plugins, outputs)
    return str(error.value)


def test_an_optional_input_wired_to_null_is_none():
    stage = build_graph({**WIRING, "manhattan": {"normals": "normals", "previous": None}}, PLUGINS, ["manhattan"]).stages["manhattan"]
    assert stage.absent == {"previous"} and set(stage.inputs) == {"normals"}
    assert message(manhattan={"normals": None}) == (
        "graph.manhattan.normals: the input is not wired, and ManhattanStub takes it; give graph.manhattan.normals=TOPIC"
    )


def test_a_good_graph_keeps_only_what_its_outputs_need():
    graph = build_graph(WIRING, PLUGINS, ["manhattan"])
    assert list(graph.stages) == ["dataset", "normals", "manhattan"]  # the plugin does not take planes, so nobody needs them
    assert graph.stages["manhattan"].required == {"normals"}
    assert list(build_graph(WIRING, PLUGINS, ["planes"]).stages) == ["dataset", "normals", "planes"]


def test_unknown_topic():
    assert message(planes={"normals": "normal"}) == "graph.planes.normals: no stage writes topic 'normal'; did you mean 'normals'?"


def test_unknown_input():
    assert message(planes={"normal": "normals"}) == "graph.planes.normal: the slot 'planes' has no input 'normal'; did you mean 'normals'?"


def test_unknown_slot():
    assert message(plane={}) == "graph.plane: there is no slot 'plane'; did you mean 'planes'?"


def test_type_mismatch():
    expected = "graph.planes.normals: topic 'dataset' is Frame, the input takes Normals; wire it to normals"
    assert message(planes={"normals": "dataset"}) == expected


def test_missing_wire():
    expected = "graph.planes.normals: the input is not wired, and PlanesStub takes it; give graph.planes.normals=TOPIC"
    assert message(planes={"normals": None}) == expected


def test_no_plugin():
    plugins = {**PLUGINS, "planes": None}
    assert message(plugins=plugins) == "graph.planes: no plugin is chosen for this stage; give planes=PLUGIN (see trihedron plugins)"


def test_delayed_wire_into_an_input_that_cannot_be_none():
    expected = (
        "graph.planes.normals: 'normals@prev' is None at first, and the input cannot be None; "
        "wire it to 'normals', or take the input as optional"
    )
    assert message(planes={"normals": "normals@prev"}) == expected


@pytest.mark.parametrize("wire", ["normals@", "normals@0", "normals@-1", "normals@next", "a b"])
def test_malformed_wire(wire):
    expected = f"graph.planes.normals: '{wire}' is not a wire; write topic, topic@prev or topic@5"
    assert message(planes={"normals": wire}) == expected


def test_cycle_within_a_frame():
    @dataclass(frozen=True)
    class TracksStub:
        def __call__(self, manhattan: ManhattanFrame | None, keypoints: Keypoints, segments: Segments) -> Tracks | None: ...

    plugins = {"dataset": DatasetStub(), "normals": NormalsStub(), "manhattan": ManhattanStub()}
    wiring = {"dataset": {}, "normals": {"frame": "dataset"}, "manhattan": {"normals": "normals", "previous": "manhattan"}}
    with pytest.raises(GraphError) as error:
        build_graph(wiring, plugins, ["manhattan"])
    assert str(error.value) == "graph: manhattan -> manhattan need each other within one frame; put @prev on one of these wires"


def test_unknown_output():
    assert message(outputs=["manhatan"]) == "outputs: no stage writes 'manhatan'; did you mean 'manhattan'?"


def test_empty_outputs():
    assert message(outputs=[]) == "outputs: is empty, so nothing would run; give outputs=[trajectory]"


def test_trajectory_needs_a_pose():
    expected = "outputs: a trajectory needs the stage 'pose', which this graph lacks; leave it out or add the stage"
    assert message(outputs=["trajectory"]) == expected
