"""Array fields with a declared element type and shape, checked in O(1), and the base of the values that have them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.described import Described

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


class Shape:
    """Lengths of an array's axes: an int is exact, a letter is a length shared within the value."""

    def __init__(self, *axes: int | str) -> None:
        self.axes = axes

    def __repr__(self) -> str:
        return "(" + ", ".join(map(str, self.axes)) + ")"


@dataclass(frozen=True)
class ArraySpec:
    """The element type and shape that a field's annotation declares."""

    name: str
    dtype: np.dtype[Any]
    shape: Shape

    @cached_property
    def exact(self) -> tuple[int, ...] | None:
        """The only shape that fits, None where an axis has any length."""
        axes = tuple(axis for axis in self.shape.axes if isinstance(axis, int))
        return axes if len(axes) == len(self.shape.axes) else None


@cache
def array_specs(kind: Any) -> tuple[ArraySpec, ...]:
    """Return the array fields of a value type, in order."""
    found = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated and (shape := next((item for item in get_args(hint)[1:] if isinstance(item, Shape)), None)) is not None:
            found.append(ArraySpec(name, _element_type(get_args(hint)[0]), shape))
    return tuple(found)


def _element_type(array: Any) -> np.dtype[Any]:
    """Return float64 for NDArray[float64], which is a `type` alias from NumPy 2.5 on and `ndarray[shape, dtype[float64]]` before."""
    last = get_args(array)[-1]
    element: np.dtype[Any] = np.dtype((get_args(last) or (last,))[0])
    return element


def check_arrays(value: Any) -> None:
    """Raise ValueError unless each array of `value` has its declared type and shape; make it read-only."""
    lengths: dict[str, int] = {}
    for spec in array_specs(value.__class__):
        array = getattr(value, spec.name)
        if array.__class__ is np.ndarray and array.dtype is spec.dtype and array.shape == spec.exact:  # nearly all, each some dozens of times a frame
            array.setflags(write=False)
            continue
        if not isinstance(array, np.ndarray) or array.dtype != spec.dtype:
            given = getattr(array, "dtype", type(array).__name__)
            raise ValueError(f"{type(value).__name__}.{spec.name}: expected an array of {spec.dtype}, got {given}")
        shape, axes = array.shape, spec.shape.axes
        fits = len(shape) == len(axes)
        for size, axis in zip(shape, axes):
            fits = fits and size == (lengths.setdefault(axis, size) if axis.__class__ is str else axis)
        if not fits:
            known = f" with {lengths}" if lengths else ""
            raise ValueError(f"{type(value).__name__}.{spec.name}: expected shape {spec.shape}, got {shape}{known}")
        array.setflags(write=False)


@dataclass(frozen=True)
class Value(Described):
    """Base of everything on a wire."""

    version: ClassVar[int] = 1  # of the type's fields; a recording made with another one is refused
    dense: ClassVar[bool] = False  # dense topics are recorded only when named

    index: int
    stamp_ns: int

    def __post_init__(self) -> None:
        check_arrays(self)
