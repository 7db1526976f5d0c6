"""Replay as a promise: every stage of every graph that is shipped, run again alone, gives the recorded values, for any range and either feedback."""

import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import graph_of, register_configs
from trihedron.pipeline.core.registry import load_plugins, plugin_class
from trihedron.pipeline.core.slots import output_of
from trihedron.pipeline.record.embedded_images import topic_of
from trihedron.pipeline.record.reader import Recording

sys.path.insert(0, str(Path(__file__).parent / "pipeline"))
from toys import contents, run_in

ROOT = Path(__file__).resolve().parents[1]
GRAPHS = sorted(path.stem for path in (ROOT / "conf" / "graph").glob("*.yaml"))
SURFACE = "outputs=[trajectory,surface]"
FRAMES = {"pose_graph": 60}  # by then it has closed a loop
FEWER = 30
COVERED = "14:18"  # where a graph can find a lost camera
FIRST, STOP = 10, 20
MAY_BE_SILENT = {
    "bundle": ["none"],
    "loop": ["none", "planes", "appearance", "bag_of_words"],
    "map": ["none"],
    "relocalise": ["none"],
}  # on so short a way no loop is to close


def stages_of(graph):
    """The stages of a graph with a surface, by name."""
    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        return graph_of(compose("root", overrides=[f"graph={graph}", SURFACE])).stages


def of_stage(stage, found):
    """The channels of a stage: embedded frames have two."""
    return {channel: messages for channel, messages in found.items() if topic_of(channel) == stage}


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS)
def test_every_stage_of_every_graph_gives_its_values_again(graph, tmp_path, capsys):
    """The whole recording with new and with recorded feedback byte for byte, a range of it value by value. What says nothing says nothing again."""
    source, stages, frames = tmp_path / "run" / "run.mcap", stages_of(graph), FRAMES.get(graph, FEWER)
    silent = {
        slot for slot, names in MAY_BE_SILENT.items() if slot in stages and type(stages[slot].plugin) in [plugin_class(slot, name) for name in names]
    }
    words = ["dataset=faults", *(f"+dataset.options.{word}" for word in (f"length={frames}", "width=320", "height=240"))]
    words += [f"dataset.cover={COVERED}"] if "relocalise" in set(stages) - silent else []
    dense = [name for name in stages if name != "dataset" and output_of(name).dense]
    run_in(tmp_path, [f"graph={graph}", *words, SURFACE, "record.frames=true", f"record.topics=[{','.join(dense)}]", f"out={tmp_path}/run"])
    recorded = contents(source)
    said = set(stages) & set(map(topic_of, recorded))
    assert said | silent >= set(stages) and len(recorded["/pose"]) == frames, f"{graph}: {set(stages) - said} say nothing"
    jobs, kinds = [], {}
    for stage in stages:
        kinds[stage] = {"new": []}
        if any(wire.delay for wire in stages[stage].inputs.values()):
            kinds[stage]["recorded"] = ["feedback=recorded"]
        if stage != "surface":  # from frame 0, always
            kinds[stage]["range"] = [f"dataset.frames={FIRST}:{STOP}"]
        again = [f"replay={source}", f"only=[{stage}]", f"outputs=[{stage}]"]
        jobs += [[*again, *more, f"out={tmp_path}/{kind}_{stage}"] for kind, more in kinds[stage].items()]
    run_in(tmp_path, *jobs)
    for stage in stages:
        for kind in kinds[stage].keys() - {"range"}:
            same, before = (of_stage(stage, found) for found in (contents(tmp_path / f"{kind}_{stage}" / "run.mcap"), recorded))
            assert same == before and bool(same) == (stage in said), f"{graph}: {stage}, {kind} feedback"
        if stage in said - {"surface"} and any(FIRST <= value.index < STOP for value in Recording(source).values(stage)):
            code = main(["diff", str(source), str(tmp_path / f"range_{stage}" / "run.mcap"), "--topics", stage])
            compared = capsys.readouterr().out
            assert code == 0 and f"equal: {STOP - FIRST} frames ({FIRST}..{STOP - 1})" in compared, f"{graph}: {stage}: {compared}"
