"""What SECURITY.md promises: no code from data, no file outside the data set's folder is read, none outside the run folder is written."""

import ast
import json
import re
from dataclasses import fields
from pathlib import Path

import pytest
from mcap.writer import Writer

from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import FrameReference
from trihedron.pipeline.record.codec import FORMAT, METADATA

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
FORBIDDEN = {  # names that run or load what data say; of attributes the object too
    "eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "cPickle", "dill", "joblib.load", "marshal.loads", "shelve.open",
    "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system", "os.popen", "torch.load", "hydra.utils.instantiate", "instantiate",
    "hydra.utils.get_class", "OmegaConf.register_new_resolver",
}  # fmt: skip
COMPUTED_IMPORTS = {  # files that import by a name that is not written in the call, and where the name comes from
    "pipeline/cli.py": "the installed entry points",
    "pipeline/kernels.py": "a list beside the file",
    "pipeline/registry.py": "the packages' own folders and the installed entry points",
    "tools/benchmark.py": "a table in the file",
}
PICKLING = {"pipeline/cluster.py": "jobs of a sweep, from its own process"}
NAMING_CLASSES = {"pipeline/config.py": "what Hydra runs sweeps with, from constants in the file"}


def dotted(node):
    """`yaml.safe_load` of a call's function, as written."""
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_code_comes_from_data(path):
    name, tree = str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert not {dotted(call.func) for call in calls} & FORBIDDEN
    imported = {alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {(node.module or "").split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert name in PICKLING or not imported & {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve"}
    keywords = {(word.arg, getattr(word.value, "value", None)) for call in calls for word in call.keywords}
    assert ("shell", True) not in keywords and ("allow_pickle", True) not in keywords
    for call in calls:
        if dotted(call.func) in ("np.load", "numpy.load"):
            assert ("allow_pickle", False) in {(word.arg, getattr(word.value, "value", None)) for word in call.keywords}
        if dotted(call.func).endswith("import_module") and not isinstance(call.args[0], ast.Constant):
            assert name in COMPUTED_IMPORTS, f"{name}:{call.lineno} imports by a computed name"


def test_no_configuration_names_a_class():
    for path in (*(ROOT / "conf").rglob("*.yaml"), *FILES):
        assert str(path.relative_to(ROOT)) in NAMING_CLASSES or not re.search(r"\b_target_\b", path.read_text(encoding="utf-8")), path


OUTSIDE = ["../secret.png", "/etc/passwd", "rgb/../../secret.png", "./.././x.png", ".."]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("file", ["rgb.txt", "depth.txt"])
def test_a_list_names_no_file_elsewhere(tmp_path, name, file):
    (tmp_path / "rgb.txt").write_text("1.0 rgb/1.png\n")
    (tmp_path / "depth.txt").write_text("1.0 depth/1.png\n")
    (tmp_path / file).write_text(f"1.0 {name}\n")
    with pytest.raises(DataError) as caught:
        len(Tum(path=str(tmp_path)))
    assert str(caught.value) == f"{tmp_path}/{file}:1: the file '{name}' is outside the folder of the list; put the images below that folder"


@pytest.mark.parametrize("line", ["1 depth/1.png 1 /etc/rgb.png", "1 ../depth/1.png 1 rgb/1.png"])
def test_associations_name_no_file_elsewhere(tmp_path, line):
    (tmp_path / "associations.txt").write_text(line + "\n")
    with pytest.raises(DataError, match="is outside the folder of the list"):
        len(IclNuim(path=str(tmp_path)))


def test_a_dotted_name_within_the_folder_is_one(tmp_path):
    (tmp_path / "rgb.txt").write_text("1.0 ./rgb/../rgb/1.png\n")
    (tmp_path / "depth.txt").write_text("1.0 depth/..1.png\n")
    (tmp_path / "camera.yaml").write_text("{width: 32, height: 24, fx: 30, fy: 30, cx: 15, cy: 11, depth_scale: 1000}")
    assert len(Tum(path=str(tmp_path))) == 1


def recording(path, *overrides):
    """An MCAP file that says it is a recording made with these overrides."""
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(library="stranger")
        writer.add_metadata(METADATA, {"format": FORMAT, "overrides": json.dumps(overrides), "config": "", "version": "0", "commit": ""})
        writer.finish()
    return path


HOSTILE = [
    "hydra.run.dir=/tmp/elsewhere", "hydra.output_subdir=../../elsewhere", "+hydra.callbacks.x._target_=os.system", "hydra/launcher=joblib",
    "hydra.sweep.dir=/", "+hydra.job.env_set.LD_PRELOAD=/tmp/x.so", "hydra.searchpath=[file:///tmp]", "--config-dir=/tmp", "-m",
    "dataset.path=${oc.env:HOME}", "++hydra.mode=MULTIRUN", "defaults=[]", "~hydra", "/hydra/job_logging=default",
    "+dataset@hydra.run=synthetic",
]  # fmt: skip


@pytest.mark.parametrize("word", HOSTILE)
def test_a_recording_has_no_say_in_the_program_itself(tmp_path, capsys, monkeypatch, word):
    monkeypatch.chdir(tmp_path)
    file = recording(tmp_path / "hostile.mcap", "dataset=synthetic", word)
    assert main(["run", f"replay={file}", "out=replayed"]) == 1
    cure = "which a recording has no say in; give that on the command line if you trust it"
    assert capsys.readouterr().err == f"trihedron: {file}: was made with '{word}', {cure}\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hostile.mcap"]  # nothing was written


@pytest.mark.parametrize("word", ["out=/tmp/elsewhere", "save_map=/tmp/elsewhere.mcap", "report=compare", "replay=other.mcap"])
def test_what_belongs_to_one_run_is_not_taken_from_a_recording(tmp_path, monkeypatch, word):
    monkeypatch.chdir(tmp_path)
    from trihedron.pipeline.app.cli import _with_recorded

    file = recording(tmp_path / "hostile.mcap", "dataset.seed=3", word)
    assert _with_recorded([f"replay={file}"]) == ["dataset.seed=3", f"replay={file}"]


def test_the_frames_of_a_recording_are_no_paths():
    """What a replay iterates over holds a number, a time and a camera: there is nothing in it that could name a file."""
    assert {field.name for field in fields(FrameReference)} == {"index", "stamp_ns", "camera"}


def test_a_run_writes_into_its_folder_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "dataset.width=64", "dataset.height=48", "dataset.length=4", "out=deep/er", "outputs=[trajectory,surface]"]) == 0
    assert {path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*") if path.is_file()} == {("deep", "er")}


def test_what_broke_before_has_an_upper_bound():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    bounds = dict(re.findall(r'"([\w-]+)>=[\d.]+,<([\d.]+)"', text))
    assert {"hydra-core", "opencv-contrib-python-headless"} <= set(bounds)
    assert (ROOT / "SECURITY.md").is_file()
