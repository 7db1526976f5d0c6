"""Tables as aligned text."""

from __future__ import annotations

from collections.abc import Sequence

from trihedron.pipeline.core.errors import printable


def table(rows: Sequence[Sequence[object]], right: str = "") -> str:
    """Rows as aligned columns two blanks apart; `right` has an r for each column to be aligned to the right, for example "lrr"."""
    cells = [[printable(str(cell)) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    aligned = [[cell.rjust(w) if right[i : i + 1] == "r" else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths))] for row in cells]
    return "\n".join("  ".join(row).rstrip() for row in aligned)
