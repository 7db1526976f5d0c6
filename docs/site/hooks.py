"""Hooks of MkDocs: the front page is the README, and sources that a page links to are pages of the site."""

import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).parent))
import gallery
import plugin_pages
import reference
import topic_pages

from trihedron.pipeline.core.registry import load_plugins

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Path(os.environ.get("TRIHEDRON_GALLERY", ROOT / "build" / "gallery"))
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
TOP = {"README.md": "index.md", "plugins": f"{plugin_pages.FOLDER}.md"}  # what the repository's top has -> its page of the site
LANGUAGES = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".toml": "toml", ".json": "json", ".ipynb": "json", "": "text"}


def page_of(target: Path) -> str:
    """The page of the site that shows a file which is outside the folder of documentation."""
    name = target.relative_to(ROOT).as_posix()
    return TOP.get(name, name.lower() if target.suffix == ".md" else f"source/{name}.md")


def outside(page: str, link: str) -> Path | None:
    """The file of the repository, outside docs/, to which the link of a page leads; None for all others."""
    if "://" in link or link.startswith(("/", "mailto:")):
        return None
    target = Path(os.path.normpath(ROOT / "docs" / posixpath.dirname(page) / link))
    return target if target.is_relative_to(ROOT) and not target.is_relative_to(ROOT / "docs") and target.exists() else None


def rewritten(page: str, text: str) -> str:
    """The text of a page in which links to files outside docs/ lead to their pages."""

    def replace(match: re.Match[str]) -> str:
        target = outside(page, match[2])
        return match[0] if target is None else match[1] + posixpath.relpath(page_of(target), posixpath.dirname(page)) + match[3]

    return LINK.sub(replace, text)


def from_docs(link: str) -> str:
    """A link of a page at the repository's top, as docs/index.md would write it."""
    if "://" in link or link.startswith(("/", "mailto:")):
        return link
    return link.removeprefix("docs/") if link.startswith("docs/") else f"../{link}"


def source_page(target: Path) -> str:
    """Show a file with links to the plugins in it, or list a folder; not part of the search."""
    name = target.relative_to(ROOT).as_posix()
    head = f"---\nsearch: {{exclude: true}}\n---\n# `{name}`\n\n"
    if target.is_dir():
        return head + "\n".join(f"- `{path.name}`" for path in sorted(target.iterdir()) if not path.name.startswith(("__", ".")))
    top = posixpath.relpath(".", posixpath.dirname(page_of(target)))
    found = [(slot, plugin) for slot, plugin in plugin_pages.built_in() if plugin_pages.source_of(slot, plugin) == name]
    head += "".join(f"[`{slot}={plugin}`]({top}/{plugin_pages.FOLDER}/{slot}/{plugin}.md)\n\n" for slot, plugin in found)
    return f"{head}``````{LANGUAGES.get(target.suffix, 'text')}\n{target.read_text()}\n``````\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository's top and of all sources that pages link to."""
    for path in sorted(ROOT.glob("*.md")):
        text = LINK.sub(lambda match: match[1] + from_docs(match[2]) + match[3], path.read_text())
        files.append(File.generated(config, page_of(path), content=text))
    if not any(RESULTS.glob("*.txt")):
        raise PluginError(f"{RESULTS} holds no results of the gallery; write them with: python docs/site/gallery.py build/gallery")
    for picture in sorted(RESULTS.glob("*.jpg")):
        files.append(File.generated(config, f"gallery/{picture.name}", abs_src_path=str(picture)))
    load_plugins()
    for name, content in {**reference.pages(), **plugin_pages.pages(), **topic_pages.pages(), **gallery.pages(RESULTS)}.items():
        files.append(File.generated(config, name, content=content))
    linked = set()
    for file in files.documentation_pages():
        linked |= {target for _, link, _ in LINK.findall(file.content_string) if (target := outside(file.src_uri, link))}
    known = set(files.src_uris)
    for target in sorted(linked):
        if page_of(target) not in known:
            files.append(File.generated(config, page_of(target), content=source_page(target)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files, **_: Any) -> str:
    """Rewrite the links of a page to files outside docs/."""
    return rewritten(page.file.src_uri, markdown)
