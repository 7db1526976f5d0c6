"""The page of a run stands alone, and a browser draws it without a complaint."""

import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main

LEGEND_PX = 50  # at the top of a figure
ROOM = ["dataset.width=160", "dataset.height=120", "dataset.length=8"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    for seed in (0, 1):
        surface = ["outputs=[trajectory,surface]"] * (seed == 0)
        assert main(["run", *ROOM, *surface, f"dataset.seed={seed}", f"out={folder}/{seed}"]) == 0
    assert main(["report", str(folder), "--out", str(folder / "report.html")]) == 0
    return folder / "report.html"


def test_a_page_needs_no_network(page):
    text = page.read_text()
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=['\"]https?:", text)
    assert len(re.findall("<img[^>]*data:image/png;base64,", text)) == 2 and text.count("Plotly.newPlot('figure") == 3
    assert "<td>dataset.seed</td><td>0</td><td>1</td>" in text


def test_a_page_names_data_set_runs_date_and_commands(page, tmp_path):
    text = page.read_text()
    assert "<title>synthetic: 0, 1</title>" in text and "<h1>synthetic: 0, 1</h1>" in text
    command = f"trihedron run {' '.join(ROOM)} dataset.seed=1 out={page.parent}/1"
    assert re.search(rf"<td>1</td><td>synthetic</td><td>20\d\d-\d\d-\d\d \d\d:\d\d \w+</td><td>{re.escape(command)}</td>", text)
    assert main(["report", str(page.parent / "0"), "--title", "Room & more", "--out", str(tmp_path / "other.html")]) == 0
    assert "<h1>Room &amp; more</h1>" in (tmp_path / "other.html").read_text()


PLACES = """<script>addEventListener("load", () => setTimeout(() => {
    const box = (plot) => Object.values(plot.getBoundingClientRect().toJSON()).slice(0, 4).join();
    document.body.dataset.places = [...document.querySelectorAll(".js-plotly-plot")].map(box).join(";");
}, 3000))</script>"""  # x, y, width and height of each figure


@pytest.mark.slow
def test_a_browser_draws_it(page):
    """Without a complaint, and all figures are to be seen: both runs' colours below the legends, and the surface as an area."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or google-chrome here; install it with: apt-get install chromium")
    told, picture = page.with_name("told.html"), page.with_name("picture.png")
    told.write_text(page.read_text().replace("</body>", PLACES + "</body>"))
    options = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--enable-logging=stderr", "--virtual-time-budget=8000"]
    options += ["--window-size=1200,3000"]
    done = subprocess.run([browser, *options, "--dump-dom", told.as_uri()], capture_output=True, text=True, timeout=300)
    assert len(re.findall(r'class="main-svg"', done.stdout)) >= 3 and "<canvas" in done.stdout
    assert not re.search(r"CONSOLE.*(Uncaught|Error)", done.stderr)
    subprocess.run([browser, *options, f"--screenshot={picture}", page.as_uri()], capture_output=True, check=True, timeout=300)
    pixels = cv2.imread(str(picture))[..., ::-1].astype(int)
    places = [[round(float(number)) for number in place.split(",")] for place in re.search('data-places="([^"]*)"', done.stdout)[1].split(";")]
    seen = []
    for x, y, width, height in places:
        drawn = pixels[y + LEGEND_PX : y + height, x : x + width]
        runs = [int((np.abs(drawn - color).max(axis=-1) < 30).sum()) for color in ((31, 119, 180), (214, 39, 40))]
        seen.append((*runs, float((drawn.min(axis=-1) < 225).mean())))
    print(seen)
    assert len(seen) == 3 and min(*seen[0][:2]) >= 3 and seen[0][2] > 0.04  # a path of a quarter of a second, and the wall behind
    assert min(*seen[1][:2], *seen[2][:2]) > 300
