"""Templates of the pages (Jinja2), their style and the 3D view; all of it is put into each page."""

from __future__ import annotations

from functools import cache
from typing import Any


@cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    found = Environment(
        loader=PackageLoader("trihedron.tools.pages", ""), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return found


def render(template: str, **values: Any) -> str:
    """Return a page: a template of this folder with its values, which are escaped."""
    text: str = _environment().get_template(template).render(**values)
    return text
