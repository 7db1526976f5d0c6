"""Replay as a promise: every stage of every graph that is shipped, run again alone, gives the recorded values, for any range and either feedback."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from trihedron.pipeline.cli import main
from trihedron.pipeline.recording import Recording

sys.path.insert(0, str(Path(__file__).parent / "pipeline"))
from toys import contents

ROOT = Path(__file__).resolve().parents[1]
GRAPHS = sorted(path.stem for path in (ROOT / "conf" / "graph").glob("*.yaml"))
FRAMES, FIRST, STOP = 36, 12, 24
JOBS = """
import json, sys
from trihedron.pipeline.cli import main
sys.exit(max(main(["run", *job]) for job in json.loads(sys.argv[1])))
"""


def run(*jobs, cwd):
    """Several `trihedron run` in one fresh process."""
    done = subprocess.run([sys.executable, "-c", JOBS, json.dumps(jobs)], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS)
def test_every_stage_of_every_graph_gives_its_values_again(graph, tmp_path, capsys):
    """The whole recording with new and with recorded feedback byte for byte, a range of it value by value."""
    source = tmp_path / "run" / "run.mcap"
    words = ["dataset=synthetic", f"dataset.length={FRAMES}", "dataset.width=320", "dataset.height=240"]
    words += ["record.frames=true", "record.topics=[normals]"]
    run([f"graph={graph}", *words, f"out={tmp_path}/run", "outputs=[trajectory,surface]"], cwd=tmp_path)
    recorded, stages = contents(source), sorted(Recording(source).topics - {"frames"})
    assert {"dataset", "pose"} <= set(stages) and len(recorded["/pose"]) == FRAMES
    jobs = []
    for stage in stages:
        again = [f"replay={source}", f"only=[{stage}]", f"outputs=[{stage}]"]
        jobs += [[*again, f"out={tmp_path}/new_{stage}"], [*again, "feedback=recorded", f"out={tmp_path}/recorded_{stage}"]]
        jobs += [[*again, f"dataset.frames={FIRST}:{STOP}", f"out={tmp_path}/range_{stage}"]] if stage != "surface" else []  # from frame 0, always
    run(*jobs, cwd=tmp_path)
    for stage in stages:
        for kind in ("new", "recorded"):
            same = contents(tmp_path / f"{kind}_{stage}" / "run.mcap")
            assert same[f"/{stage}"] == recorded[f"/{stage}"], f"{graph}: {stage}, {kind} feedback"
        if stage != "surface" and any(FIRST <= value.index < STOP for value in Recording(source).values(stage)):
            code = main(["diff", str(source), str(tmp_path / f"range_{stage}" / "run.mcap"), "--topics", stage])
            said = capsys.readouterr().out
            assert code == 0 and f"equal: {STOP - FIRST} frames ({FIRST}..{STOP - 1})" in said, f"{graph}: {stage}: {said}"
