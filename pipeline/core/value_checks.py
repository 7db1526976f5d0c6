"""Checks of values that come from a file, by the constraints that their types declare (`core.constraints`).

A value is checked alone when it is read (`record.reader`), and against the other inputs of a stage when it meets them there: ids that name no row
would reach compiled kernels, which check nothing. What a plugin of this run computed is not checked.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields
from numbers import Integral, Real
from operator import attrgetter
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np

from trihedron.pipeline.core.constraints import Columns, CoversImage, Finite, IndexInto, OneOf, Rotations, SameWidth, UnitNormals, Within
from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.slots import SLOTS, output_of
from trihedron.pipeline.core.types import CalibrationSigmas, Camera, Frame, Value

ORTHONORMAL = 1e-6  # of RᵀR - I, its largest element
CAMERA_NUMBERS = (
    *((name, Integral, "a whole number") for name in ("width", "height")),
    *((name, Real, "a number") for name in ("fx", "fy", "cx", "cy", "fps", *(f"sigmas.{one.name}" for one in fields(CalibrationSigmas)))),
)
PREVIOUS = "previous"  # parameters that take an earlier value begin with it
LARGEST = 1e100  # of a number; the square of one has to be finite
UNIT = 1e-6  # of |n| - 1
CURE = "the file is damaged; record it again"


class _Declared(NamedTuple):
    """Declarations of a value type: (field, constraint) in order, those of them that name other inputs, and the fields that hold a camera or what
    belongs to one, whose own fields are checked too."""

    constraints: tuple[tuple[str, Any], ...]
    together: tuple[tuple[str, Any], ...]
    nested: tuple[str, ...]


_KNOWN: dict[type, _Declared] = {}


def constraints_of(kind: type) -> tuple[tuple[str, Any], ...]:
    """(field, constraint) of a value type, in order."""
    return _declared(kind).constraints


def _declared(kind: type) -> _Declared:
    if kind not in _KNOWN:
        hints = get_type_hints(kind, include_extras=True).items()
        found = [(name, item) for name, hint in hints if get_origin(hint) is Annotated for item in get_args(hint)[1:] if type(item) in _CHECKS]
        together = [(name, item) for name, item in found if isinstance(item, IndexInto | SameWidth | CoversImage)]
        _KNOWN[kind] = _Declared(tuple(found), tuple(together), tuple(name for name, hint in hints if hint in (Camera, CalibrationSigmas)))
    return _KNOWN[kind]


def validate_value(topic: str, value: Value, place: str, expected: type[Value] = Value) -> Value:
    """The value, after the checks that need no other value: of the type of its slot, or an `expected` one. Raises RecordingError naming the file,
    topic, frame and field."""
    expected = output_of(topic) if topic in SLOTS else expected
    if not isinstance(value, expected):
        raise RecordingError(f"{place}: topic /{topic}, frame {value.index}", f"is {type(value).__name__}, not {expected.__name__}", CURE)
    for name, cause in _faults(value, ""):
        raise RecordingError(f"{place}: topic /{topic}, frame {value.index}", f"the field '{name}' {cause}", CURE)
    return value


def camera_fault(camera: Camera) -> str:
    """Return the first number of a camera that is not what `Camera` declares, with the cause, as 'fx is not within 0.001 … 1e+06'; empty for none."""
    if not isinstance(camera.sigmas, CalibrationSigmas):
        return f"sigmas is {type(camera.sigmas).__name__}, not CalibrationSigmas"
    for name, kind, described in CAMERA_NUMBERS:
        value = attrgetter(name)(camera)
        if isinstance(value, bool) or not isinstance(value, kind):
            return f"{name} is {type(value).__name__}, not {described}"
    return next((f"{name} {cause}" for name, cause in _faults(camera, "")), "")


def check_together(inputs: Mapping[str, Any], place: str, topics: Mapping[str, str], computed: Collection[str] = ()) -> None:
    """Check what the inputs of one call, by parameter, say of each other; `topics` gives the topic of each, `computed` the topics that this run
    computes. Raises RecordingError."""
    for parameter, value in inputs.items():
        if not isinstance(value, Value) or topics.get(parameter) in computed:
            continue
        for name, constraint in _declared(type(value)).together:
            if cause := _fault_together(getattr(value, name), constraint, value, _of_its_time(parameter, value, inputs)):
                topic = topics.get(parameter, parameter)
                others = any(topics.get(other) in computed for other in inputs)
                cure = f"compute it again too, with 'only=[{topic},...]', or the file is damaged" if others else CURE
                raise RecordingError(f"{place}: topic /{topic}, frame {value.index}", f"the field '{name}' {cause}", cure)


def _of_its_time(parameter: str, value: Value, inputs: Mapping[str, Any]) -> Mapping[str, Any]:
    """The inputs as an earlier value (`previous`, `previous_pose`) names them: its `keypoints` are now `previous_keypoints`, if of the same frame."""
    if not parameter.startswith(PREVIOUS):
        return inputs
    earlier = {name.removeprefix(f"{PREVIOUS}_"): other for name, other in inputs.items() if name.startswith(f"{PREVIOUS}_")}
    found = {name: other for name, other in earlier.items() if isinstance(other, Value) and other.index == value.index}
    return {**found, "map": inputs.get("map")}


def _faults(value: Any, prefix: str) -> Any:
    """(field, cause) of every error that a value shows without others."""
    for name, constraint in constraints_of(type(value)):
        if cause := _CHECKS[type(constraint)](getattr(value, name), constraint, value):
            yield prefix + name, cause
    if isinstance(value, Frame) and value.color.shape[:2] != (value.camera.height, value.camera.width):
        yield f"{prefix}color", "has not the camera's size"
    for name in _declared(type(value)).nested:
        yield from _faults(getattr(value, name), f"{prefix}{name}.")


def _fault_of_index(array: Any, rule: IndexInto, owner: Any) -> str:
    """Cause, where an index lies outside; a target in another input is only known to be at least 0."""
    array = np.asarray(array)
    if not array.size:
        return ""
    for column, target in _targets(array, rule):
        size = len(getattr(owner, target.strip(".+"))) + target.endswith("+") if target.startswith(".") else None
        if cause := _outside(column, rule.least, size, target):
            return cause
    return ""


def _targets(array: Any, rule: IndexInto) -> list[tuple[Any, str]]:
    if len(rule.targets) == 1:
        return [(array, rule.targets[0])]
    return [(array[..., column], target) for column, target in enumerate(rule.targets)]


def _outside(array: Any, least: int, size: int | None, target: str) -> str:
    low, high = int(array.min()), int(array.max())
    if low < least or (size is not None and high >= size):
        return f"names row {low if low < least else high} of {target.strip('.+')}" + (f", which has {size} rows" if size is not None else "")
    return ""


def _fault_together(array: Any, rule: Any, owner: Value, inputs: Mapping[str, Any]) -> str:
    """Cause, where a value does not fit the other inputs."""
    if isinstance(rule, IndexInto) and (array := np.asarray(array)).size:
        for column, target in _targets(array, rule):
            table = None if target.startswith(".") else _target(target, inputs)
            if table is not None and (cause := _outside(column, rule.least, len(table), target)):
                return cause
    elif isinstance(rule, SameWidth) and len(array):
        for other in (_target(name, inputs) for name in rule.others):
            if other is not None and len(other) and other.shape[1] != array.shape[1]:
                return f"has {array.shape[1]} bytes a row, those it is compared with have {other.shape[1]}"
    elif isinstance(rule, CoversImage) and isinstance(frame := inputs.get("frame"), Frame) and array.size:
        (rows, columns), stride = array.shape[:2], getattr(owner, "stride", 1)
        if rows * stride < frame.camera.height - stride + 1 or columns * stride < frame.camera.width - stride + 1:
            return f"has {rows} x {columns} cells of {stride} pixels, too few for the image"
    return ""


_ROWS_OF = {"keypoints": "pixels", "segments": "endpoints_px", "planes": "coefficients"}


def _target(name: str, inputs: Mapping[str, Any]) -> Any:
    """The rows that a name refers to: of an input, or of a table in it, or None when the stage has no such input."""
    parameter, *path = name.split(".")
    found = inputs.get(parameter)
    if found is None:
        return None
    if not path:
        return getattr(found, _ROWS_OF[parameter.removeprefix("previous_")])
    table = getattr(found, path[0])
    return table if len(path) == 1 else table.shared(path[1])


def _fault_of_numbers(array: Any, rule: Within, owner: Any) -> str:
    array = np.asarray(array)
    if array.size and not (array.min() >= rule.low and array.max() <= rule.high):
        return f"is not within {rule.low:g} … {rule.high:g}"
    return ""


def _fault_of_word(word: Any, rule: OneOf, owner: Any) -> str:
    return "" if word in rule.words else f"is none of {', '.join(rule.words)}"


def _fault_of_finite(array: Any, rule: Finite, owner: Any) -> str:
    if not np.isfinite(array).all():
        return "is not finite"
    return "" if float(np.abs(array).max(initial=0)) <= LARGEST else f"holds numbers beyond {LARGEST:g}"


def _fault_of_rotations(array: Any, rule: Rotations, owner: Any) -> str:
    array = np.asarray(array).reshape(-1, *np.shape(array)[-2:])
    if rule.or_none:
        array = array[~np.isnan(array).all(axis=(1, 2))]
    R = array[:, :3, :3]
    with np.errstate(all="ignore"):
        right_handed = (np.cross(R[:, 0], R[:, 1]) * R[:, 2]).sum(axis=1) > 0
        fits = (np.abs(matmul(np.swapaxes(R, 1, 2), R) - np.eye(3)) <= ORTHONORMAL).all() and right_handed.all()
    if array.shape[-1] == 4:
        fits = fits and np.isfinite(array).all() and (array[:, 3] == [0, 0, 0, 1]).all()
    return "" if fits else "is not a rotation" + " with a translation" * (array.shape[-1] == 4)


def _fault_of_planes(array: Any, rule: UnitNormals, owner: Any) -> str:
    array = np.asarray(array)
    with np.errstate(all="ignore"):
        fits = (np.abs(np.linalg.norm(array[..., :3], axis=-1) - 1.0) <= UNIT).all() and np.isfinite(array).all()
    return "" if fits else "holds planes without a unit normal"


def _fault_of_table(table: Any, rule: Columns, owner: Any) -> str:
    """Cause, where a column is missing or of another type, or one of its numbers is wrong."""
    alive = None
    for name, (dtype, shape, *constraints) in rule.columns.items():
        column = table.schema.get(name)
        known = column is not None and np.dtype(column.dtype) == dtype and len(column.shape) == len(shape)
        if not known or any(wanted not in (None, size) for wanted, size in zip(shape, column.shape)):
            return f"has no column '{name}' of {np.dtype(dtype)}{list(shape)}"
        if constraints and alive is None and "alive" in rule.columns and "alive" in table.schema:
            alive = table.shared("alive")
        for constraint in constraints:
            numbers = table.shared(name)
            numbers = numbers if alive is None or isinstance(constraint, IndexInto) else numbers[alive]
            if cause := _CHECKS[type(constraint)](numbers, constraint, owner):
                return f"has a column '{name}' that {cause}"
    return ""


def _nothing_alone(array: Any, rule: Any, owner: Any) -> str:
    return ""


_CHECKS: dict[type, Any] = {
    IndexInto: _fault_of_index, Within: _fault_of_numbers, OneOf: _fault_of_word, Finite: _fault_of_finite, Rotations: _fault_of_rotations,
    UnitNormals: _fault_of_planes, Columns: _fault_of_table, SameWidth: _nothing_alone, CoversImage: _nothing_alone,
}  # fmt: skip
