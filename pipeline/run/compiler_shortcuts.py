"""Shortcuts through numba's compiler that lead to the same code, for a process that does nothing but compile.

What they leave out: to find the type of a call again that has been found, to take values apart in search of reference counts that none of their parts
has, which LLVM throws away again, and to tell listeners about events when nobody listens.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from numba.core import event, ir, targetconfig
from numba.core.runtime import context as runtime
from numba.core.types import functions

FUNCTION: Any = functions.BaseFunction
INSTRUCTION: Any = ir.Inst
COUNTS: Any = runtime.NRTContext
EVENTS: Any = event
OPTIONS: Any = targetconfig.TargetConfig
STACK: Any = targetconfig.ConfigStack
WITHOUT_VARIABLES = frozenset({str, int, float, bool, type(None), ir.Loc})


def install() -> None:
    """From now on numba takes them, in this process."""
    COUNTS.get_meminfos = _meminfos
    INSTRUCTION._rec_list_vars = lambda instruction, value: _variables(value)
    EVENTS.start_event = EVENTS.end_event = lambda *kind, **data: None
    OPTIONS.__hash__ = lambda options: 0
    find, found = FUNCTION.get_call_type, {}

    def call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
        key = function, context, tuple(args), tuple(kws.items()), STACK.top_or_none()
        if key not in found:
            signature = find(function, context, args, kws)
            found[key] = signature, function.get_impl_key(signature)
        signature, function._impl_keys[signature.args] = found[key]
        return signature

    FUNCTION.get_call_type = call_type


def _meminfos(counts: Any, builder: Any, kind: Any, value: Any) -> list[tuple[Any, Any]]:
    """The counted parts of a value: (type, what counts its references)."""
    models = counts._context.data_model_manager
    found: list[tuple[Any, Any]] = []
    if _counted(models, kind):
        if models[kind].has_nrt_meminfo():
            found.append((kind, models[kind].get_nrt_meminfo(builder, value)))
        for part, getter in models[kind].traverse(builder):
            if _counted(models, part):
                found += _meminfos(counts, builder, part, getter(value))
    return found


@cache
def _counted(models: Any, kind: Any) -> bool:
    """Whether references to values of a type, or to parts of them, are counted."""
    return models[kind].has_nrt_meminfo() or any(_counted(models, part) for part, _ in models[kind].traverse(None))


def _variables(value: Any) -> list[Any]:
    """Those in an instruction, or in a list, tuple or dictionary of such."""
    kind = type(value)
    if kind is ir.Var:
        return [value]
    if kind in WITHOUT_VARIABLES:
        return []
    if isinstance(value, INSTRUCTION):
        return list(value.list_vars())
    values = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return [variable for part in values if type(part) not in WITHOUT_VARIABLES for variable in _variables(part)]
