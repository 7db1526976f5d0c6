"""Ablations of recordings, as the command line makes them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trihedron.comparison.ablation import ablate as computed
from trihedron.comparison.ablation import options_of
from trihedron.comparison.ablation_tables import as_json, as_text, lines_of, sections_of, verdicts
from trihedron.runs import Run, as_table
from trihedron.words import words_of


@dataclass(frozen=True)
class Ablation:
    """A finished ablation. `verdicts` are the lines of `trihedron ablate`, `tables` its tables by title, `figures` the same as numbers, `folders` the
    run folders by change: of several recordings one each."""

    verdicts: list[str]
    tables: dict[str, Any]
    figures: dict[str, Any]
    folders: dict[str, list[Path]]
    text: str

    def __repr__(self) -> str:
        return "\n".join([f"Ablation({len(self.folders)} alternatives; {len(self.tables)} tables)", *self.verdicts])

    def __str__(self) -> str:
        return self.text


def ablate(
    recordings: Iterable[str | Path | Run] | str | Path | Run,
    *swaps: str,
    out: str | Path,
    feedback: str = "new",
    budget: bool = False,
    **options: Any,
) -> Ablation:
    """Swap stages of recorded runs and compute again only what follows from them: `ablate("runs/a", "manhattan=mean_shift,plane_svd", out="runs/b")`.

    Args:
        recordings: run folders or recordings; several are paired repeats.
        swaps: words `STAGE=PLUGIN,PLUGIN` or `STAGE.OPTION=VALUE,VALUE`.
        out: the folder of the alternatives.
        feedback: "new" computes all that follows, "recorded" the swapped stages alone.
        budget: of a single recording, the error budget too.
        options: swaps by name; two underscores stand for a dot, as `planes__angle_deg=3`.

    Returns:
        Verdicts, tables and run folders of all alternatives, with the recorded configuration, computed anew, as the first.

    Raises:
        UsageError: nothing is swapped, `feedback` is none of the two, or a budget of several recordings is asked for.
        ConfigError: a plugin or option of a swap is unknown, or out of range.
        RecordingError: a recording cannot be read.

    Examples:
        >>> import trihedron as th
        >>> run = th.run("dataset.length=6", "dataset.width=160", "dataset.height=120", out="runs/recorded", quiet=True)
        >>> ablation = th.ablate(run, "manhattan=plane_svd", out="runs/ablation")
        >>> list(ablation.folders)
        ['as recorded', 'manhattan=plane_svd']
        >>> ablation.verdicts[0].partition(":")[0]
        'as recorded against manhattan=plane_svd'
    """
    given = [recordings] if isinstance(recordings, (str, Path, Run)) else list(recordings)
    paths = [str(item.folder if isinstance(item, Run) else item) for item in given]
    words = [*paths, *words_of(swaps, options), f"out={out}", f"feedback={feedback}"]
    cases = computed(options_of(words, budget))
    judged, sections = verdicts(cases), sections_of(cases)
    lines, found = lines_of(judged), as_json(cases, judged, sections)
    folders: dict[str, list[Path]] = {}
    for case in cases:
        for variant in case.variants:
            folders.setdefault(variant.combination.label, []).append(Path(variant.folder))
    tables = {title: as_table(rows) for title, rows in found["tables"].items()}
    return Ablation(lines, tables, found, folders, as_text(lines, sections))
