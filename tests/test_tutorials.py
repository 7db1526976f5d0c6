"""Each tutorial is executed as printed: its files are written, its shell blocks run in order, in a new folder and an environment of their own.

A block of code with a title is a file; a block `sh` is run, and a block `text` right behind it holds lines that it prints; `console` and other blocks
`text` are for reading (installation, mistakes). A block that serves a viewer is ended by Ctrl-C, as its page says."""

import os
import re
import signal
import subprocess
import sysconfig
import tempfile
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorial").glob("*.md"))
BLOCK = re.compile(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
TIMES = re.compile(r"\d ms\b")  # differ from run to run; all other figures are the same everywhere
REPORTED = {  # lines that a tutorial's commands must print
    "first-run": ("frames: 60 ok", "Keypoints", "manhattan"),
    "own-recording": ("frames: 40 ok",),
    "floor-plan": ("3 rooms", "Kitchen cooking", "written: flat.svg flat.ifc", "space: Kitchen cooking"),
    "swap-and-compare": ("* mean_shift", "branch_and_bound", "did you mean 'normals'"),
    "which-estimator": ("as recorded against manhattan=plane_svd: axes", "false axes %", "differs.png", "mean of 3 recordings"),
    "write-a-plugin": ("all is well", "ok"),
    "from-python": ("triangles", "planes in the last frame", "40 frames compared"),
    "watch-it-live": ("ws://127.0.0.1:8765", "/manhattan"),
}


def blocks(tutorial: Path) -> list[tuple[str, str, str]]:
    """Language, title and text of each block of code."""
    return BLOCK.findall(tutorial.read_text())


def shown_lines(text: str, folder: Path) -> list[str]:
    """The lines of a block that a command in a folder must print as they stand: all but those with times."""
    return [line.replace("/home/you", str(folder)) for line in text.splitlines() if line.strip() != "..." and not TIMES.search(line)]


def run_block(text: str, folder: Path, environment: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a block of shell, to which Ctrl-C is sent when it says that it is served until then."""
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # a child ignores what its parent ignores, as in the background of a shell
    command, printed = ["bash", "-euo", "pipefail", "-c", text], []
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
        ) as process:
            signal.signal(signal.SIGINT, before)
            for line in process.stdout:
                printed.append(line)
                if "is served until Ctrl-C" in line:
                    os.killpg(process.pid, signal.SIGINT)
        errors.seek(0)
        return process.returncode, "".join(printed), errors.read()


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """The bin folder of an environment that borrows the packages of this one, so that a tutorial may install its own."""
    folder = tmp_path_factory.mktemp("tutorials") / "env"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "borrowed.pth").write_text(f"{ROOT / 'src'}\n{sysconfig.get_path('purelib')}\n")
    for name, call in {"pip": "from pip._internal.cli.main import main", "trihedron": "from trihedron.pipeline.app.cli import main"}.items():
        script = folder / "bin" / name
        script.write_text(f"#!{python}\nimport sys\n{call}\nsys.exit(main())\n")
        script.chmod(0o755)
    return folder / "bin"


def test_every_tutorial_has_blocks_and_promises():
    assert {path.stem for path in TUTORIALS} == set(REPORTED)
    for tutorial in TUTORIALS:
        assert any(language == "sh" for language, _, _ in blocks(tutorial)), tutorial
        assert {language for language, _, _ in blocks(tutorial)} <= {"sh", "console", "text", "python", "yaml", "toml"}, tutorial
        assert not [title for language, title, _ in blocks(tutorial) if language in ("python", "yaml", "toml") and not title], tutorial


@pytest.mark.slow
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial(tutorial, programs, tmp_path):
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= {"PATH": f"{programs}:{environment['PATH']}", "PIP_NO_BUILD_ISOLATION": "0", "PIP_NO_DEPS": "1", "PIP_NO_INDEX": "1"}
    printed, output, before = "", "", ""
    for language, title, text in blocks(tutorial):
        if title:
            path = tmp_path / title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        elif language == "sh":
            code, out, errors = run_block(text, tmp_path, environment)
            assert code == 0, f"{text}\n{out[-2000:]}\n{errors[-2000:]}"
            output = out + errors
            printed += output
        elif language == "text" and before == "sh":
            assert [line for line in shown_lines(text, tmp_path) if line not in output.splitlines()] == [], output[-4000:]
        before = language
    for line in REPORTED[tutorial.stem]:
        assert line in printed, f"{line} is not in:\n{printed[-4000:]}"
