"""The installed package: all of it, under one name, working away from the source folder."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from setuptools.config.pyprojecttoml import load_file

from trihedron.tools.benchmark import COMPARISONS

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf")
OF_CHECKOUT = ROOT / "tools" / "benchmarks"  # no wheel has it
PROJECT = load_file(ROOT / "pyproject.toml")


def test_the_package_links_to_the_folders():
    """Relative links, so that a checkout may lie anywhere; a new folder with modules is a package."""
    for folder in FOLDERS:
        assert os.readlink(ROOT / "src" / "trihedron" / folder) == f"../../{folder}"
        assert all((path.parent / "__init__.py").is_file() for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml"))


def test_commands_are_registered():
    commands = PROJECT["project"]["entry-points"]["trihedron.commands"]
    modules = {path.stem for path in (ROOT / "tools").glob("*.py") if "\ndef main(argv: list[str]) -> int:" in path.read_text()}
    sub_words = {module.rpartition(".")[2] for module in COMPARISONS.values()}  # of `trihedron benchmark`
    assert {target.removesuffix(":main").removeprefix("trihedron.tools.") for target in commands.values()} == modules - sub_words


def test_nothing_outside_the_benchmarks_needs_them():
    """The table of commands names them: what it says where they are missing is below."""
    files = [path for folder in (*FOLDERS, "src/trihedron") for path in (ROOT / folder).rglob("*.py") if not path.is_relative_to(OF_CHECKOUT)]
    assert [path.relative_to(ROOT).as_posix() for path in files if "tools.benchmarks" in path.read_text()] == ["tools/benchmark.py"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel that is built from the sdist, which is built from a copy so that nothing left over gets in."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "src", source / "src", symlinks=True, ignore=shutil.ignore_patterns("*.egg-info"))
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    program = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", program, folder], cwd=source, check=True, capture_output=True)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert not [member.name for member in archive if member.issym() or member.islnk()]
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(sdist)]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    return built


def test_content_of_the_wheel(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"trihedron", wheel.name.removesuffix("-py3-none-any.whl") + ".dist-info"}
    ours = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".json", ".html", ".css", ".js")]
    own = {path.relative_to(ROOT / "src").as_posix() for path in (ROOT / "src" / "trihedron").rglob("*.py")}  # behind no link
    expected = {f"trihedron/{path.relative_to(ROOT)}" for path in ours if not path.is_relative_to(OF_CHECKOUT)} | own | {"trihedron/py.typed"}
    assert {name for name in names if name.startswith("trihedron/")} == expected


@pytest.mark.parametrize(
    "words, code, said",
    [
        ("scaling", 2, "benchmark scaling: is in the source checkout, and not in the installed package; get the sources, and in their folder: pip"),
        ("map --help", 2, "benchmark map: is in the source checkout, and not in the installed package; get the sources, and in their folder: pip"),
        ("rotations .", 1, ".: holds no runs"),
        ("methods .", 1, ".: holds no runs; give the out=FOLDER of a sweep"),
        ("--compare none.json", 1, "none.json: cannot be read (No such file or directory); give a file written by trihedron benchmark --json"),
    ],
)
def test_benchmarks_of_the_wheel(words, code, said, wheel, tmp_path):
    """Those of the source checkout say so in one line; the others are there."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    command = [sys.executable, "-m", "trihedron", "benchmark", *words.split()]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == code and done.stderr.startswith(f"trihedron: {said}") and done.stderr.count("\n") == 1, done.stderr


def installed(wheel: Path, folder: Path, *, with_dependencies: bool, requirements: Path | None = None) -> Path:
    """A new environment that holds the wheel; without dependencies of its own it has those of a file, else borrows those of this one. Returns its
    bin folder."""
    venv.create(folder, with_pip=True, symlinks=True)
    python, locked = folder / "bin" / "python", ["--constraint", str(ROOT / "constraints.txt")]
    if requirements is not None:
        subprocess.run([python, "-m", "pip", "install", "--quiet", *locked, "--requirement", requirements], check=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", *(locked if with_dependencies else ["--no-deps"]), wheel], check=True)
    if not with_dependencies and requirements is None:
        site = subprocess.run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], capture_output=True, text=True, check=True)
        borrowed = Path(site.stdout.strip()) / "borrowed.pth"
        borrowed.write_text(f"import sys; sys.path.append({sysconfig.get_path('purelib')!r})\n")
    return folder / "bin"


def run(command: Path, *words: str, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run([command, *words], cwd=folder, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def check_installation(programs: Path, folder: Path) -> None:
    """Use the installed program from another folder; no top-level name but `trihedron` may have come with it."""
    folder.mkdir()
    where = run(programs / "python", "-c", "import trihedron.pipeline.app.cli as m; print(m.__file__)", folder=folder)
    assert Path(where.strip()).is_relative_to(programs.parent.resolve())
    for name in (*FOLDERS, "tests"):
        assert not list(programs.parent.glob(f"lib/*/site-packages/{name}")), name
    text = run(programs / "trihedron", "--help", folder=folder)
    assert all(f"\n  {name} " in text for name in ("run", "evaluate", "plugins", "topics", "convert"))
    slots = json.loads(run(programs / "trihedron", "plugins", "--json", folder=folder))["slots"]
    assert {"synthetic", "tum", "icl_nuim", "folder", "mcap"} <= {plugin["name"] for plugin in slots[0]["plugins"]}


def run_five_frames(programs: Path, folder: Path, *words: str) -> None:
    run(programs / "trihedron", "run", "dataset=synthetic", "dataset.frames=0:5", "out=five", *words, folder=folder)
    assert json.loads((folder / "five" / "timing.json").read_text())["frames"] == 5


@pytest.mark.slow
def test_wheel_in_an_empty_environment(wheel, tmp_path):
    """Two stages only: a new environment compiles its kernels anew, and all of them take more than a minute."""
    programs = installed(wheel, tmp_path / "env", with_dependencies=False)
    check_installation(programs, tmp_path / "elsewhere")
    run_five_frames(programs, tmp_path / "elsewhere", "outputs=[keypoints]")
    measured = run(programs / "trihedron", "benchmark", "dataset.frames=0:5", "outputs=[keypoints]", folder=tmp_path / "elsewhere")
    assert "5 frames, " in measured and "throughput " in measured
    topics = run(programs / "trihedron", "topics", "five/run.mcap", folder=tmp_path / "elsewhere")
    assert ["/keypoints", "trihedron.Keypoints", "5"] in [line.split()[:3] for line in topics.splitlines()]


@pytest.mark.slow
def test_wheel_with_its_own_dependencies(wheel, tmp_path):
    programs = installed(wheel, tmp_path / "env", with_dependencies=True)
    check_installation(programs, tmp_path / "elsewhere")
    run_five_frames(programs, tmp_path / "elsewhere")
    assert len([line for line in (tmp_path / "elsewhere" / "five" / "trajectory.txt").read_text().splitlines() if line[0] != "#"]) == 5


@pytest.mark.slow
def test_wheel_with_the_minimal_requirements(wheel, tmp_path):
    """The default graph runs, and what needs another library names it."""
    programs = installed(wheel, tmp_path / "env", with_dependencies=False, requirements=ROOT / "requirements-minimal.txt")
    run_five_frames(programs, tmp_path, "outputs=[trajectory,surface]")
    done = subprocess.run([programs / "trihedron", "run", "planes=open3d_ransac"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, "trihedron: open3d-cpu: is not installed; install it with: pip install open3d-cpu")
