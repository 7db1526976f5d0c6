"""Execute the examples of the gallery, and write a picture and the printed lines of each: python docs/site/gallery.py build/gallery."""

from __future__ import annotations

import ast
import contextlib
import io
import runpy
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "gallery"


def execute(example: Path, picture: Path) -> str:
    """Write the picture of an example; return what it prints."""
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream):
        runpy.run_path(str(example))["main"](picture)
    return stream.getvalue()


def text_of(example: Path) -> tuple[str, str]:
    """Title and description of an example, from its docstring."""
    title, _, description = (ast.get_docstring(ast.parse(example.read_text())) or "").partition("\n\n")
    return title, description.replace("\n", " ")


def pages(results: Path) -> dict[str, str]:
    """Text of each page by its place below docs/, and of the page that shows all pictures."""
    written = {}
    cards = ["# Gallery\n\nEach picture was made by the code on its page when this site was built.\n"]
    for example in sorted(EXAMPLES.glob("*.py")):
        title, description = text_of(example)
        printed = (results / f"{example.stem}.txt").read_text()
        command = f"python examples/gallery/{example.name} {example.stem}.jpg"
        parts = [f"# {title}", description, f"![{title}]({example.stem}.jpg)", f"```text\n{printed}```", f"*Printed by* `{command}`"]
        written[f"gallery/{example.stem}.md"] = "\n\n".join([*parts, f"```python\n{example.read_text()}```\n"])
        cards.append(f"## [{title}]({example.stem}.md)\n\n{description}\n\n[![{title}]({example.stem}.jpg){{ width=420 }}]({example.stem}.md)\n")
    return {"gallery/index.md": "\n".join(cards), **written}


def main(out: str) -> None:
    """Execute all examples."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for example in sorted(EXAMPLES.glob("*.py")):
        print(f"{example.relative_to(ROOT)}", flush=True)
        (folder / f"{example.stem}.txt").write_text(execute(example, folder / f"{example.stem}.jpg"))


if __name__ == "__main__":
    main(*sys.argv[1:])
