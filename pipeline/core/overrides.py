"""Words of the command line in Hydra's grammar: values of paths are quoted, so that any path that the file system allows works.

`dataset.path=/data/it's [here], a=b` is one path. Without this Hydra would read brackets, commas, quotes, `=` and `${` as its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

PATH_KEYS = frozenset({
    "out", "replay", "load_map", "save_map", "dataset.path", "dataset.camera", "dataset.options.path", "dataset.options.camera",
    "keypoints.model", "lines.model", "normals.model", "planes.model", "tracks.model", "loop.model",
})  # fmt: skip
LISTS = ("sequences", "alternatives", "budget_order")
SYNONYMS = {"record.frames=foxglove": "record.frames=true"}  # frames are embedded in Foxglove's schemas
PLAIN = re.compile(r"[\w./:+@%-]+", re.ASCII)  # a value that Hydra reads as it is written
BRACKETS = {"[": "]", "(": ")", "{": "}"}
SWEPT = re.compile(r".*,|(choice|glob|sort|shuffle)\(")


def literal_text(text: str) -> str:
    r"""Escape `${`, which OmegaConf would interpolate: each backslash before it is doubled, and one added."""
    return re.sub(r"(\\*)\$\{", lambda match: match[1] * 2 + r"\${", text)


def quote(text: str) -> str:
    """The text as one quoted value of Hydra's grammar; a plain word stays as it is."""
    if PLAIN.fullmatch(text):
        return text
    escaped = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + (r"\'" if match[2] else ""), literal_text(text))
    return f"'{escaped}'"


def path_of(word: str) -> tuple[str, str] | None:
    """(key, path) of an override of a path, or None. Quotes around the whole are Hydra's, unless the quoted name exists."""
    key, equals, value = word.partition("=")
    if not equals or key.lstrip("+") not in PATH_KEYS:
        return None
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"" and not Path(value).exists():
        value = re.sub(r"\\([\\'\"])", r"\1", value[1:-1])
    return key, value


def with_literal_paths(words: Iterable[str], sweep: bool = False) -> list[str]:
    """Quote the values of paths and the elements of LISTS for Hydra, and replace SYNONYMS.

    In a sweep `A,B` are several paths, unless one of that name exists."""
    return [_literal_word(word, sweep) for word in words]


def _literal_word(word: str, sweep: bool) -> str:
    if (found_list := word.partition("="))[0] in LISTS and found_list[2].startswith("["):
        return f"{found_list[0]}=[{','.join(quote(element) for element in list_elements(found_list[2]))}]"
    found = path_of(word)
    if found is None or not found[1]:
        return SYNONYMS.get(word, word)
    key, value = found
    if sweep and key != "out" and SWEPT.match(value) and not Path(value).expanduser().exists():
        return word
    return f"{key}={quote(value)}"


def list_elements(text: str) -> list[str]:
    """The elements of `[A,"B, C"]`: an unquoted one ends at a comma; a quoted one at its quote before a comma or the end."""
    rest, elements = text.strip().removeprefix("[").removesuffix("]"), []
    while rest := rest.lstrip():
        match = re.match(r"""(?P<quote>['"])(?P<text>.*?)(?<!\\)(?P=quote)\s*(,|$)""", rest, re.DOTALL) or re.match(r"(?P<text>[^,]*)(,|$)", rest)
        assert match is not None  # the second always matches
        elements.append(re.sub(r"\\([\\'\"])", r"\1", match["text"]) if "quote" in match.re.groupindex else match["text"].strip())
        rest = rest[match.end() :]
    return elements


def closing_brackets(word: str) -> str:
    """Return the closing brackets that an override lacks at its end, as `]` of `outputs=[pose`; what is between quotes has none."""
    missing = ""
    for bracket in re.findall(r"[][(){}]", re.sub(r"""(['"])(?:\\.|(?!\1).)*\1""", "", word)):
        if bracket in BRACKETS:
            missing = BRACKETS[bracket] + missing
        elif not missing.startswith(bracket):
            return ""
        else:
            missing = missing[1:]
    return missing
