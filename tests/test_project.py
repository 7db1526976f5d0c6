"""The project's habits: the site, the hosted tests, the container, versions, the changelog."""

import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from setuptools.config.pyprojecttoml import load_file

from trihedron.tools.system_check import OPEN3D_NEEDS, PACKAGES

ROOT = Path(__file__).resolve().parents[1]
PROJECT = load_file(ROOT / "pyproject.toml")["project"]
WORKFLOWS = ROOT / ".github" / "workflows"
sys.path.insert(0, str(ROOT / "docs" / "site"))
import check  # noqa: E402
import gallery  # noqa: E402


def test_a_site_that_loads_from_elsewhere_or_links_nowhere_is_refused(tmp_path):
    page = (
        '<link rel="stylesheet" href="https://fonts.example/a.css"><a href="b.html#here">b</a><a href="c.html">c</a><a href="https://elsewhere">e</a>'
    )
    (tmp_path / "a.html").write_text(page)
    (tmp_path / "b.html").write_text('<p id="there">b</p><script src="//cdn.example/x.js"></script><a href="a.html">a</a>')
    (tmp_path / "s.css").write_text("@font-face {src: url(https://fonts.example/f.woff2)}")
    found = [
        "s.css: loads https://fonts.example/f.woff2",
        "a.html: loads https://fonts.example/a.css",
        "a.html: no place b.html#here",
        "a.html: no file c.html",
        "b.html: loads //cdn.example/x.js",
    ]
    assert check.problems(tmp_path) == found


@pytest.mark.slow
def test_the_site_is_built_strictly_and_needs_no_network(tmp_path):
    """With blank pictures in the gallery, which has tests of its own."""
    results, site = tmp_path / "gallery", tmp_path / "site"
    results.mkdir()
    for example in gallery.EXAMPLES.glob("*.py"):
        cv2.imwrite(str(results / f"{example.stem}.jpg"), np.zeros((8, 8), np.uint8))
        (results / f"{example.stem}.txt").write_text("printed\n")
    environment = os.environ | {"TRIHEDRON_GALLERY": str(results), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(site)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert check.problems(site) == []
    assert len([path for path in site.rglob("*.html") if "source" not in path.parts]) >= 20
    for part in (
        "tutorial/first-run",
        "how-to/replay",
        "explanation/dataflow",
        "reference/command-line",
        "gallery/index",
        "reference/python-objects",
        "reference/plugins",
        "reference/plugins/manhattan/mean_shift",
        "reference/topics/index",
        "reference/topics/pose",
    ):
        assert (site / f"{part}.html").is_file(), part
    assert "trihedron compare" in (site / "reference" / "command-line.html").read_text()
    assert "plugins/planes/cape.html" in (site / "source" / "plugins" / "planes" / "cape.py.html").read_text()
    assert "R_world_camera" in (site / "reference" / "python-objects.html").read_text()


def test_hosted_jobs_are_valid_and_run_what_developers_run():
    """Every push is judged by the README's commands with locked versions; the newest versions are tried once a week, and block nothing."""
    files = sorted(WORKFLOWS.glob("*.yml"))
    command = [Path(sys.executable).parent / "check-jsonschema", "--builtin-schema", "vendor.github-workflows", *files]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    workflows = {path.stem: yaml.safe_load(path.read_text()) for path in files}
    jobs = workflows["test"]["jobs"]
    pythons = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", line)]
    assert jobs["test"]["strategy"]["matrix"]["python"] == pythons == ["3.10", "3.11", "3.12", "3.13", "3.14"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands == ["bash .ci/run test PYTHON=python", "make release PYTHON=python", "make docs PYTHON=python"]
    assert set(workflows["newest"][True]) == {"schedule", "workflow_dispatch"}  # YAML 1.1 reads the key `on` as true
    assert workflows["newest"]["jobs"]["newest"]["steps"][-1]["run"] == "bash .ci/run test-newest PYTHON=python"
    makefile = (ROOT / "Makefile").read_text()
    assert {"test", "release", "docs", "test-newest"} <= set(re.findall(r"^(\w[\w-]*):", makefile, re.MULTILINE))
    assert 'make "${@:-test}"' in (ROOT / ".ci" / "run").read_text()


def test_citation_and_templates_are_valid():
    checks = {"vendor.citation-file-format": ROOT / "CITATION.cff"}
    for schema, file in checks.items():
        done = subprocess.run([Path(sys.executable).parent / "check-jsonschema", "--builtin-schema", schema, file], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    for template in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.md"):
        assert {"name", "about"} <= set(yaml.safe_load(template.read_text().split("---")[1]))
    hooks = [hook for repo in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"] for hook in repo["hooks"]]
    assert {"ruff-check", "ruff-format", "workflows"} <= {hook["id"] for hook in hooks}


def test_the_container_installs_as_the_readme_does():
    text = (ROOT / "Containerfile").read_text()
    readme = (ROOT / "README.md").read_text()
    assert "pip install --constraint constraints.txt ." in readme and "--constraint constraints.txt ." in text and "trihedron compile" in text
    needed = {PACKAGES[library] for library in OPEN3D_NEEDS}
    assert needed <= set(text.split()) and needed <= set((ROOT / ".ci" / "packages.txt").read_text().split())


def test_the_version_is_in_one_place():
    assert version("trihedron") == PROJECT["version"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", PROJECT["version"])
    assert "version:" not in (ROOT / "CITATION.cff").read_text().replace("cff-version:", "")


def test_the_changelog_is_kept():
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ – \d{4}-\d\d-\d\d", heading) for heading in headings[1:])
    kinds = set(re.findall(r"^### (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_decisions_are_short_records_listed_in_order():
    index = (ROOT / "docs" / "decisions.md").read_text()
    records = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    assert [path.name for path in records] == sorted(re.findall(r"\]\(decisions/([^)]+)\)", index))
    numbers = [int(path.name[:4]) for path in records]
    assert len(set(numbers)) == len(numbers)  # a record that was replaced leaves a gap
    for number, path in zip(numbers, records):
        text = path.read_text()
        assert text.startswith(f"# {number}. "), path
        headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
        order = ["Context", "Decision", "Measurement", "Limits", "Rejected"]
        assert "Decision" in headings and headings == [heading for heading in order if heading in headings], f"{path}: {headings}"
        assert len(text.split()) < 600, f"{path}: {len(text.split())} words"
