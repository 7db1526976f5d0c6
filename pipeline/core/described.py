"""Line and picture of a value for its user: one line instead of its arrays, and a small picture in a notebook."""

from __future__ import annotations


class Described:
    """Base of the types that print as one line of `core.descriptions`, and have a picture of `core.pictures` in notebooks.

    A dataclass that derives from it keeps that line, unless it defines its own `__repr__`."""

    def __init_subclass__(cls) -> None:
        """Define `__repr__` in the class itself, which `dataclass` then does not replace."""
        super().__init_subclass__()
        if "__repr__" not in vars(cls):
            setattr(cls, "__repr__", Described.__repr__)  # noqa: B010, no assignment to a method

    def __repr__(self) -> str:
        from trihedron.pipeline.core.descriptions import describe

        return describe(self)

    def _repr_html_(self) -> str | None:
        from trihedron.pipeline.core.pictures import html_of

        return html_of(self)
