"""What a newcomer gets wrong: each mistake is one line with place, cause and cure, and the exit code that the README says; never a traceback."""

import warnings

import cv2
import numpy as np
import pytest

import trihedron as th
from trihedron.pipeline.app.cli import main

HELP, SEE = "see trihedron run --help", "see trihedron plugins"
SOURCES = "give a folder, a .mcap, .bag or .r3d file"
NO_PATH = f"is not key=value, and there is no such path in {{here}}; {SOURCES}, or key=value (quote lists: 'only=[pose]')"
MCAP = "is not an MCAP file; give a file that trihedron run or another MCAP writer wrote"
MISTAKES = [  # words of the command, exit code, what is said after "trihedron: "
    ("run threads=abc", 1, f"threads: 'abc' is not a whole number (default 2); {HELP}"),
    ("run threads=", 1, f"threads: '' is not a whole number (default 2); {HELP}"),
    ("run threads=-1", 1, "threads: -1 is not a number of threads; give 1 to 256"),
    ("run dataset=tum dataset.path=~nobody_here/x", 1, "path: begins with ~ and the name of nobody; write ./~NAME for a file of that name"),
    ("run threads=100000", 1, "threads: 100000 is not a number of threads; give 1 to 256"),
    ("run seed=-1", 1, "seed: -1 is negative; give 0 or more"),
    ("run seed=x", 1, f"seed: 'x' is not a whole number (default 0); {HELP}"),
    ("run keypoints=orb,sift", 2, "keypoints: 'orb,sift' is several values; add -m to run once with each, or write a list as [A,B]"),
    ("run map=covisability", 1, "map: there is no plugin 'covisability' for the slot 'map'; did you mean 'covisibility'?"),
    ("run map.min_frames=-1", 1, f"map.min_frames: -1 is not at least 1; {SEE} map covisibility"),
    ("run pose.min_share=2", 1, f"pose.min_share: 2.0 is not within 0 … 1; {SEE} pose refine"),
    ("run pose.min_share=high", 1, f"pose.min_share: 'high' is not a number that is within 0 … 1 (default 0.25); {SEE} pose refine"),
    ("run dataset.width=-5", 1, f"dataset.width: -5 is not within 16 … 8192; {SEE} dataset synthetic"),
    ("run dataset.width=wide", 1, f"dataset.width: 'wide' is not a whole number that is within 16 … 8192 (default 640); {SEE} dataset synthetic"),
    ("run dataset.width=3.5", 1, f"dataset.width: '3.5' is not a whole number that is within 16 … 8192 (default 640); {SEE} dataset synthetic"),
    ("run dataset.motion=fly", 1, f"dataset.motion: 'fly' is not one of walk, fast, still, pan (default walk); {SEE} dataset synthetic"),
    ("run dataset.frames=5", 1, f"dataset.frames: '5' is not a range of frames A:B[:S] with A < B, S > 0; {SEE} dataset synthetic"),
    ("run dataset.frames=3:3", 1, f"dataset.frames: '3:3' is not a range of frames A:B[:S] with A < B, S > 0; {SEE} dataset synthetic"),
    ("run dataset.frames=500:", 1,
     "dataset.frames: '500:' begins beyond the 150 frames of the synthetic room (dataset.length); give a range within 0:150"),
    ("run dataset=tum dataset.path=empty", 1, "empty: is empty; give the folder that holds the images as dataset.path"),
    ("run dataset=tum dataset.path=text.txt", 1, "text.txt: is not a folder; give the folder that holds the images as dataset.path"),
    ("run dataset=folder dataset.path=nowhere", 1, "nowhere: does not exist; give an existing folder as dataset.path"),
    ("run dataset=mcap dataset.path=junk.mcap", 1, f"junk.mcap: {MCAP}"),
    ("run dataset=mcap dataset.path=nowhere.mcap", 1, "nowhere.mcap: cannot be read: No such file or directory; give the path of an MCAP file"),
    ("run dataset=faults dataset.of=tums", 1, "dataset: there is no plugin 'tums' for the slot 'dataset'; did you mean 'tum'?"),
    ("run dataset=faults dataset.cover=9:3", 1, f"dataset.cover: '9:3' is not a range of frames A:B[:S] with A < B, S > 0; {SEE} dataset faults"),
    ("run dataset=faults dataset.moving=3", 1, f"dataset.moving: 3.0 is not within 0 … 1; {SEE} dataset faults"),
    ("run dataset=faults +dataset.options.widht=3", 1,
     f"dataset.options: synthetic has no option 'widht'; did you mean 'width'?; {SEE} dataset faults"),
    ("run graph=structual", 1, "graph: there is no graph 'structual'; did you mean 'structural'?"),
    ("run graph.pose=none", 1, "graph.pose: 'none' is not the wires of a stage; choose a plugin with pose=NAME"),
    ("run graph.pose.foo=pose", 1, "graph.pose.foo: there is no such key; see trihedron run --help"),
    ("run manhatan.cone_deg=8", 1, "manhatan.cone_deg: there is no such key; did you mean 'manhattan'?"),
    ("run outputs=trajectory", 1, "outputs: is not a list; write it as [A,B], quoted for the shell"),
    ("run outputs=[trajectory", 2, "outputs=[trajectory: lacks ] at its end; write 'outputs=[trajectory]'"),
    ("run planes.angle_deg=abc", 1,
     f"planes.angle_deg: 'abc' is not a number that is above 0 and below 90 (default 3.0); {SEE} planes connected_components"),
    ("check planes nope", 1,
     "planes: there is no plugin 'nope' for the slot 'planes'; known: ahc, cape, connected_components, none, "
     "onnx, open3d_patches, open3d_ransac, ransac"),
    ("run outputs=[surfce]", 1, "outputs: no stage writes 'surfce'; did you mean 'surface'?"),
    ("run record.frames=maybe", 1, f"record.frames: 'maybe' is not true or false (default false); {HELP}"),
    ("run localise_only=perhaps", 1, f"localise_only: 'perhaps' is not true or false (default false); {HELP}"),
    ("run localise_only=true", 1, "localise_only: needs a map to find the camera in; give load_map=FILE.mcap too"),
    ("run load_map=nowhere.mcap", 1, "nowhere.mcap: there is no such map; save one with: trihedron run save_map=FILE.mcap"),
    ("run load_map=junk.mcap", 1, f"junk.mcap: {MCAP}"),
    ("run load_map=small/run.mcap", 1, "small/run.mcap: is a recording, not a saved map; save one with: trihedron run save_map=FILE.mcap"),
    ("run save_map=nowhere/map.mcap", 1, "save_map: the folder {here}/nowhere does not exist; make it first"),
    ("run replay=junk.mcap", 1, f"junk.mcap: {MCAP}"),
    ("run replay=empty", 1, "empty/run.mcap: cannot be read: No such file or directory; give the path of an MCAP file"),
    ("run replay=small/run.mcap only=[posse]", 1, "only: this graph has no stage 'posse'; did you mean 'pose'?"),
    ("run replay=small/run.mcap dataset.frames=90:", 1, "small/run.mcap: has none of the frames '90:'; give another dataset.frames"),
    ("run replay=small/run.mcap save_map=x.mcap", 1, "save_map: a replay makes no map to go on from; save the map of the run itself"),
    ("run experiment=leave_on_out", 1, "experiment: there is no experiment 'leave_on_out'; did you mean 'leave_one_out'?"),
    ("run without=legs", 1, "without: there is no without 'legs'; did you mean 'lines'?"),
    ("run out=text.txt/x", 1, "out: the folder cannot be made: Not a directory: {here}/text.txt/x; give another out=FOLDER"),
    ("run out=", 2, "out=: lacks a folder; write key=value, for example out=runs/mine"),
    ("run =3", 2, "=3: lacks a key; write key=value, for example out=runs/mine"),
    ("run a b", 2, f"a: {NO_PATH}"),
    ("run walk.r3d", 2, f"walk.r3d: {NO_PATH}"),
    ("run dataset.path", 2, f"dataset.path: {NO_PATH}"),
    ("run --dry-run", 2, "--dry-run: is of a sweep, and this is one run; add -m to run once with each of several values"),
    ("run dataset.length=60 --out runs/a", 2, "--out: is not an option of run; write out=runs/a"),
    ("run --dataset.length=60", 2, "--dataset.length: is not an option of run; write dataset.length=60"),
    ("run --live small", 2, "--live: is not an option of run; write live=true"),
    ("run --seed", 2, "--seed: is not an option of run; write seed=VALUE"),
    ("run --title walk", 2, "--title: is not an option of run; it belongs to trihedron report and site"),
    ("run --verbose", 2, "--verbose: is not an option of run; known: -m, --multirun, --dry-run; everything else is key=value"),
    ("topics nowhere.mcap", 1, "nowhere.mcap: cannot be read: No such file or directory; give the path of an MCAP file"),
    ("topics junk.mcap", 1, f"junk.mcap: {MCAP}"),
    ("evaluate text.txt", 2, "evaluate: the following arguments are required: TRUTH; see trihedron evaluate --help"),
    ("evaluate-surface small", 1, "small/surface.ply: there is no such file; run with 'outputs=[trajectory,surface]' first"),
    ("picture small/run.mcap --frame 99", 1, "small/run.mcap: has no frame 99; give one of 0..3"),
    ("picture small/run.mcap --frame x", 2, "picture: argument --frame: invalid int value: 'x'; see trihedron picture --help"),
    ("calibrate junk.mcap", 1, f"junk.mcap: {MCAP}"),
    ("benchmark map --parts nothing", 2, "benchmark map: there is no part 'nothing'; known: cover, growth, loop"),
    ("benchmark long --frames 100", 2,
     "benchmark long: there are too few frames for two rows after the warm-up; give more --frames, or a shorter --span"),
    ("benchmark maps", 2, "benchmark: 'maps' is neither key=value, a comparison nor an existing folder; did you mean 'map'?"),
    ("benchmark threads=1 quickly", 2,
     "benchmark: 'quickly' is neither key=value, a comparison nor an existing folder; known: building, detectors, faults, honesty, long, manhattan, "
     "map, methods, parts, recording, rotations, scaling, sensors, surface"),
    ("run +foo=1", 2, "foo: there is no such key to add to; see trihedron run --help"),
    ("run +thread=1", 2, "thread: there is no such key to add to; did you mean 'threads'?"),
    ("compare empty", 1,
     "empty: holds no runs; give the out=FOLDER of a sweep, for example of: trihedron run -m experiment=leave_one_out"),
    ("rum", 2, "rum: there is no such command; did you mean 'run'?"),
]  # fmt: skip


FILES = ["empty", "junk.mcap", "small", "text.txt"]


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with things that are not what a newcomer takes them for, and a small run."""
    folder = tmp_path_factory.mktemp("newcomer")
    (folder / "empty").mkdir()
    (folder / "text.txt").write_text("hello\n")
    (folder / "junk.mcap").write_bytes(b"not an mcap file")
    assert main(["run", "dataset.width=64", "dataset.height=48", "dataset.length=4", f"out={folder}/small"]) == 0
    return folder


@pytest.mark.parametrize("words, code, line", MISTAKES, ids=[words for words, *_ in MISTAKES])
def test_a_mistake_is_one_line(here, monkeypatch, capsys, words, code, line):
    monkeypatch.chdir(here)
    assert main(words.split()) == code
    printed = capsys.readouterr()
    assert printed.err == f"trihedron: {line.format(here=here)}\n"
    assert not printed.out
    assert sorted(path.name for path in here.iterdir()) == FILES  # a refused run leaves no folder behind


def test_depth_in_fifths_of_millimetres_taken_for_metres_is_named_and_the_run_refused(tmp_path, capsys):
    room = th.dataset.synthetic(width=160, height=120, length=8)
    camera = room(0).camera
    for folder, image in (("rgb", lambda frame: frame.color), ("depth", lambda frame: np.rint(5000 * frame.depth_m).astype(np.uint16))):
        (tmp_path / folder).mkdir()
        for k in range(8):
            cv2.imwrite(str(tmp_path / folder / f"{k:06d}.png"), image(room(k)))
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "fps")} | {"depth_scale": 1}
    (tmp_path / "camera.yaml").write_text("".join(f"{name}: {value}\n" for name, value in numbers.items()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of NumPy
        assert main(["run", str(tmp_path), f"out={tmp_path}/run"]) == 1
    printed = capsys.readouterr()
    assert "millimetres taken for metres; give a depth_scale 1000 times as large" in printed.err
    assert "are beyond 1000 m and count as missing; is the depth_scale of the camera right?\n" in printed.err
    assert printed.err.endswith("trihedron: dataset: none of 8 frames has depth; check its images, and the depth_scale of its camera\n")
    assert not (tmp_path / "run").exists()


def test_the_table_is_long_enough():
    assert len(MISTAKES) >= 40 and len({words for words, *_ in MISTAKES}) == len(MISTAKES)
    assert {code for _, code, _ in MISTAKES} == {1, 2}


def test_debug_shows_where_an_error_comes_from(here, monkeypatch):
    monkeypatch.chdir(here)
    with pytest.raises(Exception, match="there is no graph 'structual'") as caught:
        main(["run", "graph=structual", "--debug"])
    assert any(entry.name == "rewritten" or "hydra" in str(entry.path) or entry.name == "_run" for entry in caught.traceback)
