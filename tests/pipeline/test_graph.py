"""The graph checks: one line each, in full."""

from dataclasses import dataclass

import pytest

from trihedron.pipeline.core import registry
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.pipeline.core.errors import GraphError
from trihedron.pipeline.core.graph import build_graph
from trihedron.pipeline.core.slots import SLOTS, accepts_none, default_wires, inputs_of, output_of, strip_none
from trihedron.pipeline.core.types import Frame, ManhattanFrame, Normals, Planes, Pose, Rotation


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


def message(outputs=("manhattan",), plugins=PLUGINS, **wiring):
    with pytest.raises(GraphError) as error:
        build_graph(plugins, outputs, wiring)
    return str(error.value)


def wires(graph, stage):
    return {parameter: str(wire) for parameter, wire in graph.stages[stage].inputs.items()}


@dataclass(frozen=True)
class Needy:
    needs = ("normals",)

    def __call__(self, normals: Normals | None, previous: ManhattanFrame | None) -> ManhattanFrame | None: ...


def test_an_input_that_a_plugin_needs_is_written(monkeypatch):
    """Though it may be None in a frame."""
    plugins = {**PLUGINS, "manhattan": Needy()}
    assert "manhattan" in build_graph(plugins, ("manhattan",)).stages
    monkeypatch.setitem(registry._PLUGINS, "normals", {"none": NormalsStub})
    assert message(plugins=plugins) == (
        "graph.manhattan.normals: manhattan=Needy needs it, and normals=none writes nothing; choose another plugin for normals, or for manhattan"
    )


def test_icp_without_a_model_is_refused():
    """It would hold the first pose, and call it tracked."""
    with pytest.raises(GraphError) as error:
        graph_of(compose_run(["pose=icp"]))
    assert str(error.value) == "graph.pose.model: pose=icp needs it, and model=none writes nothing; choose another plugin for model, or for pose"
    with pytest.raises(GraphError, match="pose=icp needs it, and it is not wired; choose another plugin for model, or for pose"):
        graph_of(compose_run(["pose=icp", "model=tsdf", "~graph.pose.model"]))
    assert "model" in graph_of(compose_run(["pose=icp", "model=tsdf"])).stages


def test_an_input_reads_the_topic_of_its_name_unless_the_slot_declares_another():
    assert {parameter: str(wire) for parameter, wire in default_wires("translation").items()} == {
        "frame": "dataset", "rotation": "rotation", "tracks": "tracks", "keypoints": "keypoints", "segments": "segments", "planes": "planes",
        "previous_keypoints": "keypoints@prev", "previous_pose": "pose@prev", "earlier_pose": "pose@2", "previous": "translation@prev",
        "map": "map@prev",
    }  # fmt: skip
    declared = {parameter: str(wire) for parameter, wire in default_wires("map").items()}
    assert (declared["map"], declared["bundle"], declared["loop"], declared["relocalise"]) == ("map@prev", "bundle@5", "loop@10", "relocalise")
    assert str(default_wires("surface")["map"]) == "map"


def test_every_default_wire_fits_its_input():
    for slot in SLOTS:
        for parameter, wire in default_wires(slot).items():
            hint = inputs_of(slot)[parameter]
            assert output_of(wire.topic) is strip_none(hint), f"{slot}.{parameter}"
            assert not wire.delay or accepts_none(hint), f"{slot}.{parameter}"


def test_a_graph_states_only_the_wires_that_differ():
    assert wires(build_graph(PLUGINS, ["manhattan"]), "manhattan") == {"normals": "normals", "previous": "manhattan@prev"}
    changed = build_graph(PLUGINS, ["manhattan"], {"manhattan": {"previous": "manhattan@3"}})
    assert wires(changed, "manhattan") == {"normals": "normals", "previous": "manhattan@3"}


def test_an_optional_input_wired_to_null_is_none():
    stage = build_graph(PLUGINS, ["manhattan"], {"manhattan": {"previous": None}}).stages["manhattan"]
    assert stage.absent == {"previous"} and set(stage.inputs) == {"normals"}
    assert message(manhattan={"normals": None}) == (
        "graph.manhattan.normals: the input is not wired, and ManhattanStub takes it; give graph.manhattan.normals=TOPIC"
    )


def test_an_optional_input_whose_default_topic_no_stage_writes_is_none_and_a_required_one_is_refused():
    plugins = {**PLUGINS, "rotation": RotationStub()}
    stage = build_graph(plugins, ["rotation"]).stages["rotation"]
    assert stage.absent == {"previous_pose"} and wires(build_graph(plugins, ["rotation"]), "rotation") == {
        "planes": "planes", "previous": "rotation@prev",
    }  # fmt: skip
    without = {name: plugin for name, plugin in plugins.items() if name != "planes"}
    assert message(["rotation"], without) == "graph.rotation.planes: no stage writes topic 'planes'; choose a plugin with +planes=PLUGIN"
    expected = "graph.rotation.previous_pose: no stage writes topic 'pose'; choose a plugin with +pose=PLUGIN"
    assert message(["rotation"], plugins, rotation={"previous_pose": "pose@2"}) == expected  # wired on purpose


def test_a_good_graph_keeps_only_what_its_outputs_need():
    graph = build_graph(PLUGINS, ["manhattan"])
    assert list(graph.stages) == ["dataset", "normals", "manhattan"]  # the plugin does not take planes, so nobody needs them
    assert graph.stages["manhattan"].required == {"normals"}
    assert list(build_graph(PLUGINS, ["planes"]).stages) == ["dataset", "normals", "planes"]


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
        "graph.planes.normals: 'normals@prev' is None at first, and the input cannot be None; wire it to 'normals', or take the input as optional"
    )
    assert message(planes={"normals": "normals@prev"}) == expected


@pytest.mark.parametrize("wire", ["normals@", "normals@0", "normals@-1", "normals@next", "a b"])
def test_malformed_wire(wire):
    expected = f"graph.planes.normals: '{wire}' is not a wire; write topic, topic@prev or topic@5"
    assert message(planes={"normals": wire}) == expected


def test_cycle_within_a_frame():
    assert message(manhattan={"previous": "manhattan"}) == (
        "graph: manhattan -> manhattan need each other within one frame; put @prev on one of these wires"
    )


def test_unknown_output():
    assert message(outputs=["manhatan"]) == "outputs: no stage writes 'manhatan'; did you mean 'manhattan'?"


def test_empty_outputs():
    assert message(outputs=[]) == "outputs: is empty, so nothing would run; give 'outputs=[trajectory]'"


def test_trajectory_needs_a_pose():
    expected = "outputs: a trajectory needs the stage 'pose', which this graph lacks; leave it out or add the stage"
    assert message(outputs=["trajectory"]) == expected
