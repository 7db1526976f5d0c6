"""What SECURITY.md promises: no code from data, no file outside the data set's folder is read, none outside the run folder is written."""

import ast
import json
import re
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from mcap.writer import Writer
from omegaconf import OmegaConf

from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import composed
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import FrameReference
from trihedron.pipeline.record.codec import FORMAT, METADATA
from trihedron.pipeline.record.reader import Recording

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
FORBIDDEN = {  # names that run or load what data say; of attributes the object too
    "eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "cPickle", "dill", "joblib.load", "marshal.loads", "shelve.open",
    "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system", "os.popen", "torch.load", "hydra.utils.instantiate", "instantiate",
    "hydra.utils.get_class", "OmegaConf.register_new_resolver",
}  # fmt: skip
COMPUTED_IMPORTS = {  # files that import by a name that is not written in the call, and where the name comes from
    "pipeline/app/cli.py": "the installed entry points",
    "pipeline/core/registry.py": "the packages' own folders and the installed entry points",
    "tools/benchmark.py": "a table in the file",
}
PICKLING = {"pipeline/sweep/cluster.py": "jobs of a sweep, from its own process"}
NAMING_CLASSES = {"pipeline/core/config.py": "what Hydra runs sweeps with, from constants in the file"}


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
    for name in ("rgb/1.png", "depth/..1.png"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    (tmp_path / "rgb.txt").write_text("1.0 ./rgb/../rgb/1.png\n")
    (tmp_path / "depth.txt").write_text("1.0 depth/..1.png\n")
    (tmp_path / "camera.yaml").write_text("{width: 32, height: 24, fx: 30, fy: 30, cx: 15, cy: 11, depth_scale: 1000}")
    assert len(Tum(path=str(tmp_path))) == 1


def recording(path, config, overrides=()):
    """An MCAP file that claims to be a recording of a run with this configuration (YAML)."""
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(library="stranger")
        texts = {"format": FORMAT, "overrides": json.dumps(overrides), "config": config, "version": "0", "commit": ""}
        writer.add_metadata(METADATA, texts)
        writer.finish()
    return path


OTHER = "the file is damaged or of another version; record again"
REFUSED = {  # configuration, message
    "dataset: {plugin: synthetic, _target_: os.system}": f"was made with dataset._target_, an option that this program does not have; {OTHER}",
    "dataset: {_target_: os.system}": f"was made with 'dataset: {{'_target_': 'os.system'}}', which names no plugin; {OTHER}",
    "dataset: synthetic": f"was made with 'dataset: synthetic', which names no plugin; {OTHER}",
    "dataset: {plugin: ../../x}": (
        "was made with dataset=../../x, and there is no such plugin for the slot 'dataset'; install the package that has it"
    ),
    "manhattan: {plugin: tum}": (
        "was made with manhattan=tum, and there is no such plugin for the slot 'manhattan'; install the package that has it"
    ),
    "dataset: {plugin: synthetic, width: wide}": (
        f"was made with dataset.width=wide: Value 'wide' of type 'str' could not be converted to Integer; {OTHER}"
    ),
    "dataset: {plugin: synthetic, width: [1]}": "was made with dataset.width=[1]: ",
    "dataset: {plugin: synthetic, width: -5}": f"was made with a value out of range: dataset.width: -5 is not within 16 … 8192; {OTHER}",
    "dataset: {plugin: synthetic, motion: fly}": (
        f"was made with dataset.motion=fly: Invalid value 'fly', expected one of [walk, fast, still, pan]; {OTHER}"
    ),
    "seed: x": f"was made with seed=x: Value 'x' of type 'str' could not be converted to Integer; {OTHER}",
    "outputs: {a: b}": "was made with outputs=",
    "record: {dir: /tmp}": "was made with record=",
    "graph: ../../x": f"was made with 'graph: ../../x', which holds no wires; {OTHER}",
    "graph: {pose: ../x}": f"was made with 'graph.pose: ../x', which are not wires; {OTHER}",
    "graph: {pose: {frame: '${oc.env:HOME}'}}": "was made with 'graph.pose: {'frame': '${oc.env:HOME}'}', which are not wires",
    "graph: {'../x': {}}": "was made with 'graph.../x: {}', which are not wires",
    "graph: {1: {}}": "was made with 'graph.1: {}', which are not wires",
    "seed: !!python/object/apply:os.system [id]": f"has a configuration that is not YAML (ConstructorError); {OTHER}",
    "seed: 2024-13-45": f"has a configuration that is not YAML (ValueError); {OTHER}",
    "seed: !!int x": f"has a configuration that is not YAML (ValueError); {OTHER}",
    f"seed: {'9' * 5000}": f"has a configuration that is not YAML (ValueError); {OTHER}",
    "seed: [": f"has a configuration that is not YAML (ParserError); {OTHER}",
    "- 1": f"has a configuration that is not a mapping; {OTHER}",
    "a: &a [1]\nb: [*a, *a]": f"has a configuration with aliases or deep nesting; {OTHER}",
    f"seed: {'[' * 90_000}": f"has a configuration with aliases or deep nesting; {OTHER}",
    f"seed: '{'x' * 10_000_000}'": f"has a configuration of 10000008 characters, more than 200000; {OTHER}",
    "dataset: {plugin: faults, options: {path: '???'}}": "was made with dataset.options={'path': '???'}: a missing value",
}


@pytest.mark.parametrize("config", REFUSED, ids=lambda text: text[:60])
def test_a_recorded_configuration_is_known_options_of_registered_plugins(tmp_path, capsys, monkeypatch, config):
    monkeypatch.chdir(tmp_path)
    file = recording(tmp_path / "hostile.mcap", config)
    assert main(["run", f"replay={file}", "out=replayed"]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"trihedron: {file}: {REFUSED[config]}") and line.count("\n") == 1 and len(line) < 600
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hostile.mcap"]  # nothing was written


IGNORED = """
hydra: {run: {dir: /elsewhere}, output_subdir: ../../elsewhere, job: {env_set: {PATH: /tmp}}, callbacks: {x: {_target_: os.system}}}
defaults: [{experiment: ../../x}]
experiment: ../../x
without: ../../x
_target_: os.system
out: /elsewhere
save_map: /elsewhere.mcap
report: compare
sequences: [x]
replay: other.mcap
threads: 100000
live: true
only: [pose]
dataset: {plugin: synthetic, seed: 3}
seed: 5
"""


def test_what_else_a_recording_holds_is_ignored(tmp_path):
    """Neither keys of Hydra's, nor files of configuration, nor where this run writes; overrides are not read at all."""
    from trihedron.pipeline.app.recorded_run import composed_run

    file = recording(tmp_path / "hostile.mcap", IGNORED, ["hydra.run.dir=/elsewhere", "+hydra.callbacks.x._target_=os.system", "-m"])
    mine, plain = composed_run(Recording(file), ["out=x"]), composed(["dataset.seed=3", "seed=5", "out=x"])
    assert OmegaConf.to_yaml(mine) == OmegaConf.to_yaml(plain)


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a\\${oc.env:HOME}", "${out}", "\\\\${out}", "${"])
def test_recorded_text_is_not_interpolated(tmp_path, text):
    from trihedron.pipeline.app.recorded_run import composed_run

    config = {"dataset": {"plugin": "tum", "path": text}, "load_map": text, "outputs": [text]}
    found = composed_run(Recording(recording(tmp_path / "hostile.mcap", yaml.safe_dump(config))))
    assert (found.dataset.path, found.load_map) == (text, text)


def test_the_command_line_comes_on_top_of_a_recording(tmp_path):
    from trihedron.pipeline.app.recorded_run import composed_run

    words = ["manhattan.cone_deg=5", "dataset=tum", "dataset.path=/data", "without=bundle", "planes.rounds=2", "outputs=[trajectory,surface]"]
    made = composed(words)
    recorded = Recording(recording(tmp_path / "run.mcap", OmegaConf.to_yaml(made, resolve=True)))
    same = composed_run(recorded)
    assert all(same[slot] == made[slot] for slot in (*SLOTS, "graph", "outputs", "seed"))
    assert composed_run(recorded, ["manhattan.cone_deg=8"]).manhattan.cone_deg == 8.0
    swapped = composed_run(recorded, ["manhattan=branch_and_bound", "bundle=local_window", "dataset=synthetic"])
    assert (swapped.manhattan.plugin, swapped.bundle.plugin, swapped.dataset.plugin) == ("branch_and_bound", "local_window", "synthetic")
    assert swapped.planes.rounds == 2 and swapped.manhattan.cone_deg == 12.0
    other = composed_run(recorded, ["graph=points", "without=relocalise"])
    assert other.dataset.path == "/data" and other.graph == composed(["graph=points"]).graph and other.relocalise.plugin == "none"
    assert composed([]).manhattan.cone_deg == 12.0 and composed([]).dataset.plugin == "synthetic"  # nothing stays of it


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
