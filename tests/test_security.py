"""What SECURITY.md promises: no code from data, no file outside the data set's folder is read, none outside the run folder is written."""

import ast
import errno
import json
import os
import re
import subprocess
import sys
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import Writer
from omegaconf import OmegaConf

import trihedron
from trihedron.comparison.other_programs import _kitti_poses
from trihedron.datasets.readers.foxglove_messages import UnreadableMessage, reader
from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import compose_run
from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.core.files import new_file, read_file, write_file
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Camera, FrameReference, Pose
from trihedron.pipeline.record.codec import FORMAT, METADATA
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.replay import Replay
from trihedron.tools.download import _read_calibration

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
FORBIDDEN = {  # names that run or load what data say; of attributes the object too
    "eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "cPickle", "dill", "joblib.load", "marshal.loads", "shelve.open",
    "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system", "os.popen", "torch.load", "hydra.utils.instantiate", "instantiate",
    "hydra.utils.get_class", "OmegaConf.register_new_resolver",
}  # fmt: skip
COMPUTED_IMPORTS = {  # files that import by a name that is not written in the call, and where the name comes from
    "pipeline/app/calibrated_run.py": "the installed entry point of trihedron calibrate",
    "pipeline/app/cli.py": "the installed entry points",
    "pipeline/core/registry.py": "the packages' own folders and the installed entry points",
    "tools/benchmark.py": "a table in the file",
}
PICKLING = {"pipeline/sweep/cluster.py": "jobs of a sweep, from its own process"}
NAMING_CLASSES = {"pipeline/core/config.py": "what Hydra runs sweeps with, from constants in the file"}


def dotted(node):
    """`yaml.safe_load` of a call's function, as written."""
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def test_no_code_comes_from_data():
    for path in FILES:
        check_calls(path)


def check_calls(path):
    name, tree = str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert not {dotted(call.func) for call in calls} & FORBIDDEN, name
    imported = {alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {(node.module or "").split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert name in PICKLING or not imported & {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve"}, name
    keywords = {(word.arg, getattr(word.value, "value", None)) for call in calls for word in call.keywords}
    assert ("shell", True) not in keywords and ("allow_pickle", True) not in keywords, name
    for call in calls:
        if dotted(call.func) in ("np.load", "numpy.load"):
            assert ("allow_pickle", False) in {(word.arg, getattr(word.value, "value", None)) for word in call.keywords}, name
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
        len(Tum(path=str(tmp_path), camera="tum_fr3"))
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
    mine, plain = composed_run(Recording(file), ["out=x"]), compose_run(["dataset.seed=3", "seed=5", "out=x"])
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
    made = compose_run(words)
    recorded = Recording(recording(tmp_path / "run.mcap", OmegaConf.to_yaml(made, resolve=True)))
    same = composed_run(recorded)
    assert all(same[slot] == made[slot] for slot in (*SLOTS, "graph", "outputs", "seed"))
    assert composed_run(recorded, ["manhattan.cone_deg=8"]).manhattan.cone_deg == 8.0
    swapped = composed_run(recorded, ["manhattan=branch_and_bound", "bundle=local_window", "dataset=synthetic"])
    assert (swapped.manhattan.plugin, swapped.bundle.plugin, swapped.dataset.plugin) == ("branch_and_bound", "local_window", "synthetic")
    assert swapped.planes.rounds == 2 and swapped.manhattan.cone_deg == 12.0
    other = composed_run(recorded, ["graph=points", "without=relocalise"])
    assert other.dataset.path == "/data" and other.graph == compose_run(["graph=points"]).graph and other.relocalise.plugin == "none"
    assert compose_run([]).manhattan.cone_deg == 12.0 and compose_run([]).dataset.plugin == "synthetic"  # nothing stays of it


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


def test_a_number_for_bytes_asks_for_no_memory():
    """`bytes(number)` has as many zeros; JSON of a stranger may hold 10¹² there."""
    read = reader("foxglove.CompressedImage", "json")
    text = {"timestamp": {"sec": 0, "nsec": 0}, "frame_id": "a", "format": "png", "data": 10**12}
    with pytest.raises(UnreadableMessage, match=r"^is no foxglove.CompressedImage$"):
        read(json.dumps(text).encode())
    assert read(json.dumps(text | {"data": "AAE="}).encode()).data == b"\0\1"


def test_a_position_beyond_any_place_is_refused(tmp_path, capsys):
    """Its square is infinite, and no alignment exists."""
    far = tmp_path / "far.txt"
    far.write_text("".join(f"{i} {sign}1e308 0 0 0 0 0 1\n" for i, sign in enumerate(["", "-", "", "-"])))
    assert main(["evaluate", str(far), str(far)]) == 1
    line = f"trihedron: {far}:1: the position is beyond 1e+09 m; each line holds 'stamp tx ty tz qx qy qz qw'; correct or remove this one\n"
    assert capsys.readouterr().err == line


def test_tools_check_the_rows_that_recorded_values_name(tmp_path, capsys):
    """A recording whose matches name a keypoint that is not there is one line for a tool as for a replay."""
    path = tmp_path / "run.mcap"
    words = ["dataset.width=160", "dataset.height=120", "dataset.length=4", f"out={tmp_path}/run"]
    assert main(["run", *words]) == 0
    source, writer = Recording(tmp_path / "run" / "run.mcap"), RecordingWriter(path, {"overrides": "[]", "config": "seed: 0"})
    for topic in ("frames", "keypoints", "planes", "tracks", "matches", "pose", "map"):
        for value in source.values(topic):
            if topic == "matches" and len(value.keypoints):
                value = replace(value, keypoints=np.full_like(value.keypoints, 2**24))
            writer.write(topic, value)
    writer.close()
    capsys.readouterr()
    assert main(["calibrate", str(path)]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"trihedron: {path}: topic /matches, frame 1: the field 'keypoints' names row 16777216 of keypoints"), line


def test_a_small_file_takes_little_memory(tmp_path):
    """The bound of a mesh is 2 GB; reading a small one must not allocate that."""
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    tracemalloc.start()
    try:
        assert len(read_file(tmp_path / "mesh.obj", 2**31)) == 32
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
    assert read_file(Path("/proc/self/status"), 2**20).startswith(b"Name:")  # of unknown size


def test_a_pipe_is_no_recording(tmp_path, capsys):
    """Whoever opens one to read waits for a writer, who never comes."""
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    for command in (["recover", str(pipe)], ["topics", str(pipe)], ["diff", str(pipe), str(pipe)], ["run", f"replay={pipe}"]):
        assert main(command) == 1
        line = f"trihedron: {pipe}: cannot be read: it is not a regular file; give the path of an MCAP file\n"
        assert capsys.readouterr().err == line


def test_every_reader_of_a_recording_gets_checked_values(tmp_path, capsys):
    """Reports, exports and the Python API look values up by what is recorded: a status that is none, axes that are no rotation."""
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, {"overrides": "[]", "config": "seed: 0", "topics": "[" * 100_000})
    pose = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "dancing", "")
    writer.write("frames", FrameReference(0, 0, Camera(8, 6, 4.0, 4.0, 3.5, 2.5)))
    writer.write("pose", pose)
    writer.close()
    recording = Recording(path)
    fault = f"{path}: topic /pose, frame 0: the field 'status' is none of ok, degraded, lost; the file is damaged; record it again"
    for read in (lambda: list(recording.values("pose")), lambda: recording.frame(0), lambda: trihedron.Recording(path).poses):
        with pytest.raises(RecordingError) as caught:
            read()
        assert str(caught.value) == fault
    assert main(["export", str(path), "--to", "csv", "--out", str(tmp_path / "table")]) == 1
    assert capsys.readouterr().err == f"trihedron: {fault}\n"
    assert Replay(recording, ()).topics == {"frames", "pose"}  # what its metadata nests deeply is no list of topics


@pytest.mark.parametrize("text", ["fx fy cx cy", "1 2 3", "1 2 3 4", ""])
def test_the_calibration_of_an_archive_is_data(tmp_path, text):
    """Numbers that are none, and an image that claims to be huge."""
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\x02\0\0\0")
    (tmp_path / "calibration.txt").write_text(text)
    with pytest.raises(DataError, match=r"calibration\.txt: .*; write a camera\.yaml there$"):
        _read_calibration(tmp_path)


def test_numbers_of_another_program_beyond_any_place_are_refused(tmp_path):
    """Their products are infinite, and no alignment exists."""
    with pytest.raises(DataError) as caught:
        _kitti_poses(tmp_path / "far.txt", [(1, ["0"] * 12), (2, ["1e308"] * 12)])
    assert str(caught.value) == f"{tmp_path}/far.txt:2: a number is beyond 1e+09; each line holds the 12 numbers of a pose, metres"


def test_a_covariance_whose_square_is_infinite_is_refused(tmp_path, capsys):
    """It is finite, and what is computed of it printed warnings of NumPy."""
    writer = RecordingWriter(tmp_path / "run.mcap", {"overrides": "[]"})
    writer.write("frames", FrameReference(0, 0, Camera(8, 6, 4.0, 4.0, 3.5, 2.5)))
    writer.write("pose", Pose(0, 0, np.eye(4), np.full((6, 6), 1.79e308), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", ""))
    writer.close()
    assert main(["evaluate", str(tmp_path / "run.mcap"), "--no-reference"]) == 1
    place = f"{tmp_path}/run.mcap: topic /pose, frame 0"
    line = f"trihedron: {place}: the field 'covariance' holds numbers beyond 1e+100; the file is damaged; record it again\n"
    assert capsys.readouterr().err == line


LINKED = ("run.mcap", "trajectory.txt", "trajectory_causal.txt", "metrics.json", "timing.json", "surface.ply")
LINKED_BUILDING = ("building.json", "floorplan.svg", "floorplan.dxf", "building.glb")


def plant_links(folder, names):
    """Make links of these names in a folder, to files that are not the run's; return the files."""
    folder.mkdir()
    for name in names:
        target = folder.parent / f"mine-{Path(name).name}"
        target.write_text("mine")
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(target)
    return sorted(folder.parent.glob("mine-*"))


def test_a_run_writes_through_no_link(tmp_path):
    """An archive may hold a run folder with links to files of whoever unpacks it and runs there again."""
    mine = plant_links(tmp_path / "run", [*LINKED, *LINKED_BUILDING, "map.mcap", "map.mcap.part", ".hydra/config.yaml", ".hydra/overrides.yaml"])
    words = ["dataset.width=160", "dataset.height=120", "dataset.length=4", f"out={tmp_path}/run", "outputs=[trajectory,surface,building]"]
    assert main(["run", *words, f"save_map={tmp_path}/run/map.mcap"]) == 0
    assert len(mine) == 14 and {path.read_text() for path in mine} == {"mine"}
    links = [path.name for path in (tmp_path / "run").rglob("*") if path.is_symlink()]
    assert links == ["map.mcap.part"]
    assert not list((tmp_path / "run").glob(".trihedron-*"))
    assert len(list(Recording(tmp_path / "run" / "run.mcap").values("pose"))) == 4


def test_a_configuration_is_not_written_into_a_linked_folder(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "run" / ".hydra").symlink_to(tmp_path / "mine")
    assert main(["run", "dataset.length=4", f"out={tmp_path}/run"]) == 1
    line = f"trihedron: out: the folder cannot be written: it is a link: {tmp_path}/run/.hydra; give another out=FOLDER\n"
    assert capsys.readouterr().err == line and not list((tmp_path / "mine").iterdir())


def test_a_recording_that_is_rewritten_follows_no_link(tmp_path):
    """Neither the file nor one beside it whose name can be known: `recover` and `convert` wrote FILE.part before."""
    seed = ROOT / "tests" / "fuzz" / "seeds" / "own.mcap"
    mine = plant_links(tmp_path / "run", ["run.mcap.part", "run.part", "out.mcap", "new.mcap", "new.mcap.part"])
    (tmp_path / "run" / "run.mcap").write_bytes(seed.read_bytes())
    before = len(list(Recording(seed).values("frames")))
    assert main(["recover", str(tmp_path / "run" / "run.mcap")]) == 0
    assert main(["recover", str(seed), "--out", str(tmp_path / "run" / "out.mcap")]) == 0
    older = ROOT / "tests" / "pipeline" / "recordings" / "format_5.mcap"
    assert main(["convert", str(older), str(tmp_path / "run" / "new.mcap"), "--overwrite"]) == 0
    for name in ("run.mcap", "out.mcap"):
        assert len(list(Recording(tmp_path / "run" / name).values("frames"))) == before and not (tmp_path / "run" / name).is_symlink()
    assert {path.read_text() for path in mine} == {"mine"}


def test_a_result_is_whole_or_as_it_was(tmp_path):
    """What fails while it is written leaves the file of before, and nothing beside it."""
    path = tmp_path / "metrics.json"
    path.write_text("before")
    with pytest.raises(OSError, match="No space left") as caught, new_file(path) as new:
        new.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(path)
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
    write_file(path, "after")
    assert path.read_text() == "after" and list(tmp_path.iterdir()) == [path]
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_standard_output_is_written_not_replaced(tmp_path):
    """/dev/stdout is a link: whoever may would replace it."""
    code = "from pathlib import Path; from trihedron.pipeline.core.files import write_file; write_file(Path('/dev/stdout'), 'table')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "table" and Path("/dev/stdout").is_symlink()
    with pytest.raises(OSError, match="it is not a regular file: '/dev/null'"), new_file(Path("/dev/null")):
        pass


def test_a_pipe_in_the_place_of_a_recording_is_refused(tmp_path):
    os.mkfifo(tmp_path / "run.mcap")
    with pytest.raises(RecordingError) as caught:
        RecordingWriter(tmp_path / "run.mcap", {})
    assert str(caught.value) == f"{tmp_path}/run.mcap: cannot be written: it is not a regular file; give another out=FOLDER"
