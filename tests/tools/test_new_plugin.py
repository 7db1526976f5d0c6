"""`trihedron new-plugin`: packages that install, keep the contract of their slot and track the room."""

import os
import subprocess
import sys

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.slots import SLOTS
from trihedron.tools.new_plugin import package_of


def test_a_plugin_of_every_slot_registers():
    """In a process of its own: names of plugins are for good."""
    slots = [slot for slot in SLOTS if slot != "dataset"]
    modules = [package_of(slot, f"my_{slot}")[f"trihedron_my_{slot}.py"].split("import annotations\n")[1] for slot in slots]
    program = "\n".join(["from __future__ import annotations", *modules, *(f"My{slot.capitalize()}()._method" for slot in slots)])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_package_installs_passes_the_check_and_tracks(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new-plugin", "planes", "my_planes"]) == 0
    assert "trihedron-my-planes/trihedron_my_planes.py" in capsys.readouterr().out
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", f"--target={site}", "./trihedron-my-planes"]
    subprocess.run(install, check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}
    commands = [
        [sys.executable, "-m", "trihedron", "check", "planes", "my_planes"],
        [sys.executable, "-m", "trihedron", "run", "planes=my_planes", "dataset.length=10", "out=run"],
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "trihedron-my-planes"],
    ]
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["planse", "mine"], "new-plugin: there is no slot 'planse'; did you mean 'planes'?"),
        (["planes", "My-planes"], "new-plugin: 'My-planes' cannot be the name of a plugin; give small letters, digits and _, for example my_planes"),
        (["planes", "ransac"], "new-plugin: there is a plugin planes=ransac already; give another name"),
    ],
)
def test_mistakes_are_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new-plugin", *words]) == 2
    assert capsys.readouterr().err == f"trihedron: {message}\n"
    assert not list(tmp_path.iterdir())


def test_a_folder_is_not_written_over(tmp_path, capsys):
    assert main(["new-plugin", "planes", "mine", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"trihedron: {tmp_path}: is there already; give another --out FOLDER\n"
