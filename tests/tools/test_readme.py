"""README and docs: commands exist, links resolve."""

import contextlib
import io
import re
import shlex
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.tools.benchmark import COMPARISONS

ROOT = Path(__file__).parents[2]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def test_the_commands_exist():
    known = {entry.name for entry in entry_points(group="trihedron.commands")} | {"run"}
    for page in PAGES:
        text = page.read_text()
        used = set(re.findall(r"^trihedron (\w[\w-]*)", text, re.MULTILINE)) | set(re.findall(r"`trihedron (\w[\w-]*)", text))
        assert used <= known, f"{page}: {used - known}"


def test_an_extra_is_installed_in_one_way_that_keeps_a_clone_as_it_is():
    commands = {command for page in PAGES for command in re.findall(r"pip install [^`\n]*'[\w.]*\[\w+\]'", page.read_text())}
    assert len(commands) > 5
    assert [command for command in commands if not command.startswith("pip install --constraint constraints.txt -e '.[")] == []


def shown_commands():
    """Page and words of each command in a block `sh` or `console`, placeholders and other programs left out."""
    for page in PAGES:
        for block in re.findall(r"^```(?:sh|console)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                for command in line.split(" && "):
                    words = shlex.split(command.removeprefix("$ ").split("  #")[0], comments=True)
                    if words[:1] == ["trihedron"] and "..." not in command and "=>" not in command:
                        yield page, [word for word in words[1:] if word not in ("||", "true")]


def test_the_commands_shown_have_these_options():
    shown = list(shown_commands())
    assert len(shown) > 60
    for page, (name, *words) in shown:
        if name != "run" and words and words[0] not in COMPARISONS:
            stream = io.StringIO()
            with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
                main([name, "--help"])
            for word in words:
                if word.startswith("--"):
                    assert word in stream.getvalue(), f"{page}: trihedron {name} {word}"


@pytest.mark.slow
def test_the_runs_shown_can_be_composed():
    """Single runs: their keys, options and wires exist. No folders of the reader's, no replays, no sweeps; tests/test_tutorials.py runs tutorials."""
    counted = 0
    for page, (name, *words) in shown_commands():
        if name == "run" and "-m" not in words and page.parent.name != "tutorial" and not any(word.startswith("replay=") for word in words):
            graph_of(compose_run([word for word in words if "=" in word and not word.startswith(("load_map=", "save_map="))]))
            counted += 1
    assert counted > 25


def test_links_resolve_and_pictures_are_small():
    for page in PAGES:
        for picture, name in re.findall(r"(!?)\[[^]]*\]\(([^)#]+)[^)]*\)", page.read_text()):
            if not name.startswith("http"):
                assert (page.parent / name).exists(), f"{page}: {name}"
                assert not picture or (page.parent / name).stat().st_size < 300_000


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text().split()) <= 1200


def test_the_python_of_the_readme_runs(capsys, tmp_path, monkeypatch):
    (program,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.yaml").write_text("width: 160\nheight: 120\nfx: 131.25\nfy: 131.25\ncx: 79.5\ncy: 59.5\ndepth_scale: 1000\n")
    frames = map(Synthetic(length=5, width=160, height=120), range(5))
    names = {"my_camera": ((frame.color, frame.depth_m, frame.stamp_ns / 1e9) for frame in frames)}
    exec(compile(program, "README.md", "exec"), names)
    names["slam"].close()
    revision, planes, *topics = capsys.readouterr().out.split()
    assert int(revision) > 0 and int(planes) > 0 and topics == ["('frames',", "'manhattan')"]
