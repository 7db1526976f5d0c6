"""Labels of the rows of a table of runs: what differs between them. Two rows of different systems, or of different data, never have the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trihedron.comparison.runs import is_of_data, shown_words
from trihedron.tools.run_pages import RunFacts

DEFAULT = "default"  # a row that has none of the words in which the others differ


def system_labels(rows: Sequence[RunFacts]) -> list[str]:
    """Return the label of each row's system: its graph where the rows have several, or differ in nothing else, and the words that differ between rows
    of that graph."""
    words = [{key: text for key, text in shown_words(row.run).items() if not is_of_data(key)} for row in rows]
    graphs = [row.graph for row in rows]
    named = len(set(graphs)) > 1 or all(found == words[0] for found in words)
    return [label or DEFAULT for label in _with_differences(graphs if named else [""] * len(rows), words)]


def data_labels(rows: Sequence[RunFacts]) -> list[str]:
    """Return the label of each row's data: the folder's name, or the scene of the simulation, and the words that differ between rows of that name."""
    words = [{key.removeprefix("dataset."): text for key, text in shown_words(row.run).items() if is_of_data(key)} for row in rows]
    return _with_differences([row.data_name for row in rows], words)


def row_labels(rows: Sequence[RunFacts]) -> list[str]:
    """Return the label of each row: its system, and its data."""
    return [f"{system}, {data}" for system, data in zip(system_labels(rows), data_labels(rows))]


def _with_differences(names: Sequence[str], words: Sequence[Mapping[str, str]]) -> list[str]:
    """Return each name with the words, key=value, that differ between the rows of that name."""
    labels = []
    for name, own in zip(names, words):
        alike = [found for other, found in zip(names, words) if other == name]
        differing = [f"{key}={text}" for key, text in sorted(own.items()) if any(found.get(key) != text for found in alike)]
        labels.append(" ".join([name, *differing] if name else differing))
    return labels
