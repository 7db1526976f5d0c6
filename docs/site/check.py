"""Check the built site: it loads nothing from another host, and every link inside it leads to a page, and to a place on that page.

python docs/site/check.py build/site
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("video", "src")}
LOADED_BY_LINK = {"stylesheet", "preconnect", "preload", "icon", "dns-prefetch", "modulepreload"}  # rel of <link>
FETCHED = re.compile(r"""(?:url\(\s*["']?|@import\s+["']|src=["'])((?:https?:)?//[^"')\s]+)""")


class PageLinks(HTMLParser):
    """The links of a page, what it loads, and the places on it that a link may name."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.places: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the attributes of one element."""
        given = {name: value or "" for name, value in attrs}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        self.loaded += [given[name] for kind, name in LOADED if kind == tag and name in given]
        if tag == "link" and LOADED_BY_LINK & set(given.get("rel", "").split()):
            self.loaded.append(given.get("href", ""))


def problems(site: Path) -> list[str]:
    """One line for each request to another host and each link that leads nowhere."""
    pages = {path: PageLinks(path.read_text()) for path in site.rglob("*.html")}
    found = [f"{path.relative_to(site)}: loads {url}" for path in site.rglob("*.css") for url in FETCHED.findall(path.read_text())]
    for path, page in sorted(pages.items()):
        name = path.relative_to(site)
        for url in page.loaded + page.links:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                if url in page.loaded and parts.scheme != "data":
                    found.append(f"{name}: loads {url}")
                continue
            target = (
                path if not parts.path else site / parts.path.lstrip("/") if parts.path.startswith("/") else path.parent / unquote(parts.path)
            ).resolve()
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                found.append(f"{name}: no file {url}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places and parts.fragment != "__skip":
                found.append(f"{name}: no place {url}")
    return found


def main(site: str) -> int:
    """Print the problems and the number of pages; 1 when there are problems."""
    folder = Path(site).resolve()
    found = problems(folder)
    print("\n".join(found) or f"{sum(1 for _ in folder.rglob('*.html'))} pages, all links resolve, nothing is loaded from another host")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
