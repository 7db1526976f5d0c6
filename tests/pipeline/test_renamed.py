"""Names of earlier versions: accepted with a warning, on the command line and in recordings."""

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core import renamed
from trihedron.pipeline.core.recorded_config import recorded_config

OPTIONS = {"pose": {"refine": {"line_sigma_px"}, "icp": {"speed"}}, "loop": {"planes": {"every"}}}


@pytest.fixture
def names(monkeypatch):
    monkeypatch.setattr(renamed, "_PLUGINS", {("loop", "planar"): "planes"})
    monkeypatch.setattr(renamed, "_OPTIONS", {("pose", "refine"): {"sigma_px": "line_sigma_px", "speed": None, "gone": None}})


@pytest.mark.parametrize(
    ("words", "now", "warnings"),
    [
        (["loop=planar", "loop.every=3"], ["loop=planes", "loop.every=3"], ["loop=planar is now loop=planes"]),
        (["pose.sigma_px=2"], ["pose.line_sigma_px=2"], ["pose.sigma_px=2 is now pose.line_sigma_px=2"]),
        (["pose=icp", "pose.sigma_px=2"], ["pose=icp", "pose.sigma_px=2"], []),  # another plugin's: a mistake, and reported as one
        (["pose.gone=1", "seed=2"], ["seed=2"], ["pose.gone is no longer an option, and is ignored"]),
        (["pose.speed=1"], ["pose.speed=1"], []),  # another plugin of the slot has it
        (["pose=refine", "pose.speed=1"], ["pose=refine"], ["pose.speed is no longer an option, and is ignored"]),
        (["experiment=paper_table"], ["experiment=paper"], ["experiment=paper_table is now experiment=paper"]),
        (["graph.pose.map=map@prev", "dataset.path=a=b", "-m"], ["graph.pose.map=map@prev", "dataset.path=a=b", "-m"], []),
    ],
)
def test_words(names, words, now, warnings):
    assert renamed.current_words(words, OPTIONS.__getitem__) == (now, warnings)


def test_a_removed_option_is_ignored_in_a_run_and_in_a_recording(capsys, tmp_path):
    assert main(["run", "pose.focal_off=0.2", "graph=nothing", f"out={tmp_path}/run"]) == 1
    assert capsys.readouterr().err.splitlines()[0] == "trihedron: warning: pose.focal_off is no longer an option, and is ignored"
    config = recorded_config("{pose: {plugin: refine, focal_off: 0.2, line_sigma_px: 2.0}}", "a.mcap")
    assert config.options["pose"]["line_sigma_px"] == 2.0 and "focal_off" not in config.options["pose"]
