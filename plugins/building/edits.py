"""Corrections made by hand: read from an edited building.json, and applied to a building that was computed again.

An element is recognised by its place, as numbers change: the one of its kind and storey whose outline on the plan overlaps most, by half at least
(docs/decisions/0291). A deleted wall takes its openings with it, and leaves the edges of rooms there open."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import ConfigError, DataError, printable
from trihedron.pipeline.core.files import read_text, sha256_of
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import ELEMENTS, OPENING_KINDS, Bool, Building
from trihedron.plugins.building.geometry import SHEET_M, quad, rings_of, rooms_on
from trihedron.plugins.building.labels import CURE, LISTS, MOST, Checked, Edit, parse_edits, plain_edits

WITHOUT_IDS = "is no building.json with ids"
MAX_BYTES = 16_000_000
LEAST_OVERLAP = 0.5  # intersection by union of outlines
NEAR_M = 0.25  # by which walls and openings, which are thin, are widened for that
EDITED = {"wall": ("deleted", "name"), "room": ("deleted", "name", "use"), "opening": ("deleted", "name", "kind")}  # keys of corrections
ALIKE = 0.75  # similarity of a mistyped key to its own
DELETE = 'mark an element as "deleted": true instead of removing it'
BESIDE_M = 0.3  # from a wall, of the rooms that an opening joins


# Read.


def read_edits(path: str, sha256: str = "") -> tuple[Edit, ...]:
    """Return the corrections in an edited building.json; none for an empty path. Raises DataError, or ConfigError for another file than required."""
    if not path:
        return ()
    text = read_text(Path(path).expanduser(), MAX_BYTES)
    if sha256 and (now := sha256_of(path)) != sha256:
        cause = f"{path} has the SHA-256 {now[:12]}…, and {sha256[:12]}… is required"
        raise ConfigError("building.edits", cause, "give the file of the recorded run, or building.edits_sha256= to take another")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is not JSON ({type(error).__name__})", CURE) from error
    if not isinstance(found, dict) or not isinstance(found.get("count"), dict):
        raise DataError(path, WITHOUT_IDS, "write it again with: trihedron building RUN")
    return edits_in(path, found)


def edits_in(place: str, found: dict[str, Any]) -> tuple[Edit, ...]:
    """Return the corrections in the object of a building.json. Raises DataError, which names the place."""
    return _FileEdits(place, found).edits()


class _FileEdits:
    """The corrections in the object of a file: its elements beside what their ids say, and those that the file carries on (`edits`)."""

    def __init__(self, path: str, found: dict[str, Any]) -> None:
        self.path = path
        self.carried = [item.edit() for item in Checked.all_of(f"{path}: edits", found.get("edits", []))]
        self.lists = {element: Checked.all_of(f"{path}: {key}", found.get(key)) for element, key in LISTS.items()}
        self.count = Checked(f"{path}: count", found["count"])

    def edits(self) -> tuple[Edit, ...]:
        """Return all corrections."""
        known = {(edit.element, edit.number): edit for edit in self.carried}
        out = [edit for edit in self.carried if edit.number < 0]
        for element, items in self.lists.items():
            for item in items:
                _check_spelling(element, item)
            with_id = [item for item in items if "id" in item.item]
            for number, item in enumerate(with_id):
                edit = self._edit(element, item, number, known.get((element, number)))
                out += [edit] if edit is not None else []
            if len(with_id) != self.count.whole(LISTS[element], MOST):
                cause = f"has {len(with_id)} {LISTS[element]} with an id, and had {self.count.item[LISTS[element]]}"
                raise DataError(self.path, cause, DELETE)
            for item in items:
                if "id" not in item.item:
                    if element != "opening":
                        raise DataError(item.place, "has no id", "only openings can be added")
                    out.append(self._added(item))
        return tuple(out)

    def _edit(self, element: str, item: Checked, number: int, known: Edit | None) -> Edit | None:
        """Return the correction of an element with an id; None where it is as it was computed, or was added and is deleted."""
        kinds = OPENING_KINDS if element == "opening" else (element,)
        if item.item["id"] not in [f"{kind}-{number}" for kind in kinds]:
            wanted = " or ".join(f"{kind}-{number}" for kind in kinds)
            raise DataError(item.place, f"has not the id {wanted}", DELETE)
        added, kind, deleted = known is not None and known.added, "", item.flag("deleted")
        if element == "opening":
            now, computed = item.kind("kind"), str(item.item["id"]).partition("-")[0]
            kind = now if now != computed or (known is not None and known.kind) else ""
        if added:
            return None if deleted else self._added(item)
        edit = self._placed(element, item, deleted=deleted, kind=kind, name=item.text("name"), use=item.text("use") if element == "room" else "")
        return edit if plain_edits((edit,))[0].keys() - {"element", "storey", "outline"} else None

    def _added(self, item: Checked) -> Edit:
        low, high = item.numbers("heights_m", 2)
        heights = (float(low), float(high))
        return self._placed("opening", item, added=True, kind=item.kind("kind"), name=item.text("name"), heights_m=heights)

    def _placed(self, element: str, item: Checked, **more: Any) -> Edit:
        """Return a correction at the outline of an element."""
        wall = item
        if element == "opening":
            wall = self.lists["wall"][item.whole("wall", len(self.lists["wall"]))]
        if element == "room":
            ring = item.numbers("polygon", -1, 2)
        else:
            start, end = wall.numbers("start", 2), wall.numbers("end", 2)
            length = float(norm(end - start))
            along = (end - start) / max(length, 1e-9)
            thickness = SHEET_M if wall.item.get("thickness_m") is None else float(wall.numbers("thickness_m"))
            a, b = item.numbers("span_m", 2) if element == "opening" else (0.0, length)
            back = np.array([along[1], -along[0]]) * thickness
            ring = np.array([start + a * along, start + b * along, start + b * along + back, start + a * along + back])
        if len(ring) < 3:
            raise item.error("polygon", "is to have three corners or more")
        return Edit(element, wall.whole("storey", MOST), tuple((float(x), float(y)) for x, y in ring), **more)


def _check_spelling(element: str, item: Checked) -> None:
    """Raise DataError for a key that is nearly one of those that are read of a correction: it would be lost without a word."""
    for key in item.item.keys() - set(EDITED[element]):
        if close := get_close_matches(key.lower(), EDITED[element], 1, ALIKE):
            raise DataError(item.place, f"has '{printable(key)}', which is not read", f"did you mean '{close[0]}'?")


# Apply.


def apply_edits(building: Building, edits: Sequence[Edit]) -> Building:
    """Return the building with the corrections, each with the number of its element; those without one are marked as missing."""
    if not edits:
        return building
    gone = {(edit.element, edit.outline) for edit in parse_edits(building.edits) if edit.deleted}  # a recorded building is corrected already
    found: list[Edit] = []
    taken: set[tuple[str, int]] = set()
    kept = {"wall": len(building.walls_m), "room": len(building.areas_m2), "opening": len(building.spans_m)}
    outlines = {element: [_outline(building, element, k) for k in range(count)] for element, count in kept.items()}
    for edit in edits:
        number = _match(building, edit, outlines, taken)
        if number < 0 and edit.added:
            building, number = _add_opening(building, edit)
        if number >= 0:
            taken.add((edit.element, number))
        if number >= 0 and edit.kind:
            kinds = building.opening_kinds.copy()
            kinds[number] = OPENING_KINDS.index(edit.kind)
            building = replace(building, opening_kinds=kinds)
        found.append(replace(edit, number=number, missing=number < 0 and (edit.element, edit.outline) not in gone))
    keep = {"wall": np.ones(kept["wall"], np.bool_), "room": np.ones(kept["room"], np.bool_), "opening": np.ones(len(building.spans_m), np.bool_)}
    for edit in found:
        if edit.deleted and edit.number >= 0:
            keep[edit.element][edit.number] = False
    keep["opening"] &= keep["wall"][building.opening_walls]
    numbers = {element: _renumbered(mask) for element, mask in keep.items()}
    final = [replace(edit, number=int(numbers[edit.element][edit.number])) for edit in found]
    text = json.dumps(plain_edits(tuple(final)), ensure_ascii=False)
    return replace(_without(building, keep, numbers), edits=text)


def missing_edits(building: Building) -> list[str]:
    """Return a line for each correction that no element has."""
    lines = []
    for edit in parse_edits(building.edits):
        if edit.missing:
            x, y = np.mean(edit.outline, axis=0)
            what = "deleted" if edit.deleted else "added" if edit.added else f"named '{edit.name}'" if edit.name else "changed"
            there = "wall" if edit.added else edit.element
            where = f"the {edit.element} at ({x:.2f}, {y:.2f}) m of storey {edit.storey} that was {what} by hand"
            lines.append(f"building: {where}: no {there} of the plan is there; the correction is kept for the next")
    return lines


def _outline(building: Building, element: str, k: int) -> tuple[int, Any]:
    """Return the storey and the widened outline of an element."""
    wall = k if element == "wall" else int(building.opening_walls[k]) if element == "opening" else -1
    if element == "room":
        return int(building.room_storeys[k]), _area(element, rings_of(building, k)[0])
    span = building.spans_m[k] if element == "opening" else (0.0, float(norm(building.walls_m[wall][1] - building.walls_m[wall][0])))
    return int(building.wall_storeys[wall]), _area(element, quad(building, wall, float(span[0]), float(span[1])))


def _area(element: str, ring: Any) -> Any:
    import shapely

    return shapely.make_valid(shapely.Polygon(ring)).buffer(0.0 if element == "room" else NEAR_M)


def _match(building: Building, edit: Edit, outlines: dict[str, list[tuple[int, Any]]], taken: set[tuple[str, int]]) -> int:
    """Return the number of the element that an edit is of; -1 = none."""
    mine, best = _area(edit.element, edit.outline), (LEAST_OVERLAP, -1)
    for number, (storey, other) in enumerate(outlines[edit.element]):
        if storey == edit.storey and (edit.element, number) not in taken and mine.intersects(other):
            overlap = mine.intersection(other).area / max(mine.union(other).area, 1e-9)
            best = max(best, (overlap, number))
    return best[1]


def _add_opening(building: Building, edit: Edit) -> tuple[Building, int]:
    """Put an opening into the wall that it lies in most; returns its number, -1 where there is no wall."""
    mine, best = _area("room", edit.outline), (LEAST_OVERLAP * _area("room", edit.outline).area, -1)
    for number in range(len(building.walls_m)):
        if building.wall_storeys[number] == edit.storey:
            best = max(best, (mine.intersection(_outline(building, "wall", number)[1]).area, number))
    wall = best[1]
    if wall < 0:
        return building, -1
    start, end = building.walls_m[wall]
    length = float(norm(end - start))
    along = (end - start) / max(length, 1e-9)
    places = matmul(np.array(edit.outline) - start, along)
    span = np.clip([places.min(), places.max()], 0.0, length)
    rooms = [_room_beside(building, wall, span.mean(), side) for side in (1.0, -1.0)]
    added: dict[str, Any] = {
        "opening_walls": wall, "opening_kinds": OPENING_KINDS.index(edit.kind), "spans_m": span, "opening_heights_m": edit.heights_m,
        "opening_covariance": np.full((4, 4), np.nan), "opening_rooms": rooms,
    }  # fmt: skip
    arrays: dict[str, Any] = {name: np.concatenate([old := getattr(building, name), np.array([value], old.dtype)]) for name, value in added.items()}
    return replace(building, **arrays), len(building.spans_m)


def _room_beside(building: Building, wall: int, place: float, side: float) -> int:
    """Return the room on the left (1) or right (-1) of a wall at a place along it; -1 = none."""
    import shapely

    face, _, _, back = quad(building, wall, place, place)
    outward = (face - back) / max(float(norm(face - back)), 1e-9)
    x, y = (face if side > 0.0 else back) + side * BESIDE_M * outward
    rooms = rooms_on(building, int(building.wall_storeys[wall]))
    return next((k for k in rooms if shapely.contains_xy(shapely.make_valid(shapely.Polygon((r := rings_of(building, k))[0], r[1:])), x, y)), -1)


def _renumbered(keep: Bool) -> Any:
    """Return the new number of each element, and -1 for those that go and, at the end, for -1."""
    return np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1).astype(np.int32)


def _new_numbers(numbers: Any, old: Any) -> Any:
    """Return new numbers of old ones; -1 for those of no element."""
    whole = old.astype(int)
    return numbers[np.where((whole >= 0) & (whole < len(numbers)), whole, -1)]


def _without(building: Building, keep: dict[str, Bool], numbers: dict[str, Any]) -> Building:
    """Return the building without some of its elements."""
    walls, rooms, openings = keep["wall"], keep["room"], keep["opening"]
    open_rooms = {int(of) for of, a, b in building.loops for wall in building.corner_walls[a:b] if wall >= 0 and not walls[wall]}
    closed = building.closed & [k not in open_rooms for k in range(len(rooms))] if len(rooms) else building.closed
    loops = building.loops[rooms[building.loops[:, 0]]]
    corners = np.concatenate([np.arange(a, b) for _, a, b in loops] or [np.empty(0, int)]).astype(int)
    ends = np.cumsum([b - a for _, a, b in loops], dtype=np.int32).reshape(-1)
    unseen, support = building.unseen.copy(), building.support.copy()
    doubts = building.doubts.copy()
    doubts[:, 0] = _new_numbers(numbers["room"], doubts[:, 0])
    unseen[:, 0] = _new_numbers(numbers["wall"], unseen[:, 0])
    for element in keep:
        mine = support[:, 0] == ELEMENTS.index(element)
        support[mine, 1] = _new_numbers(numbers[element], support[mine, 1])
    return replace(
        building, walls_m=building.walls_m[walls], wall_storeys=building.wall_storeys[walls], thickness_m=building.thickness_m[walls],
        wall_covariance=building.wall_covariance[walls], unseen=unseen[unseen[:, 0] >= 0], room_storeys=building.room_storeys[rooms],
        loops=np.stack([numbers["room"][loops[:, 0]], ends - (loops[:, 2] - loops[:, 1]), ends], axis=1).astype(np.int32),
        corners_m=building.corners_m[corners], corner_walls=numbers["wall"][building.corner_walls[corners]],
        edge_sigma_m=building.edge_sigma_m[corners], areas_m2=building.areas_m2[rooms], area_variance=building.area_variance[rooms],
        closed=np.asarray(closed)[rooms], opening_walls=numbers["wall"][building.opening_walls[openings]],
        opening_kinds=building.opening_kinds[openings], spans_m=building.spans_m[openings], opening_heights_m=building.opening_heights_m[openings],
        opening_covariance=building.opening_covariance[openings], opening_rooms=numbers["room"][building.opening_rooms[openings]],
        support=support[support[:, 1] >= 0], doubts=doubts[doubts[:, 0] >= 0],
    )  # fmt: skip
