"""The documentation as a site: its search works from a folder, and its pages fit on a telephone."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
SEARCH = """<script>addEventListener("load", () => setTimeout(() => {
    const field = document.querySelector("[data-md-component=search-query]");
    field.focus(); field.value = "manhattan"; field.dispatchEvent(new Event("keyup"));
    setTimeout(() => { document.body.dataset.found = document.querySelectorAll(".md-search-result__item").length; }, 4000);
}, 1500))</script>"""
WIDTH = """<script>addEventListener("load", () => parent.postMessage(document.documentElement.scrollWidth, "*"))</script>"""
FRAME = """<script>addEventListener("message", (event) => { document.body.dataset.width = event.data; })</script>
<iframe src="PAGE" style="width: 400px; height: 900px; border: 0"></iframe>"""


def test_search_needs_no_server_and_no_other_host():
    text = (ROOT / "mkdocs.yml").read_text()
    config = yaml.safe_load(text)
    assert "offline" in config["plugins"] and config["extra"]["polyfills"] == ["javascripts/iframe-worker.js"]
    script = (ROOT / "docs" / "javascripts" / "iframe-worker.js").read_text()
    assert 'if (location.protocol === "file:") window.Worker = WorkerInFrame;' in script


@pytest.mark.slow
def test_a_browser_searches_from_a_folder_and_pages_fit_on_a_telephone(tmp_path):
    pytest.importorskip("mkdocs")
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or google-chrome here; install it with: apt-get install chromium")
    gallery, site = tmp_path / "gallery", tmp_path / "site"
    gallery.mkdir()
    for example in (ROOT / "examples" / "gallery").glob("*.py"):
        (gallery / f"{example.stem}.txt").write_text("-\n")
        shutil.copy(ROOT / "docs" / "report.png", gallery / f"{example.stem}.jpg")
    environment = {**os.environ, "TRIHEDRON_GALLERY": str(gallery), "NO_MKDOCS_2_WARNING": "1"}
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(site)]
    subprocess.run(build, cwd=ROOT, env=environment, check=True, timeout=600)
    assert "unpkg" not in (site / "index.html").read_text()

    def dom(page):
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=20000", "--window-size=1200,900", "--dump-dom"]
        return subprocess.run([browser, *options, page.as_uri()], capture_output=True, text=True, timeout=300).stdout

    def with_script(page, script):
        copy = page.with_name(f"copy_of_{page.name}")
        copy.write_text(page.read_text().replace("</body>", script + "</body>"))
        return copy

    assert int(re.search('data-found="([0-9]+)"', dom(with_script(site / "index.html", SEARCH)))[1]) >= 5
    for name in ("index.html", "explanation/results.html", "reference/run-folder.html", "how-to/view-and-export.html"):
        frame = site / "frame.html"
        frame.write_text(FRAME.replace("PAGE", str(with_script(site / name, WIDTH).relative_to(site))))
        assert re.search('data-width="400"', dom(frame)), name
