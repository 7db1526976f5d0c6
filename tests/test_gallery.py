"""Each example of the gallery runs, prints what it promises and writes a small picture; so do the pictures of the explanation."""

import re
import runpy
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples" / "gallery"
PRINTED = {  # a pattern that the printed lines must match
    "a_covered_camera": r"ok 60, degraded 0, lost 15",
    "a_floor_plan": r"storeys: 1, walls: [2-9], rooms: 1",
    "a_mesh_of_planes": r"\d{3,} triangles, [1-9]\d planes",
    "a_room_without_texture": r"graph=structural: 100 % tracked, ATE [0-9]\.\d mm",
    "a_tracked_room": r"90 of 90 frames ok, ATE [0-4]\.\d mm",
    "errors_and_sigmas": r"(9\d|100) % of the errors are within 3 σ",
    "features_of_one_frame": r"1000 key points, \d+ line segments, ([5-9]|1\d) planes",
    "manhattan_axes": r"the axes are 0\.[01]\d°, 0\.[01]\d°, 0\.[01]\d° from the true ones",
    "noisier_depth": r"noise of 0 standard deviations added: ATE [0-4]\.\d mm",
    "plane_detectors": r"connected_components: \d+ planes cover [789]\d % of the image\nahc: ",
    "replay_one_stage": r"mean_shift again: bit-equal in 45 frames",
    "time_of_each_stage": r"30 frames of 640 x 480; the slowest stage is \w+",
    "which_manhattan_estimator": r"as recorded against manhattan=mixture: axes 0\.\d+ -> 0\.\d+ deg, .+ \(95 %: [-+]0\.\d+ to \+0\.\d+\)",
}
QUICK = {"features_of_one_frame", "manhattan_axes"}


def test_every_example_has_a_promise():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(PRINTED)
    assert len(PRINTED) >= 10


def check_picture(path: Path) -> None:
    """A picture of some size, with something on it, in less than 300 kB."""
    assert path.stat().st_size < 300_000
    image = cv2.imread(str(path))
    assert min(image.shape[:2]) >= 150 and image.std() > 5


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in PRINTED])
def test_example(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](tmp_path / "picture.jpg")
    printed = capsys.readouterr().out
    assert re.search(PRINTED[name], printed), printed
    check_picture(tmp_path / "picture.jpg")


@pytest.mark.slow
def test_manhattan_in_ten_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "examples" / "manhattan_in_ten_pictures.py"))["main"](str(tmp_path))
    for number in range(1, 11):
        check_picture(tmp_path / f"{number:02}.jpg")
    assert {path.name for path in tmp_path.glob("*.jpg")} == {path.name for path in (ROOT / "docs" / "explanation" / "manhattan").glob("*.jpg")}
    line = capsys.readouterr().out.splitlines()[-1]
    assert line in " ".join((ROOT / "docs" / "explanation" / "manhattan-frames.md").read_text().split())
