"""Camera files, presets, and which one a folder gets."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from trihedron.datasets.readers.cameras import PRESETS, choose_calibration, read_camera_file
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import EXACT_DEPTH, CalibrationSigmas, DepthNoise

GOOD = "width: 640\nheight: 480\nfx: 500\nfy: 501.5\ncx: 320\ncy: 240\ndepth_scale: 1000\n"
KEYS = "give width height fx fy cx cy depth_scale"


def test_a_camera_file_says_everything(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(GOOD + "fps: 15\ndistortion: {k1: 0.1, p2: -0.2}\ndepth_noise: exact\n")
    found = read_camera_file(file)
    assert found.distortion == (0.1, 0.0, 0.0, -0.2, 0.0)
    assert (found.depth_scale, found.camera.fy, found.camera.fps, found.camera.width) == (1000.0, 501.5, 15.0, 640)
    assert found.camera.depth_noise == EXACT_DEPTH


@pytest.mark.parametrize(
    "text, sigma_m",  # at 2 m
    [("stereo", 0.1 * 4.0 / (447.0 * 0.05)), ("kinect", 0.01182), ("{b: 0.005, floor_m: 0.002}", 0.01), ("{floor_m: 0.017}", 0.017), ("{}", 0.001)],
)
def test_depth_noise_is_that_of_a_sensor_or_given_in_numbers(tmp_path: Path, text: str, sigma_m: float) -> None:
    (tmp_path / "camera.yaml").write_text(GOOD + f"depth_noise: {text}\n")
    assert read_camera_file(tmp_path / "camera.yaml").camera.depth_noise.sigma_m(2.0) == pytest.approx(sigma_m, rel=1e-6)


def test_readout_times_are_those_of_the_reader_or_of_a_published_camera_unless_the_file_states_them(tmp_path: Path) -> None:
    def times(text: str, usual_s: float | None, camera: str = GOOD) -> tuple[float, float, float]:
        (tmp_path / "camera.yaml").write_text(camera + text)
        found = read_camera_file(tmp_path / "camera.yaml", usual_s)
        return found.readout_s, found.depth_readout_s, found.depth_delay_s

    assert times("", None) == (0.0, 0.0, 0.0) and times("", 0.02) == (0.02, 0.02, 0.0)
    assert times("readout_s: 0\ndepth_delay_s: -0.004\n", 0.02) == (0.0, 0.02, -0.004)
    assert times("depth_noise: exact\n", 0.02) == (0.0, 0.0, 0.0)  # rendered
    fr3 = "width: 640\nheight: 480\nfx: 535.4\nfy: 539.2\ncx: 320\ncy: 248\ndepth_scale: 5000\n"
    assert times("", None, fr3) == (0.02, 0.02, 0.0) and times("", 0.0, fr3) == (0.0, 0.0, 0.0)
    assert times("readout_s: 0\n", None, fr3) == (0.0, 0.02, 0.0)
    icl = "width: 640\nheight: 480\nfx: 481.2\nfy: 480.0\ncx: 319.5\ncy: 239.5\ndepth_scale: 1000\n"
    assert times("", None, icl) == times("", None, fr3.replace("535.4", "537")) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("text", ["[0.1, 0.2, 0.3, 0.4, 5e-1]", "0.1 0.2 0.3 0.4 0.5", "0.1, 0.2, 0.3, 0.4, 0.5"])
def test_distortion_may_be_a_list_or_a_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera.yaml").write_text(GOOD + f"distortion: {text}\n")
    found = read_camera_file(tmp_path / "camera.yaml")
    assert found.distortion == (0.1, 0.2, 0.3, 0.4, 0.5)
    assert found.camera.depth_noise == DepthNoise()


def test_depth_of_a_camera_file_is_corrected_and_registered(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    small = "width: 40\nheight: 30\nfx: 50\nfy: 50\ncx: 19.5\ncy: 14.5\ndepth_scale: 1000\n"
    wall = np.full((30, 40), 2.0, np.float32)
    file.write_text(small)
    assert read_camera_file(file).rectification.depth(wall) is wall  # bit-identical where nothing is stated
    file.write_text(small + "depth_offset: 0.1\ndepth_radial: -0.2\n")
    corrected = read_camera_file(file).rectification.depth(wall)
    assert np.isclose(corrected[0, 0], 1.0 / ((1.0 - 0.2 * (19.5**2 + 14.5**2) / 625.0) / 2.0 + 0.1), rtol=1e-6)
    assert np.isclose(corrected[14, 19], 1.0 / ((1.0 - 0.2 * 0.5 / 625.0) / 2.0 + 0.1), rtol=1e-6)
    beside = small + "depth_camera: {fx: 50, fy: 50, cx: 19.5, cy: 14.5, translation_m: [0.08, 0, 0]}\n"
    file.write_text(beside)
    moved = wall.copy()
    moved[:, 10] = 1.0  # at 1 m four pixels of parallax, at 2 m two
    found = read_camera_file(file).rectification.depth(moved)
    assert (found[:, 14] == 1.0).all() and (found[:, 16] == 2.0).all() and (found[:, 0] == 0.0).all() and np.count_nonzero(found[5] == 1.0) == 1


def test_a_camera_file_states_how_well_its_calibration_is_known(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(GOOD + "sigmas: {focal: 0.001, registration: 0}\n")
    assert read_camera_file(tmp_path / "camera.yaml").camera.sigmas == CalibrationSigmas(focal=0.001, registration=0.0)
    (tmp_path / "camera.yaml").write_text(GOOD)
    assert read_camera_file(tmp_path / "camera.yaml").camera.sigmas == CalibrationSigmas()


def test_a_rendered_data_set_states_that_its_camera_is_exact() -> None:
    assert set(asdict(choose_calibration(Path(), "icl_nuim").camera.sigmas).values()) == {0.0}
    assert choose_calibration(Path(), "tum_fr3").camera.sigmas == CalibrationSigmas()


BAD = [
    (GOOD.replace("fx: 500\n", ""), "{}: the key 'fx' is missing; " + KEYS),
    (GOOD + "dept_scale: 5000\n", "{}: unknown key 'dept_scale'; did you mean 'depth_scale'?"),
    (GOOD + "distortion: {k1: 0.1, k4: 1}\n", "{}: unknown key 'distortion.k4'; known: k1, k2, k3, p1, p2"),
    (GOOD + "distortion: [1, 2]\n", "{}: distortion does not hold 5 numbers; give k1 k2 p1 p2 k3 as a mapping or a list"),
    (GOOD.replace("500", "wide"), "{}: fx is 'wide'; give a finite number"),
    (GOOD.replace("fx: 500", "fx: yes"), "{}: fx is 'True'; give a finite number"),
    (GOOD.replace("fx: 500", "fx: .nan"), "{}: fx is 'nan'; give a finite number"),
    (GOOD.replace("501.5", "-480"), "{}: fy is negative (y up); give it positive; dataset=icl_nuim reflects the published poses itself"),
    (GOOD.replace("640", "640.5"), "{}: width is 640.5; give a positive whole number"),
    (GOOD.replace("1000", "0"), "{}: depth_scale is 0; give a positive number"),
    (GOOD.replace("fx: 500", "fx: 2e6"), "{}: fx is not within 0.001 … 1e+06; give the numbers of a calibration, in pixels and seconds"),
    (GOOD + "fps: 1e7\n", "{}: fps is not within 1e-06 … 1e+06; give the numbers of a calibration, in pixels and seconds"),
    (
        GOOD + "distortion: [0, 0, 0, 0, 1e10]\n",
        "{}: distortion holds coefficients that are not within ±100; give the numbers of a calibration, in pixels and seconds",
    ),
    (GOOD + "depth_noise: kinnect\n", "{}: depth_noise is 'kinnect'; did you mean 'kinect'?"),
    (GOOD + "depth_noise: {c: 0.003}\n", "{}: unknown key 'depth_noise.c'; known: a_m, b, c_per_m, floor_m"),
    (GOOD + "depth_noise: {b: small}\n", "{}: depth_noise.b is 'small'; give a finite number"),
    *(
        (
            GOOD + f"depth_noise: {{{key}: {value}}}\n",
            f"{{}}: depth_noise.{key} is {value}; give floor_m above 0 and the others within ±10: "
            "σ is max(floor_m, a_m + b z + c_per_m z²) at z metres",
        )
        for key, value in (("floor_m", 0), ("c_per_m", 11.5))
    ),
    (GOOD + "readout_s: 26\n", "{}: readout_s is not within ±0.2; give the numbers of a calibration, in pixels and seconds"),
    (GOOD + "depth_readout_s: -0.25\n", "{}: depth_readout_s is not within ±0.2; give the numbers of a calibration, in pixels and seconds"),
    (GOOD + "depth_delay_s: 15\n", "{}: depth_delay_s is not within ±0.2; give the numbers of a calibration, in pixels and seconds"),
    (GOOD + "readout_s: slow\n", "{}: readout_s is 'slow'; give a finite number"),
    (GOOD + "readout_ms: 26\n", "{}: unknown key 'readout_ms'; did you mean 'readout_s'?"),
    (GOOD + "depth_radial: 0.6\n", "{}: depth_radial is 0.6; give a relative error within ±0.5"),
    (GOOD + "depth_camera: 580\n", "{}: depth_camera holds no keys; give it fx fy cx cy translation_m rotation_deg"),
    (GOOD + "depth_camera: {fx: 580, fy: 580, cx: 320}\n", "{}: the key 'depth_camera.cy' is missing; give it fx fy cx cy"),
    (
        GOOD + "sigmas: 0.01\n",
        "{}: sigmas holds no keys; give it some of focal centre depth_focal registration inverse_depth depth_radial readout_s delay_s "
        "depth_readout_s depth_scale",
    ),
    (GOOD + "sigmas: {focul: 0.01}\n", "{}: unknown key 'sigmas.focul'; did you mean 'focal'?"),
    (GOOD + "sigmas: {focal: wide}\n", "{}: sigmas.focal is 'wide'; give a finite number"),
    (GOOD + "sigmas: {focal: -0.01}\n", "{}: sigmas.focal is not within 0 … 1; give the numbers of a calibration, in pixels and seconds"),
    (
        GOOD + "depth_camera: {fx: 0, fy: 580, cx: 320, cy: 240}\n",
        "{}: depth_camera.fx is not within 0.001 … 1e+06; give the numbers of a calibration, in pixels and seconds",
    ),
    (
        GOOD + "depth_camera: {fx: 580, fy: 580, cx: 320, cy: 240, translation_m: 0.025}\n",
        "{}: depth_camera.translation_m does not hold 3 numbers; give a list [x, y, z]",
    ),
    ("", "{}: holds no keys; give width height fx fy cx cy depth_scale, one 'key: value' a line"),
    ("width: 640\nfx: [1\n", "{}:3: is not YAML; write one 'key: value' a line"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_a_bad_camera_file_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(DataError) as caught:
        read_camera_file(file)
    assert str(caught.value) == message.format(file)


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        ("rgbd_dataset_freiburg1_xyz", "tum_fr1"),
        ("fr2_desk", "tum_fr2"),
        ("rgbd_dataset_freiburg3_long_office_household", "tum_fr3"),
        ("living_room_traj2_loop", "icl_nuim"),
        ("icl_nuim_of_kt3", "icl_nuim"),
        ("traj1_frei_png", "icl_nuim"),
    ],
)
def test_the_name_of_a_published_folder_gives_the_camera(tmp_path: Path, name: str, preset: str) -> None:
    (tmp_path / name).mkdir()
    assert choose_calibration(tmp_path / name, "") is PRESETS[preset]


def test_what_is_asked_for_goes_before_the_file_and_the_file_before_the_name(tmp_path: Path) -> None:
    folder = tmp_path / "fr1_room"
    folder.mkdir()
    (folder / "camera.yaml").write_text(GOOD)
    assert choose_calibration(folder, "").camera.fx == 500.0
    assert choose_calibration(folder, "tum_fr2") is PRESETS["tum_fr2"]
    assert choose_calibration(tmp_path, str(folder)).camera.fx == 500.0
    assert choose_calibration(tmp_path, str(folder / "camera.yaml")).camera.fx == 500.0
    assert choose_calibration(tmp_path, "", default="icl_nuim") is PRESETS["icl_nuim"]


def test_single_kinects_differ_from_a_usual_one_as_its_sigmas_state() -> None:
    cameras = [PRESETS[name].camera for name in ("tum_fr1", "tum_fr2", "tum_fr3")]
    focal = [f / 525.0 - 1.0 for camera in cameras for f in (camera.fx, camera.fy)]
    centre = [x / 640.0 for camera in cameras for x in (camera.cx - 320.0, camera.cy - 240.0)]
    spread = [round(float(np.sqrt(np.mean(np.square(errors)))), 3) for errors in (focal, centre)]
    usual = PRESETS["seven_scenes"].camera.sigmas
    assert [usual.focal, usual.centre] == [usual.depth_focal, usual.registration] == spread


def test_a_camera_that_is_neither_file_nor_preset_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        choose_calibration(tmp_path, "tum_fr4")
    assert str(caught.value) == "dataset.camera: 'tum_fr4' is neither a file nor a preset; did you mean 'tum_fr3'?"


def test_an_office_of_ones_own_gets_no_published_camera(tmp_path: Path) -> None:
    (tmp_path / "my_office").mkdir()
    with pytest.raises(DataError, match=r"has no camera\.yaml, and its name is not that of a data set whose camera is known"):
        choose_calibration(tmp_path / "my_office", "")
