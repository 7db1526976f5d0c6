"""`trihedron site`: cells, badges, bands and pages."""

from __future__ import annotations

import hashlib
import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import html5lib
import pytest
import yaml

from trihedron.comparison.runs import read_runs
from trihedron.pipeline.app.cli import main as trihedron
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.record.reader import Recording
from trihedron.tools import site

SMALL = ["dataset.width=160", "dataset.height=120", "dataset.length=12", "outputs=[trajectory,surface]"]
FAR = "/data/tum_fr3_structure_notexture_far"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "ours"
    assert trihedron(["run", *SMALL, f"out={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def pages(run: Path) -> Path:
    out = run.parent / "results"
    assert site.main([str(run), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages of two alternatives with two seeds each."""
    folder = tmp_path_factory.mktemp("study")
    assert trihedron(["run", "-m", "planes=connected_components,cape", *SMALL, "dataset.seed=0,1", f"out={folder / 'runs'}"]) == 0
    assert site.main([str(folder / "runs"), "--out", str(folder / "pages")]) == 0
    return folder / "pages"


def fake(
    folder: Path, graph: str, path: str, ate_m: float | None, frames: int, tracked: float = 1.0, seed: int = 0, words: tuple[str, ...] = ()
) -> None:
    """A run folder of small files only, without a recording."""
    (folder / ".hydra").mkdir(parents=True)
    overrides = [f"graph={graph}", "dataset=tum", f"dataset.path={path}", f"seed={seed}", *words]
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"dataset": {"plugin": "tum", "path": path}}))
    final = {"ate_rmse_m": ate_m, "tracked_share": tracked} if ate_m is not None else None
    (folder / "metrics.json").write_text(json.dumps({"frames": frames, "final": final, "sigma": {"median_m": 0.001 * (1 + seed)}}))


def badge(tmp_path: Path, *ates_m: float | None, graph: str = "structural_paper", path: str = FAR, frames: int = 818, tracked: float = 1.0) -> str:
    for seed, ate_m in enumerate(ates_m):
        fake(tmp_path / str(seed), graph, path, ate_m, frames, tracked, seed)
    [cell] = site.cells_of(read_runs(tmp_path))
    return cell.badge.text


def test_a_figure_within_a_tenth_or_the_spread_reproduces_the_paper(tmp_path: Path) -> None:
    assert badge(tmp_path / "a", 0.0235) == "reproduces 22 mm"
    assert badge(tmp_path / "b", 0.0245) == "differs: worse than 22 mm"
    assert badge(tmp_path / "c", 0.016, 0.026, 0.030) == "reproduces 22 mm"
    assert badge(tmp_path / "d", 0.005) == "differs: better than 22 mm"
    assert badge(tmp_path / "e", 0.026, graph="structural_no_refine") == "reproduces 26 mm"


def test_what_cannot_be_compared_states_why(tmp_path: Path) -> None:
    assert badge(tmp_path / "a", 0.022, frames=250) == "not comparable: 250 of about 818 frames"
    assert badge(tmp_path / "b", 0.022, path="/data/desk") == "not comparable: no sequence of the paper"
    assert badge(tmp_path / "c", 0.022, tracked=0.5) == "not comparable: less than 90 % tracked"
    assert badge(tmp_path / "d", 0.022, graph="points") == "not comparable: the paper has no figure, or its system was lost"
    assert badge(tmp_path / "e", 0.022, graph="libraries") == "not comparable: the paper has no such system"
    assert badge(tmp_path / "f", None) == "not comparable: no error was computed"


def test_rows_are_labelled_by_what_differs(tmp_path: Path) -> None:
    for number, words in enumerate(([], ["planes=cape"], ["graph=structural"], ["planes=cape", "seed=1"])):
        folder = tmp_path / str(number) / ".hydra"
        folder.mkdir(parents=True)
        (folder / "overrides.yaml").write_text(yaml.safe_dump(words))
    runs = read_runs(tmp_path)
    assert [(cell.system, len(cell.facts)) for cell in site.cells_of(runs)] == [("default", 1), ("planes=cape", 2), ("graph=structural", 1)]
    assert [cell.system for cell in site.cells_of(runs[:1])] == ["structural"]


@pytest.fixture
def alternatives(tmp_path: Path) -> Path:
    """Runs of three alternatives on one data set, three seeds each, and of one on another."""
    noise = (0.0, 0.0003, -0.0002)
    for words, more_m in (((), 0.0), (("planes=cape",), 0.005), (("planes=ahc",), 0.0)):
        for seed in range(3):
            ate_m = 0.010 + 0.001 * seed + more_m + (noise[seed] if words else 0.0)
            fake(tmp_path / "runs" / f"{more_m}{len(words)}{seed}", "points", "/data/desk", ate_m, 100, seed=seed, words=words)
    fake(tmp_path / "runs" / "other", "points", "/data/hall", 0.010, 100)
    return tmp_path / "runs"


def table_of(index: str, title: str) -> list[list[str]]:
    """The texts of the cells of a group's table."""
    part = index.split(f">{title}</h2>")[1].split("</table>")[0]
    return [[re.sub("<.*?>", "", cell).strip() for cell in re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row)] for row in part.split("<tr>")[1:]]


def test_tables_have_sigma_spread_and_verdicts(alternatives: Path, tmp_path: Path) -> None:
    assert site.main([str(alternatives), "--out", str(tmp_path / "out")]) == 0
    index = (tmp_path / "out" / "index.html").read_text()
    header, *rows = table_of(index, "desk")
    assert header == ["system", "runs", "tracked %", "ATE mm", "σ mm†", "verdict on ATE‡", "against the paper"]
    shown = {row[0]: row[3:6] for row in rows}
    assert shown == {
        "default": ["11.00 ±1.00", "2.00 ±1.00", "the baseline"],
        "planes=ahc": ["11.30 ±0.90", "2.00 ±1.00", "no difference shown"],
        "planes=cape": ["16.30 ±0.90", "2.00 ±1.00", "worse"],
    }
    line = "default against planes=cape: ATE 11.00 -&gt; 16.03 mm, +5.03 (95 %: +4.41 to +5.66), d 20.0: worse"
    assert "<summary>Verdicts in all figures</summary><ul>" in index and f"<li>{line}</li>" in index
    assert table_of(index, "hall")[0] == ["system", "runs", "tracked %", "ATE mm", "σ mm†", "against the paper"]  # nothing to compare with
    for mark, meaning in site.NOTES.items():
        assert f"<dt>{mark}</dt><dd>{meaning}</dd>" in index
    assert "<dt>σ mm</dt><dd>1.00</dd>" in next((tmp_path / "out" / "runs").glob("*hall*")).read_text()


def test_the_baseline_is_chosen_by_its_label(alternatives: Path, tmp_path: Path) -> None:
    assert site.main([str(alternatives), "--out", str(tmp_path / "out"), "--baseline", "planes=cape"]) == 0
    _, *rows = table_of((tmp_path / "out" / "index.html").read_text(), "desk")
    assert {row[0]: row[5] for row in rows} == {"default": "better", "planes=ahc": "better", "planes=cape": "the baseline"}
    with pytest.raises(UsageError, match=r"^--baseline: no row is 'planes=cap'; did you mean 'planes=cape'\?$"):
        site.main([str(alternatives), "--out", str(tmp_path / "out"), "--baseline", "planes=cap"])


def test_every_page_is_valid_and_needs_nothing_from_elsewhere(pages: Path) -> None:
    files = [pages / "index.html", *(pages / "runs").iterdir()]
    assert len(files) == 2 and sum(file.stat().st_size for file in files) < 200_000
    for file in files:
        text = file.read_text()
        html5lib.HTMLParser(strict=True).parse(text)
        assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//|@import|url\(""", text)
        for link in re.findall(r'href="([^"#]+\.html)"', text):
            assert (file.parent / link).is_file()


def test_pages_are_accessible(pages: Path) -> None:
    index, [page] = (pages / "index.html").read_text(), [file.read_text() for file in (pages / "runs").iterdir()]
    for text in (index, page):
        assert '<html lang="en">' in text and 'class="skip" href="#main"' in text and 'id="main"' in text and "width=device-width" in text
        assert all('role="img"><title>' in svg for svg in re.findall(r"<svg .*?>.*?</title>", text))
        assert all(" alt=" in image for image in re.findall(r"<img .*?>", text))
        assert len(re.findall("<table>", text)) == len(re.findall("<caption>", text))
    assert '<canvas id="view" tabindex="0" role="img" aria-label=' in page
    for one, _ in site.LEGEND:
        assert f"{one.sign} {one.text}" in index  # sign and words, so that colour is not needed


def test_a_run_page_has_its_command_checksums_and_figures(run: Path, pages: Path) -> None:
    [page] = [file.read_text() for file in (pages / "runs").iterdir()]
    assert hashlib.sha256((run / "trajectory.txt").read_bytes()).hexdigest() in page
    assert "trihedron run dataset.width=160 dataset.height=120 dataset.length=12 &#39;outputs=[trajectory,surface]&#39; out=again" in page
    for caption in ("Path from above", "Position error over time", "Status over time: 12 ok, 0 degraded, 0 lost", "Median time of each stage"):
        assert caption in page
    scene = json.loads(re.findall(r'id="scene">(.*?)</script>', page)[0])
    assert [path["name"] for path in scene["paths"]] == ["ours", "ground truth"] and [mesh["name"] for mesh in scene["meshes"]] == ["surface"]
    assert "data:image/jpeg;base64," in page


def test_a_recording_names_its_commit(run: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True)
    if head.returncode:
        pytest.skip("not a git checkout")
    assert Recording(run / "run.mcap").metadata["commit"] == head.stdout.strip()


def test_a_band_holds_and_is_left(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    band, words = tmp_path / "band.yaml", [str(run), "--no-pictures", "--out", str(tmp_path / "out")]
    assert site.main([*words, "--write-band", str(band)]) == 0
    assert site.main([*words, "--check", str(band)]) == 0
    entries = yaml.safe_load(band.read_text())
    ate = next(entry for entry in entries if entry["figure"] == "ATE mm")
    ate["high"] = 0.5 * ate["low"]
    ate["low"] = 0.0
    band.write_text(yaml.safe_dump(entries))
    capsys.readouterr()
    assert site.main([*words, "--check", str(band)]) == 1
    assert re.search(rf"^outside its band: ATE mm: [\d.]+ instead of 0 to {ate['high']:g}$", capsys.readouterr().out, re.MULTILINE)
    assert f"instead of 0 to {ate['high']:g}</strong>" in (tmp_path / "out" / "index.html").read_text()
    band.write_text(yaml.safe_dump([{**ate, "change": "graph=other"}]))
    assert site.main([*words, "--check", str(band)]) == 1
    band.write_text("- data: x\n")
    with pytest.raises(DataError, match=r"is not a list of cells with change, data, figure, high, low; write it by --write-band"):
        site.main([*words, "--check", str(band)])


def test_names_from_files_are_escaped_and_a_run_without_a_recording_has_a_page(tmp_path: Path) -> None:
    fake(tmp_path / "runs" / "0", "points<script>alert(1)</script>", "/data/<img src=x>", 0.01, 100)
    assert site.main([str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    for file in (tmp_path / "out").rglob("*.html"):
        assert "<script>alert" not in file.read_text() and "<img src=x>" not in file.read_text()
        html5lib.HTMLParser(strict=True).parse(file.read_text())


def test_runs_of_another_commit_are_marked(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commits = iter(["a" * 40, "a" * 40, "b" * 40])
    real = site.facts_of

    def facts_of(found: object) -> object:
        return real(found).__class__(**{**vars(real(found)), "commit": next(commits)})  # type: ignore[arg-type]

    monkeypatch.setattr(site, "facts_of", facts_of)
    for seed in range(3):
        fake(tmp_path / str(seed), "structural", FAR, 0.01, 818, seed=seed)
    site.write_site(site.cells_of(read_runs(tmp_path)), tmp_path / "out", "Results")
    index = (tmp_path / "out" / "index.html").read_text()
    assert index.count("(other commit)") == 1 and "The runs are of 2 commits: aaaaaaaaaa, bbbbbbbbbb" in index
    assert "This run is of another commit" in next((tmp_path / "out" / "runs").glob("002*")).read_text()


@pytest.mark.slow
def test_small_rows_stay_in_their_band(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["dataset.width=320", "dataset.height=240", "dataset.length=30"]
    assert trihedron(["run", "-m", "graph=structural,structural_paper,points", *words, f"out={tmp_path / 'runs'}"]) == 0
    band = Path(__file__).with_name("small_rows_band.yaml")
    code = site.main([str(tmp_path / "runs"), "--no-pictures", "--out", str(tmp_path / "out"), "--check", str(band)])
    assert code == 0, capsys.readouterr().out


TOLD = """<script>addEventListener("load", () => setTimeout(() => parent.postMessage(document.documentElement.scrollWidth, "*"), 1000))</script>"""
FRAMED = """<script>addEventListener("message", (event) => { document.body.dataset.width = event.data; })</script>"""


@pytest.mark.slow
@pytest.mark.parametrize("details", ["closed", "open"])
@pytest.mark.parametrize("kind", ["index", "run"])
def test_no_page_scrolls_sideways_on_a_telephone(kind: str, details: str, study: Path, tmp_path: Path) -> None:
    """At 400 pixels the page is 400 pixels wide: nothing but its own regions scrolls sideways, whatever is opened."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or google-chrome here; install it with: apt-get install chromium")
    page = study / "index.html" if kind == "index" else sorted((study / "runs").glob("*.html"))[-1]
    text = page.read_text().replace("</body>", TOLD + "</body>")
    assert "<details>" in text
    text = text.replace("<details>", "<details open>") if details == "open" else text
    frame = tmp_path / "frame.html"
    frame.write_text(f'<body>{FRAMED}<iframe style="width: 400px; border: 0" srcdoc="{html.escape(text)}"></iframe>')
    options = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--virtual-time-budget=8000", "--hide-scrollbars"]
    done = subprocess.run([browser, *options, "--dump-dom", frame.as_uri()], capture_output=True, text=True, timeout=300)
    assert re.search('<body data-width="400"', done.stdout)
