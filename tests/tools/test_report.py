"""The page of a run stands alone, and a browser draws it without a complaint."""

import html
import json
import re
import shutil
import subprocess

import cv2
import html5lib
import numpy as np
import pytest

import trihedron as th
from trihedron.comparison.runs import Run
from trihedron.pipeline.app.cli import main
from trihedron.tools.run_configurations import changed_options
from trihedron.tools.run_pages import RunFacts

SVD = {"plugin": "plane_svd", "gate": 2.5, "loyalty": 1.2}
ROOM = ["dataset.width=160", "dataset.height=120", "dataset.length=20"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    for seed in (0, 1):
        surface = ["outputs=[trajectory,surface]"] * (seed == 0)
        assert main(["run", *ROOM, *surface, f"dataset.seed={seed}", f"out={folder}/{seed}"]) == 0
    assert main(["report", str(folder), "--out", str(folder / "report.html")]) == 0
    return folder / "report.html"


def test_a_page_is_valid_and_needs_no_network(page):
    text = page.read_text()
    html5lib.HTMLParser(strict=True).parse(text)
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//|@import|url\(""", text) and len(text) < 1_000_000
    assert len(re.findall("<img[^>]*data:image/jpeg;base64,", text)) == 2 and text.count("<figure><svg") == 3
    assert text.count("<h2>Paths and surface in 3D</h2>") == text.count('aria-label="Paths of the camera and surface in 3D; ') == 1
    assert "The surface has no ceiling and no small islands here." in text
    scene = json.loads(re.findall(r'id="scene">(.*?)</script>', text)[0])
    assert [path["name"] for path in scene["paths"]] == ["0", "1", "ground truth"] and [mesh["name"] for mesh in scene["meshes"]] == ["surface"]


def test_configurations_are_differences_from_the_defaults(page, tmp_path):
    options = page.read_text().partition("<h2>Configurations</h2>")[2]
    rows = dict(re.findall(r'<th scope="row">([^<]*)</th>((?:<td[^>]*>[^<]*</td>)*)</tr>', options))
    assert list(rows) == ["dataset.height", "dataset.length", "dataset.seed", "dataset.width", "outputs"]
    assert rows["dataset.width"] == "<td>160</td><td>160</td>" and rows["dataset.seed"] == "<td>0 (default)</td><td>1</td>"
    assert rows["outputs"] == "<td>[trajectory,surface]</td><td>[trajectory] (default)</td>"
    swapped, plain = (
        RunFacts(Run(tmp_path, {}, {}), "", "", (), config, 20) for config in ({"manhattan": SVD}, {"dataset": {"plugin": "synthetic"}})
    )
    assert changed_options({"a": swapped, "b": plain})["rows"] == [["manhattan", "plane_svd", "-"], ["manhattan.gate", "2.5", "-"]]
    assert changed_options({"b": plain})["rows"] == []


def test_a_page_without_a_surface_has_the_path_alone_and_no_times_of_the_renderer(page, tmp_path):
    assert main(["report", str(page.parent / "1"), "--out", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text()
    assert "<h2>Paths in 3D</h2>" in text and 'aria-label="Paths of the camera in 3D; ' in text and "The surface has" not in text
    assert "Median ms of the stages: normals " in text and "Median time of each stage, ms, without reading or rendering frames." in text


def test_names_of_runs_are_escaped(page, tmp_path):
    folder = tmp_path / "<script>alert(1)<" / "script>&"
    shutil.copytree(page.parent / "1", folder)
    assert main(["report", str(folder), "--out", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text()
    html5lib.HTMLParser(strict=True).parse(text)
    assert "<script>alert" not in text and "script>&<" not in text


def test_a_name_does_not_swallow_the_rest_of_a_report(page, tmp_path):
    """Behind `<!--<script>` an HTML parser ends no script any more; U+2028 ends a line of JavaScript."""
    shutil.copytree(page.parent / "1", tmp_path / "<!--<script>\u2028")
    assert main(["report", str(tmp_path / "<!--<script>\u2028"), "--out", str(tmp_path / "page.html")]) == 0
    [scene] = re.findall(r'id="scene">(.*?)</script>', (tmp_path / "page.html").read_text())
    assert not set("<>&\u2028") & set(scene) and json.loads(scene)["paths"][0]["name"] == "<!--<script>\u2028"


def test_the_building_of_a_run_is_drawn(tmp_path):
    words = ["dataset.scene=flat", "dataset.fps=10", "dataset.width=160", "dataset.height=120", "dataset.length=8", "outputs=[trajectory,building]"]
    assert main(["run", *words, f"out={tmp_path / 'flat'}"]) == 0
    assert main(["report", str(tmp_path / "flat"), "--out", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text()
    [mesh] = json.loads(re.findall(r'id="scene">(.*?)</script>', text)[0])["meshes"]
    assert mesh["name"] == "building" and mesh["shown"] and len(mesh["vertices"]) > 100
    assert "<figcaption>flat: building: 1 storey" in text and 'src="data:image/svg+xml;base64,' in text


def test_a_page_names_data_set_runs_date_and_commands(page, tmp_path):
    text = page.read_text()
    assert "<title>synthetic: 0, 1</title>" in text and "<h1>synthetic: 0, 1</h1>" in text
    command = f"trihedron run {' '.join(ROOM)} dataset.seed=1 out={page.parent}/1"
    assert re.search(
        rf'<th scope="row">1</th><td>synthetic</td><td>20\d\d-\d\d-\d\d \d\d:\d\d \w+</td><td class="note">{re.escape(command)}</td>', text
    )
    assert main(["report", str(page.parent / "0"), "--title", "Room & more", "--out", str(tmp_path / "other.html")]) == 0
    assert "<h1>Room &amp; more</h1>" in (tmp_path / "other.html").read_text()


def test_a_page_of_pushed_frames_has_the_options_and_no_command(tmp_path):
    room = th.dataset.synthetic(width=160, height=120, length=3)
    with th.Slam(room(0).camera, "planes.angle_deg=4", outputs=["trajectory", "planes"], out=tmp_path / "walk") as slam:
        for k in range(3):
            slam.track(room(k).color, room(k).depth_m, room(k).stamp_ns / 1e9)
    assert main(["report", str(tmp_path / "walk"), "--out", str(tmp_path / "page.html")]) == 0
    text = html.unescape((tmp_path / "page.html").read_text())
    assert "trihedron run" not in text and "pushed: the images came one by one from a Python program." in text
    options = "planes.angle_deg=4 'outputs=[trajectory,planes]'"
    assert f"none: frames were pushed from Python, into trihedron.Slam with the options {options}<" in text


PLACES = """<script>addEventListener("load", () => setTimeout(() => {
    const box = (plot) => Object.values(plot.getBoundingClientRect().toJSON()).slice(0, 4).join();
    document.body.dataset.places = [...document.querySelectorAll("canvas, .pair svg")].map(box).join(";");
    document.body.dataset.width = document.documentElement.scrollWidth;
}, 1000))</script>"""  # x, y, width and height of each figure, and the width of the page

FRAMED = """<script>addEventListener("load", () => setTimeout(() => {
    document.body.dataset.width = document.querySelector("iframe").contentDocument.body.dataset.width;
}, 2000))</script>"""


@pytest.mark.slow
def test_a_browser_draws_it(page):
    """Without a complaint, on a telephone too, and all figures are to be seen: both runs' colours, and the surface as an area."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or google-chrome here; install it with: apt-get install chromium")
    told, picture, frame = page.with_name("told.html"), page.with_name("picture.png"), page.with_name("frame.html")
    told.write_text(page.read_text().replace("</body>", PLACES + "</body>"))
    frame.write_text(f'<iframe style="width: 400px" srcdoc="{html.escape(told.read_text())}"></iframe>' + FRAMED)
    options = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--enable-logging=stderr", "--virtual-time-budget=8000"]
    options += ["--window-size=1200,3000", "--hide-scrollbars"]
    done = subprocess.run([browser, *options, "--dump-dom", told.as_uri()], capture_output=True, text=True, timeout=300)
    assert not re.search(r"CONSOLE.*(Uncaught|Error)", done.stderr)
    narrow = subprocess.run([browser, *options, "--dump-dom", frame.as_uri()], capture_output=True, text=True, timeout=300)
    assert re.search('<body data-width="400"', narrow.stdout)  # nothing but its own regions scrolls sideways
    subprocess.run([browser, *options, f"--screenshot={picture}", page.as_uri()], capture_output=True, check=True, timeout=300)
    pixels = cv2.imread(str(picture))[..., ::-1].astype(int)
    places = [[round(float(number)) for number in place.split(",")] for place in re.search('data-places="([^"]*)"', done.stdout)[1].split(";")]
    seen = []
    for x, y, width, height in places:
        drawn = pixels[y : y + height, x : x + width]
        runs = [int((np.abs(drawn - color).max(axis=-1) < 30).sum()) for color in ((213, 94, 0), (0, 158, 115))]
        seen.append((*runs, float((drawn.min(axis=-1) < 225).mean())))
    print(seen)
    x, y, width, height = places[0]
    shown = np.abs(pixels[y : y + height, x : x + width] - (237, 240, 242)).max(axis=-1) > 12  # of the 3D view, not its background
    filled = [np.ptp(np.flatnonzero(shown.any(axis=axis))) / shown.shape[1 - axis] for axis in (0, 1)]
    assert 0.85 < max(filled) < 0.95
    assert len(seen) == 4 and min(*seen[0][:2]) >= 3 and seen[0][2] > 0.04  # a path of two thirds of a second, and the wall behind
    assert min(*seen[1][:2]) >= 30 and min(*seen[2][:2], *seen[3][:2]) > 200
