"""Hyper-parameter search: the spaces, what a replay computes again, the best of the trials, and the same trials when it is called again."""

import json
from dataclasses import replace

import pytest
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import graph_of, register_configs
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.sweep.search import Trial, _discard_incomparable, _distribution, _is_searched, followers

ROOM = ["dataset.width=160", "dataset.height=120", "dataset.length=8"]
SEARCH = ["run", "-m", "hydra/sweeper=optuna", "hydra/launcher=basic", "hydra.sweeper.trials=2"]


@pytest.mark.parametrize(
    "text, default, space",
    [
        ("a=interval(1,5)", 2.0, "FloatDistribution(high=5.0, log=False, low=1.0, step=None)"),
        ("a=interval(1,5)", 2, "IntDistribution(high=5, log=False, low=1, step=1)"),
        ("a=tag(log,interval(0.1,5))", 2.0, "FloatDistribution(high=5.0, log=True, low=0.1, step=None)"),
        ("a=range(1,6,2)", 3, "IntDistribution(high=5, log=False, low=1, step=2)"),
        ("a=range(0.5,2.5,0.5)", 1.0, "FloatDistribution(high=2.0, log=False, low=0.5, step=0.5)"),
        ("a=choice(orb,none)", "orb", "CategoricalDistribution(choices=('orb', 'none'))"),
    ],
)
def test_hydras_sweeps_are_spaces(text, default, space):
    override = OverridesParser.create().parse_overrides([text])[0]
    assert _is_searched(override) and str(_distribution(override, default)) == space


def test_plain_values_are_not_searched():
    assert not any(_is_searched(override) for override in OverridesParser.create().parse_overrides(["a=1,2", "b=3", "c=[d,e]"]))


def test_what_follows_is_computed_again_and_nothing_else():
    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        graph = graph_of(compose("root"))
    upstream = {"dataset", "normals", "keypoints", "lines", "segments", "planes"}
    assert set(graph.stages) - set(followers(graph, ["planes"])) == upstream - {"planes"}
    assert set(graph.stages) - set(followers(graph, ["manhattan"])) == upstream
    with pytest.raises(UsageError, match="surface: is searched, and no output depends on it"):
        followers(graph, ["surface"])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    assert main(["run", *ROOM, f"out={folder}"]) == 0
    return folder / "run.mcap"


def test_a_search_on_a_recording(recording, tmp_path, capfd):
    words = [*SEARCH, "hydra.sweeper.trials=3", "hydra.sweeper.batch=2", f"replay={recording}", "only=[planes]", "planes.angle_deg=interval(1,5)"]
    assert main([*words, f"out={tmp_path / 'a'}"]) == 0
    said = capfd.readouterr()
    assert f"reads dataset, normals, keypoints, lines, segments from {recording}" in said.err and "sweep: 4 of 4 jobs done" in said.err
    found = json.loads((tmp_path / "a" / "search.json").read_text())
    objectives = [trial["objective"] for trial in found["trials"]]
    assert len(objectives) == 3 and all(1.0 <= trial["values"]["planes.angle_deg"] <= 5.0 for trial in found["trials"])
    assert found["best"]["objective"] == min([found["default"]["objective"], *objectives]) and len({*objectives}) > 1

    stopped = tmp_path / "a" / found["trials"][1]["jobs"][0]
    (stopped / "job.json").unlink()  # as if stopped there
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "a").glob("*/run.mcap")}
    assert main([*words, f"out={tmp_path / 'a'}"]) == 0
    after = {file: file.stat().st_mtime_ns for file in before}
    assert [file.parent for file in before if before[file] != after[file]] == [stopped]
    assert json.loads((tmp_path / "a" / "search.json").read_text()) == found


@pytest.mark.slow
def test_a_trial_that_fails_has_no_value_and_plain_values_are_averaged(tmp_path):
    assert main([*SEARCH, *ROOM, f"out={tmp_path}", "planes.angle_deg=choice(-1)", "seed=0,1", "hydra.sweeper.trials=1"]) == 0
    found = json.loads((tmp_path / "search.json").read_text())
    assert found["best"] == found["default"] and found["trials"][0]["objective"] is None and "angle_deg" in found["trials"][0]["reason"]
    errors = [json.loads((tmp_path / job / "metrics.json").read_text())["final"]["ate_rmse_m"] for job in found["default"]["jobs"]]
    assert len(errors) == 2 and found["default"]["objective"] == sum(errors) / 2


def test_a_trial_that_tracks_fewer_frames_has_no_value():
    default = Trial({"a": 1}, 0.002, ["0"], tracked_share=1.0)
    trial = Trial({"a": 2}, 0.001, ["1"], tracked_share=0.9)
    assert (
        _discard_incomparable(trial, default).objective is None
        and "tracks 90.0% of the frames, the default 100.0%" in _discard_incomparable(trial, default).reason
    )
    assert _discard_incomparable(replace(trial, tracked_share=1.0), default).objective == 0.001


@pytest.mark.parametrize(
    "words, said",
    [
        (["planes.angle_deg=1"], "hydra/sweeper=optuna: nothing is searched"),
        (["planes.angle_deg=interval(1,2)", "hydra.sweeper.direction=up"], "hydra.sweeper.direction: 'up' is no direction"),
        (["planes.angle_deg=interval(1,2)", "hydra.sweeper.objective=final.ate"], "no final.ate in metrics.json, did you mean 'final.ate_"),
    ],
)
def test_mistakes_are_one_line(words, said, tmp_path, capfd):
    assert main([*SEARCH, *ROOM[:2], "dataset.length=3", *words, f"out={tmp_path}"]) != 0
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("trihedron: ")]
    assert len(lines) == 1 and said in lines[0]
