"""Corrections made by hand as the value `Building.edits` holds them, and the ids and names of elements that follow from them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma
from trihedron.pipeline.core.types import OPENING_KINDS, Building

LISTS = {"wall": "walls", "room": "rooms", "opening": "openings"}  # element -> its list in building.json
LONGEST_NAME, FARTHEST_M, MOST = 200, 1e6, 10_000  # characters, coordinates and elements of a file that are read
LOPSIDED = 0.2  # of an interval, by which its middle is off the area, from which a plan has both ends
CURE = "correct it, or give a building.json that trihedron wrote"

Place = tuple[float, float]


@dataclass(frozen=True)
class Edit:
    """A correction of one wall, room or opening, at `outline` (corners on the plan, m, in the building's frame) of a storey."""

    element: str  # of LISTS
    storey: int
    outline: tuple[Place, ...]
    number: int = -1  # of the element that has it; -1 = none
    missing: bool = False  # no element was there
    deleted: bool = False
    added: bool = False
    kind: str = ""  # of OPENING_KINDS, where it was changed
    heights_m: Place = (0.0, 0.0)  # bottom and top of an opening that is added
    name: str = ""
    use: str = ""


PLAIN = {field.name: field.default for field in fields(Edit)}


@dataclass(frozen=True)
class Checked:
    """An object of a file from elsewhere; `place` names it in errors. Each method raises DataError for a value of the wrong kind."""

    place: str
    item: dict[str, Any]

    @staticmethod
    def all_of(place: str, found: Any) -> list[Checked]:
        """Return the objects of a list."""
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise DataError(place, "is not a list of objects", CURE)
        if len(found) > MOST:
            raise DataError(place, f"has more than {MOST} elements", CURE)
        return [Checked(f"{place}[{k}]", item) for k, item in enumerate(found)]

    def error(self, key: str, cause: str) -> DataError:
        """Return the error about a key."""
        return DataError(f"{self.place}.{key}", f"{cause}, not {printable(json.dumps(self.item.get(key)), SHOWN)}", CURE)

    def text(self, key: str) -> str:
        """Return a text of one line; empty where there is none."""
        found = self.item.get(key)
        if found is None:
            return ""
        if not isinstance(found, str) or len(found) > LONGEST_NAME or not found.isprintable():
            raise self.error(key, f"is to be a text of at most {LONGEST_NAME} printable characters")
        return found.strip()

    def flag(self, key: str) -> bool:
        """Return true or false; false where there is none."""
        found = self.item.get(key, False)
        if not isinstance(found, bool):
            raise self.error(key, "is to be true or false")
        return found

    def whole(self, key: str, stop: int, least: int = 0) -> int:
        """Return a whole number from `least` to before `stop`."""
        found = self.item.get(key)
        if isinstance(found, bool) or not isinstance(found, int) or not least <= found < stop:
            raise self.error(key, f"is to be a whole number from {least} to {stop - 1}")
        return found

    def numbers(self, key: str, *shape: int) -> Any:
        """Return numbers as an array of a shape, -1 = any length."""
        found = self.item.get(key)
        try:
            array = np.array(found, np.float64)
        except (TypeError, ValueError, OverflowError):
            array = np.empty(0)
        fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape))
        if found is None or not fits or not (np.abs(array) < FARTHEST_M).all():
            raise self.error(key, "is to be numbers as trihedron writes them")
        return array

    def kind(self, key: str) -> str:
        """Return the kind of an opening."""
        if (found := self.item.get(key)) not in OPENING_KINDS:
            raise self.error(key, f"is to be one of {', '.join(OPENING_KINDS)}")
        return str(found)

    def edit(self) -> Edit:
        """Return the correction that an object of the list `edits` is."""
        if self.item.get("element") not in LISTS:
            raise self.error("element", f"is to be one of {', '.join(LISTS)}")
        pairs = self.numbers("outline", -1, 2)
        if len(pairs) < 3:
            raise self.error("outline", "is to have three corners or more")
        low, high = self.numbers("heights_m", 2) if "heights_m" in self.item else (0.0, 0.0)
        return Edit(
            self.item["element"], self.whole("storey", MOST), tuple((float(x), float(y)) for x, y in pairs),
            self.whole("number", MOST, -1) if "number" in self.item else -1, self.flag("missing"), self.flag("deleted"), self.flag("added"),
            self.kind("kind") if "kind" in self.item else "", (float(low), float(high)), self.text("name"), self.text("use"),
        )  # fmt: skip


def plain_edits(edits: tuple[Edit, ...]) -> list[dict[str, Any]]:
    """Return edits as objects of JSON, without what is as usual."""
    return [{name: value for name, value in asdict(edit).items() if name not in PLAIN or value != PLAIN[name]} for edit in edits]


@lru_cache(8)
def parse_edits(text: str) -> tuple[Edit, ...]:
    """Return the corrections of the value `Building.edits`. Raises DataError, for a stranger's recording."""
    try:
        found = json.loads(text or "[]")
    except (ValueError, RecursionError) as error:
        raise DataError("building.edits", f"is not JSON ({type(error).__name__})", "make the building again") from error
    return tuple(item.edit() for item in Checked.all_of("building.edits", found))


def edit_of(building: Building, element: str, number: int) -> Edit | None:
    """Return the correction of an element; None without one."""
    return next((edit for edit in parse_edits(building.edits) if (edit.element, edit.number) == (element, number)), None)


def name_of(building: Building, element: str, number: int) -> str:
    """Return the name that was given to an element; empty without one."""
    edit = edit_of(building, element, number)
    return edit.name if edit is not None else ""


def use_of(building: Building, room: int) -> str:
    """Return the use that was given to a room; empty without one."""
    edit = edit_of(building, "room", room)
    return edit.use if edit is not None else ""


def kind_of(building: Building, element: str, number: int) -> str:
    """Return `wall`, `room`, or the kind of an opening."""
    return OPENING_KINDS[building.opening_kinds[number]] if element == "opening" else element


def id_of(building: Building, element: str, number: int) -> str:
    """Return the id of an element in the files, for example wall-3, door-1, room-0."""
    return f"{kind_of(building, element, number)}-{number}"


def label_of(building: Building, element: str, number: int) -> str:
    """Return the name of an element, else its kind and number."""
    return name_of(building, element, number) or f"{kind_of(building, element, number)} {number}"


def title_of(building: Building, element: str, number: int) -> str:
    """Return the label of an element, of a room with its use."""
    return " – ".join(filter(None, (label_of(building, element, number), use_of(building, number) if element == "room" else "")))


def area_text(building: Building, room: int) -> str:
    """Return the area of a room: with its standard deviation where that is enough, else with its 95 % interval; "seen" where its walls were not seen
    all round."""
    area, sigma, (low, high) = float(building.areas_m2[room]), area_sigma(building, room), area_interval(building, room)
    if building.closed[room] and abs(low + high - 2.0 * area) < LOPSIDED * (high - low):
        return f"{area:.2f} ± {sigma:.2f} m²"
    return f"{area:.2f} m²{'' if building.closed[room] else ' seen'} ({low:.1f} to {high:.1f})"
