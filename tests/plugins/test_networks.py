"""Networks in ONNX files: small ones that the tests build track a room; a missing, wrong or changed one is one line."""

import hashlib
import json
import sys
from functools import partial

import numpy as np
import pytest
from small_networks import answering, corner_detector, nearest_matcher, network_words

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import ConfigError, LibraryError
from trihedron.pipeline.record.reader import Recording
from trihedron.plugins.keypoints.onnx import OnnxKeypoints
from trihedron.plugins.lines.onnx import LineOutput, OnnxLines
from trihedron.plugins.normals.onnx import OnnxNormals
from trihedron.plugins.planes.onnx import OnnxPlanes
from trihedron.plugins.shared.networks import bytes_of, vectors_of

ROOM = ["dataset.width=320", "dataset.height=240", "dataset.length=20"]
FRAME = Synthetic(length=2, width=320, height=240)(0)


@pytest.mark.slow
def test_the_room_is_tracked_by_learned_features(tmp_path):
    """Corners by convolutions and nearest neighbours; the replay demands the same file."""
    corners, matcher = corner_detector(tmp_path / "corners.onnx"), nearest_matcher(tmp_path / "matcher.onnx")
    words = ["keypoints=onnx", f"keypoints.model={corners}", "tracks=onnx_lightglue", f"tracks.model={matcher}"]
    assert main(["run", *ROOM, *words, f"out={tmp_path / 'run'}"]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["status"]["ok"] == 20 and metrics["final"]["ate_rmse_m"] < 0.005
    again = ["run", f"replay={tmp_path / 'run' / 'run.mcap'}", "only=[keypoints]", f"out={tmp_path / 'again'}"]
    assert main(again) == 0
    first, second = (list(Recording(tmp_path / name / "run.mcap").values("keypoints")) for name in ("run", "again"))
    assert len(first) == 20 and all(np.array_equal(a.descriptors, b.descriptors) for a, b in zip(first, second))


@pytest.mark.slow
def test_a_replay_demands_the_same_network(tmp_path, capsys):
    corners = corner_detector(tmp_path / "corners.onnx")
    first = hashlib.sha256(corners.read_bytes()).hexdigest()
    assert main(["run", *ROOM, "dataset.length=4", "keypoints=onnx", f"keypoints.model={corners}", f"out={tmp_path / 'run'}"]) == 0
    corner_detector(corners, count=200)
    second = hashlib.sha256(corners.read_bytes()).hexdigest()
    capsys.readouterr()
    again = ["run", f"replay={tmp_path / 'run' / 'run.mcap'}", "only=[keypoints]", f"out={tmp_path / 'again'}"]
    assert main(again) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"trihedron: keypoints.model: {corners} has the SHA-256 {second[:12]}…, and {first[:12]}… is required; "
        "give the file of the recorded run, or keypoints.sha256= to take another"
    )
    assert main([*again, "keypoints.sha256="]) == 0


def points(channels, folder, width=2, value=0.0):
    """A network whose key points have `width` coordinates of this value."""
    answers = {"scores": np.zeros((1, 5)), "descriptors": np.zeros((1, 5, 8))}
    return answering(folder / "a.onnx", channels, keypoints=np.full((1, 5, width), value), **answers)


def silent(folder):
    return answering(folder / "a.onnx", 1, keypoints=np.zeros((1, 5, 2)))


def text(folder):
    (folder / "text.onnx").write_text("no network")
    return folder / "text.onnx"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: "", "keypoints.model: no network is given; give keypoints.model=FILE.onnx; "),
        (lambda folder: folder / "none.onnx", "keypoints.model: {path} cannot be read: No such file or directory; give keypoints.model=FILE.onnx; "),
        (text, "keypoints.model: {path} is no network that ONNX Runtime can run: "),
        (partial(points, 3), "keypoints.model: {path} takes 'image' as (1, 3, 'h', 'w'), and (1, 1, 240, 320) is given; "),
        (partial(points, 1, width=3), "keypoints.model: {path} gives 'keypoints' as (1, 5, 3), and (n, 2) is required; "),
        (partial(points, 1, value=np.nan), "keypoints.model: {path} gives 'keypoints' that is not finite; "),
        (silent, "keypoints.model: {path} has no output 'scores', only keypoints; "),
    ],
)
def test_a_wrong_network_is_one_line(change, message, tmp_path):
    path = str(change(tmp_path))
    with pytest.raises(ConfigError) as error:
        OnnxKeypoints(model=path)(FRAME)
    assert str(error.value).startswith(message.format(path=path))
    assert "\n" not in str(error.value)


def test_without_onnx_runtime_it_is_one_line(tmp_path, monkeypatch):
    corners = corner_detector(tmp_path / "corners.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(LibraryError) as error:
        OnnxKeypoints(model=str(corners))(FRAME)
    assert str(error.value) == "onnxruntime: is not installed; install it with: pip install 'trihedron[onnx]'"


def test_key_points_are_where_the_network_says(tmp_path):
    """Those outside the image are left out; the best come first; a fixed size is another scale."""
    found = np.array([[[10.0, 20.0], [100.0, 50.0], [500.0, 20.0]]])
    descriptors = np.eye(3, 64)[None]
    path = answering(tmp_path / "a.onnx", 1, keypoints=found, scores=np.array([[0.2, 0.9, 1.0]]), descriptors=descriptors)
    keypoints = OnnxKeypoints(model=str(path))(FRAME)
    assert keypoints.pixels.tolist() == [[100.0, 50.0], [10.0, 20.0]]
    assert keypoints.metric == "l2" and keypoints.descriptors.shape == (2, 128)
    assert np.allclose(vectors_of(keypoints.descriptors, 64), descriptors[0, [1, 0]], atol=0.01)


def test_bytes_of_unit_vectors():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(50, 256)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    assert np.abs(vectors_of(bytes_of(5.0 * vectors), 256) - vectors).max() < 0.003
    apart = np.linalg.norm(bytes_of(vectors).astype(float)[0] - bytes_of(vectors).astype(float)[1]) / 256.0
    assert apart == pytest.approx(np.linalg.norm(vectors[0] - vectors[1]), abs=0.01)


def test_lines_by_segments_and_by_a_distance_field(tmp_path):
    segment = np.array([[[40.0, 60.0, 240.0, 61.0]]])
    path = answering(tmp_path / "lines.onnx", 1, lines=segment, scores=np.array([[0.9]]))
    near = OnnxLines(model=str(path))(FRAME)
    assert len(near.endpoints_px) <= 1
    rows = np.abs(np.arange(224)[:, None] - 100.0) * np.ones((1, 320))
    path = answering(tmp_path / "field.onnx", 1, df=rows[None])
    traced = OnnxLines(model=str(path), output=LineOutput.distance_field)._trace(rows.astype(np.float32))
    assert len(traced) == 1 and np.allclose(traced[0, [1, 3]], 100.0, atol=1.0) and abs(traced[0, 0] - traced[0, 2]) > 250.0
    assert OnnxLines(model=str(path), output=LineOutput.distance_field)(FRAME).descriptors.shape[1] == 32


def test_planes_of_masks_are_fitted_to_the_depth(tmp_path):
    """Masks of two planes give these planes."""
    from trihedron.plugins.normals.integral_image import IntegralImage
    from trihedron.plugins.planes.connected_components import ConnectedComponents

    normals = IntegralImage()(FRAME)
    truth = ConnectedComponents()(FRAME, normals)
    masks = np.stack([np.kron(truth.labels == k + 1, np.ones((truth.stride, truth.stride))) for k in range(2)])[None].astype(np.float32)
    path = answering(tmp_path / "masks.onnx", 3, masks=masks[:, :, :224], scores=np.array([[0.9, 0.9]]))
    found = OnnxPlanes(model=str(path))(FRAME, normals)
    assert len(found.coefficients) >= 2
    for plane in truth.coefficients[:2]:
        assert np.abs(found.coefficients - plane).max(axis=1).min() < 0.02


def test_normals_face_the_camera(tmp_path):
    given = np.zeros((1, 3, 60, 80))
    given[0, 2] = 2.0
    path = answering(tmp_path / "normals.onnx", 3, normals=given)
    value = OnnxNormals(model=str(path))(FRAME)
    seen = np.isfinite(value.normals[..., 0])
    assert value.normals.shape == (60, 80, 3) and np.allclose(value.normals[seen], [0.0, 0.0, -1.0])
    assert not seen[(FRAME.depth_m[::4, ::4] == 0.0)].any() and seen.mean() > 0.8


def test_places_are_remembered_in_the_value(tmp_path):
    """A keyframe's descriptor is recorded with it, ranks keyframes, and corrects nothing by itself."""
    words = ["loop=onnx_descriptor", *network_words("loop", tmp_path), "outputs=[trajectory,loop]", "map.min_turn_deg=0.5", "map.min_shift=0.01"]
    assert main(["run", *ROOM, *words, f"out={tmp_path / 'run'}"]) == 0
    values = list(Recording(tmp_path / "run" / "run.mcap").values("loop"))
    keyframes = list(Recording(tmp_path / "run" / "run.mcap").values("map"))[-1].keyframes
    assert len(values) >= 3 and [len(value.places) for value in values] == list(range(1, len(values) + 1))
    assert values[-1].places.shared("keyframe").tolist() == list(range(len(values))) and len(values) <= len(keyframes)
    assert np.allclose(np.linalg.norm(values[-1].places.shared("descriptor"), axis=1), 1.0, atol=1e-5)
    assert not any(len(value.keyframe_ids) for value in values)


def test_libraries_are_not_imported_before_they_are_asked_for():
    import subprocess

    program = (
        "import sys; from trihedron.pipeline.core.registry import load_plugins; load_plugins(); "
        "assert not {'open3d', 'pycolmap', 'onnxruntime'} & set(sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True).returncode == 0
