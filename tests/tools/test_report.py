"""The page of a run stands alone, and a browser draws it without a complaint."""

import re
import shutil
import subprocess

import pytest

from trihedron.pipeline.cli import main

ROOM = ["dataset.width=160", "dataset.height=120", "dataset.length=8"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    for seed in (0, 1):
        assert main(["run", *ROOM, f"dataset.seed={seed}", f"out={folder}/{seed}"]) == 0
    assert main(["report", str(folder), "--out", str(folder / "report.html")]) == 0
    return folder / "report.html"


def test_a_page_needs_no_network(page):
    text = page.read_text()
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=['\"]https?:", text)
    assert len(re.findall("<img[^>]*data:image/png;base64,", text)) == 2 and text.count("Plotly.newPlot('figure") == 3
    assert "<td>dataset.seed</td><td>0</td><td>1</td>" in text


@pytest.mark.slow
def test_a_browser_draws_it(page):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or google-chrome here")
    options = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--enable-logging=stderr", "--virtual-time-budget=8000", "--dump-dom"]
    done = subprocess.run([browser, *options, page.as_uri()], capture_output=True, text=True, timeout=300)
    assert len(re.findall(r'class="main-svg"', done.stdout)) >= 3 and "<canvas" in done.stdout
    assert not re.search(r"CONSOLE.*(Uncaught|Error)", done.stderr)
