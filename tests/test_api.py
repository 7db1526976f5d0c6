"""The Python API: the example of the README, pushed frames against a folder, arguments that do not fit, one stage alone."""

import subprocess
import sys
from dataclasses import replace
from importlib import metadata

import cv2
import numpy as np
import pytest

import trihedron as th
from trihedron.datasets.simulation.motion import Motion
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core import types
from trihedron.pipeline.core.libraries import distribution_of
from trihedron.pipeline.record import reader
from trihedron.plugins.keypoints.onnx import KeypointNetwork
from trihedron.plugins.shared.calibration_error import calibration_covariance
from trihedron.stages import IMAGES

LENGTH = 24
SMALL = {"width": 160, "height": 120}
CAMERA_FILE = "width: 160\nheight: 120\nfx: 131.25\nfy: 131.25\ncx: 79.5\ncy: 59.5\ndepth_scale: 5000\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The built-in room as a folder of images with a camera file, as `dataset=folder` reads it."""
    path = tmp_path_factory.mktemp("room")
    (path / "camera.yaml").write_text(CAMERA_FILE)
    for name in ("rgb", "depth"):
        (path / name).mkdir()
    room = Synthetic(length=LENGTH, **SMALL)
    for i in range(LENGTH):
        frame = room(i)
        name = f"{1305031102 + frame.stamp_ns / 1e9:.6f}.png"
        cv2.imwrite(str(path / "rgb" / name), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(path / "depth" / name), np.rint(frame.depth_m * 5000).astype(np.uint16))
    return path


def images(path):
    """What a camera loop has: RGB, 16-bit depth, seconds."""
    for file in sorted((path / "rgb").iterdir()):
        rgb = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        yield rgb, cv2.imread(str(path / "depth" / file.name), cv2.IMREAD_UNCHANGED), float(file.stem)


@pytest.fixture(scope="module")
def camera(folder):
    return th.Camera.from_yaml(folder / "camera.yaml")


@pytest.fixture(scope="module")
def slam(camera):
    with th.Slam(camera, "planes=connected_components", "record.frames=true", manhattan="mean_shift", outputs=["trajectory"]) as made:
        yield made


def test_the_covariance_of_a_camera_that_is_known_exactly_has_no_share_of_its_calibration(folder, camera):
    exact = th.CalibrationSigmas(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    poses = []
    for one in (camera, replace(camera, sigmas=exact)):
        with th.Slam(one) as made:
            poses.append([made.track(*image) for image in images(folder)][-1])
    shares = [np.trace(calibration_covariance(pose)) for pose in poses]
    assert shares[0] > 0.0 == shares[1]
    assert np.trace(poses[0].covariance) - np.trace(poses[1].covariance) == pytest.approx(shares[0], rel=0.01)
    with pytest.raises(th.TrihedronError, match="camera: sigmas is float, not CalibrationSigmas; give the numbers of a calibration, in pixels"):
        replace(camera, sigmas=0.01)


@pytest.mark.parametrize("quiet", [False, True])
def test_a_quiet_run_prints_nothing_on_a_terminal(tmp_path, capsys, monkeypatch, quiet):
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    first = th.run("outputs=[planes]", "planes=connected_components", dataset__length=3, out=tmp_path / "first", quiet=quiet)
    printed = capsys.readouterr()
    assert ("3/3" in printed.err, "run.mcap" in printed.out) == (not quiet, not quiet)
    assert not quiet or printed.out + printed.err == ""
    first.recording.replay(only=["planes"], planes={"angle_deg": 3})  # into no folder, and so without a word
    assert "".join(capsys.readouterr()) == ""


def test_importing_the_package_imports_nothing_else():
    """Neither NumPy nor any other library, so that a command that needs none starts at once."""
    program = "import sys; before = set(sys.modules); import trihedron; print(trihedron.__version__, *sorted(set(sys.modules) - before))"
    version, *loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert {name.partition(".")[0] for name in loaded} - sys.stdlib_module_names == {"trihedron"}
    assert version == metadata.version("trihedron")


def test_all_public_names_exist():
    for name in th.__all__:
        assert getattr(th, name) is not None
    assert set(dir(th)) == set(th.__all__)
    with pytest.raises(AttributeError, match="module 'trihedron' has no attribute 'Slamm'"):
        _ = th.Slamm


def test_the_example_of_the_readme(folder, tmp_path, monkeypatch):
    """The seven lines, as they stand."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.yaml").write_text(CAMERA_FILE)
    my_camera = images(folder)

    slam = th.Slam(th.Camera.from_yaml("camera.yaml"), manhattan="mean_shift", outputs=["surface"])
    for rgb, depth, t in my_camera:
        pose = slam.track(rgb, depth, t)
        assert pose.T_world_camera.shape == (4, 4) and pose.covariance.shape == (6, 6)
        assert pose.status == "ok"
        assert len(slam.values["planes"].pixels) == len(slam.values["planes"].coefficients) > 0
    assert len(slam.map.planes) > 0
    mesh = slam.mesh()
    assert len(mesh.triangles) > 100 and len(mesh.coefficients) > 2
    check_conversions(mesh, slam.values["planes"], slam.values["keypoints"], slam.map)
    slam.save("run.mcap")
    slam.save_map("office.mcap")
    slam.trajectory.to_tum("t.txt")
    slam.close()

    assert len((tmp_path / "t.txt").read_text().splitlines()) == LENGTH + 1
    camera = slam.camera
    planes = th.planes.connected_components(angle_deg=3)(depth, camera)
    assert len(planes.pixels) > 0
    run = th.Recording("run.mcap")
    assert run.frames == tuple(range(LENGTH - 10, LENGTH)) and len(run.poses) == LENGTH
    assert [value.index for value in run.values("planes")] == list(run.frames)
    again = run.replay(only=["manhattan"], manhattan="branch_and_bound")
    found = list(again.values("manhattan"))
    assert [value.index for value in found] == list(run.frames)
    assert all(value.supported and value.gap >= 0 for value in found)  # the certificate that mean_shift does not give
    first, second = th.run(f"replay={run.path}", "only=[planes]", out="a"), th.run(f"replay={run.path}", only=["planes"], planes="ahc", out="b")
    assert {len(list(done.recording.values("planes"))) for done in (first, second)} == {10}


def check_conversions(mesh, planes, keypoints, map):
    """The same numbers in Open3D's and trimesh's objects."""
    arrays = mesh.to_numpy()
    np.testing.assert_array_equal(mesh.to_trimesh().faces, arrays["triangles"])
    np.testing.assert_array_equal(mesh.to_trimesh().visual.vertex_colors[:, :3], arrays["colors"])
    found = planes.to_numpy()
    off = np.einsum("ij,ij->i", found["points_m"], found["coefficients"][found["plane"], :3]) + found["coefficients"][found["plane"], 3]
    assert len(off) > 20 and np.abs(off).max() < 0.1
    assert len(planes.to_trimesh().vertices) == len(off)
    assert len(keypoints.to_trimesh().vertices) == np.isfinite(keypoints.points_m[:, 0]).sum()
    assert len(map.to_trimesh().vertices) == map.points.column("alive").sum() > 0
    np.testing.assert_array_equal(np.asarray(mesh.to_open3d().triangles), arrays["triangles"])
    np.testing.assert_array_equal(np.asarray(mesh.to_open3d().vertices), arrays["vertices_m"].astype(float))
    np.testing.assert_array_equal(np.asarray(mesh.to_open3d().vertex_colors), arrays["colors"] / 255.0)
    assert len(th.Surface.empty(0, 0).to_open3d().triangles) == 0
    assert len(planes.to_open3d().points) == len(off)
    assert len(np.unique(np.asarray(planes.to_open3d().colors), axis=0)) == min(len(planes.coefficients), 10)
    assert len(keypoints.to_open3d().points) == np.isfinite(keypoints.points_m[:, 0]).sum()
    np.testing.assert_array_equal(np.asarray(map.to_open3d().points), map.to_numpy()["points_m"])


def test_without_open3d_a_conversion_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    name = distribution_of("open3d")  # of the system
    with pytest.raises(th.TrihedronError, match=rf"^{name}: is not installed; install it with: pip install {name}$"):
        th.Surface.empty(0, 0).to_open3d()


def contents(path):
    """Topic -> messages, of all topics that a replay reads."""
    recording = reader.Recording(path)
    return {topic: list(recording.messages(f"/{topic}")) for topic in sorted(recording.topics)}


@pytest.mark.slow
def test_pushed_frames_give_the_bytes_of_a_folder(folder, camera, tmp_path):
    done = th.run("dataset=folder", dataset__path=folder, outputs=["trajectory", "surface"], out=tmp_path / "folder", quiet=True)
    with th.Slam(camera, outputs=["trajectory", "surface"], out=tmp_path / "pushed", threads=3) as slam:
        for number, (rgb, depth, t) in enumerate(images(folder)):
            slam.track(rgb, depth, t)
            if number == 11:
                slam.save(tmp_path / "half.mcap")
    expected, found = contents(done.folder / "run.mcap"), contents(tmp_path / "pushed" / "run.mcap")
    assert expected.keys() == found.keys() and {"pose", "map", "surface", "frames"} < found.keys()
    for topic, messages in expected.items():
        assert found[topic] == messages, topic
    for file in ("trajectory.txt", "trajectory_causal.txt", "surface.ply"):
        assert (tmp_path / "pushed" / file).read_bytes() == (done.folder / file).read_bytes()
    half = th.Recording(tmp_path / "half.mcap")
    assert half.frames == tuple(range(12)) and len(half.poses) == 12
    with pytest.raises(th.TrihedronError, match=r"does not embed the images that normals must see; record with record\.frames=true"):
        th.Recording(tmp_path / "pushed").replay(only=["normals"])


def test_images_are_embedded_on_request(folder, camera, tmp_path):
    with th.Slam(camera, "record.frames=true", "outputs=[planes]", out=tmp_path) as slam:
        for rgb, depth, t in list(images(folder))[:3]:
            assert slam.track(rgb, depth, t) is slam.values["planes"]  # this graph has no pose
    run = th.Recording(tmp_path)
    np.testing.assert_array_equal(run.image(1).color, list(images(folder))[1][0])
    assert len(list(run.replay(only=["planes"], planes="ransac").values("planes"))) == 3
    with pytest.raises(th.TrihedronError, match=r"has no frame 7; its frames are 0 to 2"):
        run.image(7)


GOOD = np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32)


@pytest.mark.parametrize(
    ("rgb", "depth", "t", "message"),
    [
        (GOOD[0][:, :, 0], GOOD[1], 1.0, "rgb: has no channels; give (h, w, 3), a gray image as np.stack([gray] * 3, axis=-1)"),
        (GOOD[0][::2], GOOD[1], 1.0, "rgb: has the shape (60, 160, 3), the camera's images have (120, 160, 3); give images of the camera's size"),
        (GOOD[0] / 255, GOOD[1], 1.0, "rgb: holds float64, not uint8; give values from 0 to 255 as np.uint8"),
        (GOOD[0], GOOD[1].T, 1.0, "depth: has the shape (160, 120), the camera's images have (120, 160); give images of the camera's size"),
        (
            GOOD[0],
            GOOD[1].astype(int),
            1.0,
            "depth: holds int64, neither metres nor uint16; give float metres, or np.uint16 and the camera's depth_scale",
        ),
        (
            GOOD[0],
            np.where(np.eye(120, 160) > 0, np.nan, GOOD[1]),
            1.0,
            "depth: holds 120 readings that are NaN, infinite or negative; give 0 where there is none: np.nan_to_num(depth)",
        ),
        (
            np.zeros((120, 160, 4), np.uint8),
            GOOD[1],
            1.0,
            "rgb: has the shape (120, 160, 4), the camera's images have (120, 160, 3); give rgb[:, :, :3]",
        ),
        (
            np.zeros((3, 120, 160), np.uint8),
            GOOD[1],
            1.0,
            "rgb: has the shape (3, 120, 160), the camera's images have (120, 160, 3); give the channels last: rgb.transpose(1, 2, 0)",
        ),
        (GOOD[0], GOOD[1][:, :, None], 1.0, "depth: has the shape (120, 160, 1), the camera's images have (120, 160); give depth[:, :, 0]"),
        (*GOOD, "0", "t: is str, not a number of seconds; give the time of the frame in seconds"),
        (*GOOD, "now", "t: is str, not a number of seconds; give the time of the frame in seconds"),
        (*GOOD, float("nan"), "t: is nan; give the time of the frame in seconds, 0 or later"),
        (*GOOD, 1.7e18, "t: is 1.7e+18, too large for seconds; divide nanoseconds by 1e9, milliseconds by 1e3"),
    ],
)
def test_an_argument_that_does_not_fit_is_named(slam, rgb, depth, t, message):
    with pytest.raises(th.TrihedronError) as error:
        slam.track(rgb, depth, t)
    assert str(error.value) == message


def test_settings_and_calls_that_make_no_sense_are_refused(slam, tmp_path):
    with pytest.raises(th.TrihedronError) as error:
        th.Slam(slam.camera, threads=0)
    assert str(error.value) == "threads: 0 is not a number of threads; give 1 to 256"
    with pytest.raises(th.TrihedronError) as error:
        slam.save(tmp_path / "run.mcap")
    assert str(error.value) == "Slam.save: no frame was tracked, so there is nothing to save; call track first"
    assert not (tmp_path / "run.mcap").exists()


def test_time_that_goes_back_is_refused_and_any_strides_are_taken(folder, slam):
    rgb, depth, _ = next(images(folder))
    plain = slam.track(rgb, depth, 10.0)
    with pytest.raises(th.TrihedronError) as error:
        slam.track(rgb, depth, 10.0)
    assert str(error.value) == "t: is 10.000000000 s, not after the frame before, 10.000000000 s; push frames in order of time"
    before = slam.values["keypoints"]
    strided = slam.track(rgb[::-1, ::-1].copy()[::-1, ::-1], np.asfortranarray(depth), 11.0)
    assert (plain.index, strided.index) == (0, 1)
    np.testing.assert_array_equal(slam.values["keypoints"].pixels, before.pixels)
    rgb[:] = 0  # the caller's array stays the caller's
    with pytest.raises(th.TrihedronError, match=r"values\['plane'\]: no stage of this graph writes it; did you mean 'planes'\?"):
        slam.values["plane"]
    with pytest.raises(th.TrihedronError, match=r"outputs: has no surface, so none is made"):
        slam.mesh()


def test_arrays_that_the_caller_uses_again_change_nothing(folder, slam, tmp_path):
    """As a camera's driver does, which writes every image into the same memory: what was pushed is saved later as it was."""
    buffer, pushed = np.empty((120, 160, 3), np.uint8), {}
    for dtype, scale in ((np.float32, 5000.0), (np.float64, 5000.0), (np.uint16, 1.0)):
        depth = np.empty((120, 160), dtype)
        for rgb, raw, _ in list(images(folder))[:2]:
            buffer[:], depth[:] = rgb, raw / scale
            pushed[slam.track(buffer, depth, 100.0 * (len(pushed) + 1)).index] = rgb, raw
            buffer[:], depth[:] = 7, 7
    slam.save(tmp_path / "run.mcap")
    run = th.Recording(tmp_path / "run.mcap")
    for index, (rgb, raw) in pushed.items():
        np.testing.assert_array_equal(run.image(index).color, rgb)
        np.testing.assert_allclose(run.image(index).depth_m, raw / 5000.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("words", "options", "message"),
    [
        ((), {"manhattan": "mean_shif"}, "manhattan: there is no plugin 'mean_shif' for the slot 'manhattan'; did you mean 'mean_shift'?"),
        (("planes.angl=3",), {}, "planes.angl: the chosen plugin has no option 'angl'; did you mean 'angle_deg'?"),
        ((), {"dataset": "tum"}, "dataset: frames are pushed, so there is no data set to choose; leave it out, or use trihedron.run"),
        ((), {"replay": "run.mcap"}, "replay: is for runs over a data set; leave it out, or use trihedron.run"),
        ((), {"planes": object()}, "planes: is object, which no option takes; give text, a number, True or False, or a list of these"),
    ],
)
def test_an_option_that_does_not_fit_is_refused_at_once(camera, tmp_path, words, options, message):
    out = tmp_path / "none"
    with pytest.raises(th.TrihedronError) as error:
        th.Slam(camera, *words, out=out, **options)
    assert str(error.value) == message
    assert not out.exists()


def test_what_is_no_camera_is_named():
    with pytest.raises(th.TrihedronError, match=r"camera: is dict, not a camera; give trihedron\.Camera\.from_yaml"):
        th.Slam({"fx": 500})


def test_a_closed_one_tracks_no_more(camera):
    slam = th.Slam(camera, "outputs=[planes]")
    slam.close()
    slam.close()
    with pytest.raises(th.TrihedronError, match="Slam: is closed, and tracks no more frames; make another"):
        slam.track(*GOOD, 1.0)
    assert len(slam.trajectory) == 0


def test_a_stage_alone_says_what_it_computes_besides(folder, camera, capsys):
    rgb, depth, _ = next(images(folder))
    stage = th.planes.connected_components(angle_deg=3)
    planes = stage(depth, camera)
    assert (
        "trihedron: planes.connected_components: 'normals' is not given; it is computed by normals.integral_image, the default"
        in capsys.readouterr().err
    )
    normals = th.normals.integral_image()(depth, camera)
    again = stage(depth, camera, normals=normals)
    assert "normals" not in capsys.readouterr().err
    np.testing.assert_array_equal(planes.coefficients, again.coefficients)
    frame = th.manhattan.mean_shift()(rgb, depth, camera, planes)
    assert frame.supported


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d, c: th.planes.ransc, "planes: there is no plugin 'ransc' for the slot 'planes'; did you mean 'ransac'?"),
        (
            lambda d, c: th.planes.connected_components(angl=3),
            "planes.connected_components(angl=...): the plugin has no such option; did you mean 'angle_deg'?",
        ),
        (
            lambda d, c: th.keypoints.onnx(preset="xfeet"),
            "keypoints.onnx: preset: 'xfeet' is not one of superpoint, aliked, xfeat, disk; did you mean 'xfeat'?; "
            "see trihedron plugins keypoints onnx",
        ),
        (
            lambda d, c: th.dataset.synthetic(motion=3),
            "dataset.synthetic: motion: '3' is not one of walk, fast, still, pan; see trihedron plugins dataset synthetic",
        ),
        (lambda d, c: th.keypoints.orb()(d, c), "keypoints.orb: rgb: is not given, and keypoints are found in it; give rgb (h, w, 3) before depth"),
        (lambda d, c: th.planes.ransac()(d), "planes.ransac: camera: is not given; give trihedron.Camera(...) after the images"),
        (lambda d, c: th.planes.ransac()(c), "planes.ransac: depth: is not given; give depth (h, w) and a camera, or a frame"),
        (
            lambda d, c: th.manhattan.branch_and_bound()(),
            f"manhattan.branch_and_bound: lacks normals, segments, planes, and has no rgb, depth, camera to compute from; give {IMAGES}, "
            "or by name normals=Normals, segments=Segments, planes=Planes",
        ),
        (
            lambda d, c: th.manhattan.branch_and_bound()(d, c),
            f"manhattan.branch_and_bound: lacks segments, and has no rgb to compute from; give {IMAGES}, or by name segments=Segments",
        ),
        (lambda d, c: th.surface.tsdf()(d, c), 'surface.tsdf: gathers many frames; give Slam(..., surface="tsdf", outputs=["surface"])'),
    ],
)
def test_mistakes_with_a_stage(folder, camera, call, message, capsys):
    _, depth, _ = next(images(folder))
    with pytest.raises(th.TrihedronError) as error:
        call(depth, camera)
    assert str(error.value) == message
    assert capsys.readouterr().err == ""  # nothing is announced that is not computed then


def test_a_choice_is_given_by_its_name():
    assert th.keypoints.onnx(preset="xfeat").plugin == th.keypoints.onnx(preset=KeypointNetwork.xfeat).plugin
    assert th.dataset.synthetic(motion="pan", length=1).motion is Motion.pan


def test_help_of_a_stage_names_its_inputs():
    called = f"The stage is called on {IMAGES}; by name on any of: normals=Normals, segments=Segments, planes=Planes, previous=ManhattanFrame."
    assert called in th.manhattan.branch_and_bound.__doc__ and called in th.manhattan.branch_and_bound().__doc__
    assert f"The stage is called on {IMAGES}." in th.lines.lsd.__doc__
    assert "is called on" not in th.surface.tsdf.__doc__ + th.dataset.synthetic.__doc__


@pytest.mark.slow
def test_runs_are_compared_as_a_table(tmp_path):
    for threads in (1, 2):
        th.run("outputs=[planes]", "planes=connected_components", dataset__length=3, threads=threads, out=tmp_path / str(threads), quiet=True)
    table = th.compare([tmp_path / "1", tmp_path / "2"])
    assert [row["change"] for row in (table if isinstance(table, list) else table.to_dict("records"))] == ["threads=1", "threads=2"]
    with pytest.raises(th.TrihedronError, match="-m: is a sweep"):
        th.run("-m", "threads=1,2")


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0, 480, 500.0, 500.0, 319.5, 239.5), "width is not within 1 … 32768"),
        ((640, -480, 500.0, 500.0, 319.5, 239.5), "height is not within 1 … 32768"),
        ((640, 480, -500.0, 500.0, 319.5, 239.5), "fx is not within 0.001 … 1e+06"),
        ((640, 480, 500.0, 500.0, 2e6, 239.5), "cx is not within -1e+06 … 1e+06"),
        ((640, 480, 500.0, 500.0, 319.5, float("nan")), "cy is not within -1e+06 … 1e+06"),
        ((640, 480, 500.0, 500.0, 319.5, 239.5, 1e7), "fps is not within 1e-06 … 1e+06"),
        ((640, 480, "500", 500.0, 319.5, 239.5), "fx is str, not a number"),
        ((640.5, 480, 500.0, 500.0, 319.5, 239.5), "width is float, not a whole number"),
    ],
)
def test_a_camera_that_is_none_is_refused_where_it_is_made(numbers, message):
    """With the bounds of a recording: a run with such a camera could not be replayed."""
    for make in (th.Camera, lambda *given: th.Camera.of(types.Camera(*given))):
        with pytest.raises(th.TrihedronError) as error:
            make(*numbers)
        assert str(error.value) == f"camera: {message}; give the numbers of a calibration, in pixels and seconds"


def test_what_is_no_camera_is_refused():
    with pytest.raises(th.TrihedronError) as error:
        th.Camera.of(3)
    cure = 'give trihedron.Camera.from_yaml("camera.yaml"), or trihedron.Camera(width, height, fx, fy, cx, cy)'
    assert str(error.value) == f"camera: is int, not a camera; {cure}"
    with pytest.raises(th.TrihedronError, match="distortion holds coefficients that are not within ±100"):
        th.Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(0.0, 1e10, 0.0, 0.0, 0.0))
