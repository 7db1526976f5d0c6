"""Docstrings of the Python API: their sections name what there is, and their examples run."""

import doctest
import importlib
import inspect
import re
from dataclasses import is_dataclass

import pytest

import trihedron as th
from trihedron.pipeline.core import errors

HOMES = sorted({f"trihedron.{home}" for home in th._HOMES.values()} | {"trihedron.stages"})
SECTIONS = ("Args", "Returns", "Raises", "Examples")
HEADING = re.compile(rf"^({'|'.join(SECTIONS)}):\n", re.MULTILINE)
ENTRY = re.compile(r"^    (\w+): \S", re.MULTILINE)
IN_PROSE = re.compile(r"\b(Raises \w*Error|Example:|Return:|Raise:|Parameters:)")
SAYS_IT = re.compile(r"(Return|Read|Make)\b")  # the first word where there are no parameters


def is_public(name):
    return not name.startswith("_") or name == "__call__"


def public_members():
    """(name, what has a docstring, its signature or None of a property or of the names of a module) of the API: classes with their methods and
    properties in the modules of its names, and its functions."""
    for home in HOMES:
        for kind in vars(importlib.import_module(home)).values():
            if not inspect.isclass(kind) or kind.__module__ != home or kind.__name__.startswith("_"):
                continue
            path = f"{home.rpartition('.')[2]}.{kind.__name__}"
            by_caller = getattr(th, kind.__name__, None) is kind  # others are made by the library
            made = by_caller and (not is_dataclass(kind) or "Args:" in kind.__doc__)  # fields may be described where they are declared
            yield path, kind, inspect.signature(kind).replace(return_annotation=None) if made else None
            for name, member in vars(kind).items():
                member = getattr(member, "__func__", member)
                if is_public(name) and inspect.isfunction(member):
                    signature = inspect.signature(member)
                    own = [parameter for parameter in signature.parameters.values() if parameter.name not in ("self", "cls")]
                    yield f"{path}.{name}", member, signature.replace(parameters=own)
                elif is_public(name) and hasattr(member, "__get__") and getattr(member, "__doc__", None):
                    yield f"{path}.{name}", member, None
    for name in th.__all__:
        if inspect.isfunction(function := getattr(th, name)):
            yield name, function, inspect.signature(function)


MEMBERS = {name: (member, signature) for name, member, signature in public_members()}
EXAMPLES = [name for name, (member, _) in MEMBERS.items() if ">>> " in (member.__doc__ or "")]


def sections_of(text):
    """Heading -> text; that before the first heading is ""."""
    opening, *rest = HEADING.split(text)
    return {"": opening, **dict(zip(rest[::2], rest[1::2]))}


def faults_of(member, signature):
    """What is wrong with the docstring of a public name."""
    text = inspect.cleandoc(member.__doc__ or "") + "\n"
    sections = sections_of(text)
    found = [f"'{match[0]}' is no section" for match in IN_PROSE.finditer(sections[""])]
    if [name for name in SECTIONS if name in sections] != HEADING.findall(text):
        found.append(f"its sections are not in the order {', '.join(SECTIONS)}")
    found += [f"Raises: there is no {name}" for name in ENTRY.findall(sections.get("Raises", "")) if not hasattr(errors, name)]
    if signature is None:
        return found
    named, taken = ENTRY.findall(sections.get("Args", "")), list(signature.parameters)
    if named != taken:
        found.append(f"Args: names {', '.join(named) or 'nothing'}, and it takes {', '.join(taken) or 'nothing'}")
    returns = signature.return_annotation not in (None, "None")
    if returns and "Returns" not in sections and (taken or not SAYS_IT.match(text)):
        found.append("Returns: is missing")
    if not returns and "Returns" in sections:
        found.append("Returns: it returns nothing")
    return found


def test_sections_name_what_there_is():
    some = {"run", "register", "slam.Slam", "slam.Slam.track", "camera.Camera.from_yaml", "recording.Recording.poses", "stages.Stage.__call__"}
    assert len(MEMBERS) > 100 and some < MEMBERS.keys()
    faults = {name: found for name, (member, signature) in MEMBERS.items() if (found := faults_of(member, signature))}
    assert faults == {}


def bare(x: int) -> int:
    """Return x."""


def old(x: int) -> int:
    """Return x.

    Args:
        x: a number.
        y: another.

    Raises:
        NoError: never.
    """


def in_prose() -> int:
    """Compute x. Raises DataError."""


def disordered(x: int) -> None:
    """Take x.

    Returns:
        Nothing.

    Args:
        x: a number.
    """


@pytest.mark.parametrize(
    ("member", "faults"),
    [
        (bare, ["Args: names nothing, and it takes x", "Returns: is missing"]),
        (old, ["Raises: there is no NoError", "Args: names x, y, and it takes x", "Returns: is missing"]),
        (in_prose, ["'Raises DataError' is no section", "Returns: is missing"]),
        (disordered, ["its sections are not in the order Args, Returns, Raises, Examples", "Returns: it returns nothing"]),
    ],
)
def test_faults_of_docstrings_are_noticed(member, faults):
    assert faults_of(member, inspect.signature(member)) == faults


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name, tmp_path, monkeypatch):
    """As it stands, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    example = doctest.DocTestParser().get_doctest(inspect.cleandoc(MEMBERS[name][0].__doc__), {}, name, None, 0)
    printed = []
    assert doctest.DocTestRunner().run(example, out=printed.append).failed == 0, "".join(printed)


def test_what_says_more_has_an_example():
    of_recordings = {f"recording.Recording{name}" for name in ("", ".values", ".replay", ".ablate")}
    others = {"slam.Slam", "slam.Slam.track", "camera.Camera", "camera.Camera.from_yaml", "trajectory.Trajectory.errors", "stages.Stage"}
    assert of_recordings | others | {"run", "compare", "ablate"} <= set(EXAMPLES)
