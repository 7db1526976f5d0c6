"""Any stage alone, as `trihedron.planes.connected_components(angle_deg=3)(depth, camera)`."""

from __future__ import annotations

import dataclasses
import inspect
import sys
import zlib
from collections.abc import Mapping
from typing import Any, get_type_hints

import numpy as np

from trihedron.camera import Camera
from trihedron.datasets.readers.cameras import Calibration
from trihedron.images import Frames
from trihedron.pipeline.core import types
from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.config import default_plugins
from trihedron.pipeline.core.errors import ConfigError, UsageError, did_you_mean
from trihedron.pipeline.core.options import constraints_of
from trihedron.pipeline.core.registry import load_plugins, options_of, parameters_of_method, plugin_class, plugins_of
from trihedron.pipeline.core.slots import CAMERA, FOLDS, RNG, accepts_none, default_wires, inputs_of, strip_none, summary
from trihedron.pipeline.core.types import Frame, Value
from trihedron.pipeline.run.scheduler import single_threaded_libraries
from trihedron.pipeline.run.warm_up import compilation_reported

COLOUR = {"keypoints", "lines"}  # slots whose plugins look at colour
IMAGES = "rgb (h, w, 3), depth (h, w) and a camera, or a frame"


class Slot:
    """The plugins of one slot as attributes: `trihedron.planes.connected_components(angle_deg=3)` makes a stage.

    `dir(trihedron.planes)` names them; one that does not exist raises PluginError.
    """

    def __init__(self, name: str) -> None:
        load_plugins()
        self._name = name
        self.__doc__ = f"{summary(name)}\n\nPlugins: {', '.join(plugins_of(name))}."

    def __getattr__(self, plugin: str) -> Any:
        if plugin.startswith("__"):
            raise AttributeError(plugin)
        return StageFactory(self._name, plugin, plugin_class(self._name, plugin))

    def __dir__(self) -> list[str]:
        return list(plugins_of(self._name))

    def __repr__(self) -> str:
        return f"<slot {self._name}: {', '.join(plugins_of(self._name))}>"


class StageFactory:
    """A plugin; calling it with options makes a stage (of the slot `dataset`: the data set)."""

    def __init__(self, slot: str, name: str, kind: type[Any]) -> None:
        self._slot, self._name, self._kind = slot, name, kind
        options = options_of(kind)
        called = [] if slot == "dataset" or slot in FOLDS else [_call_of(slot, kind)]
        self.__doc__ = "\n\n".join([inspect.getdoc(kind) or "", *called, *(["Args:\n" + "\n".join(_described(kind))] if options else [])])
        hints, keyword = get_type_hints(kind), inspect.Parameter.KEYWORD_ONLY
        parameters = [inspect.Parameter(option.name, keyword, default=_default(option), annotation=hints[option.name]) for option in options]
        self.__signature__ = inspect.Signature(parameters, return_annotation=kind if slot == "dataset" else Stage)

    def __call__(self, **options: Any) -> Any:
        """Make the stage.

        Args:
            options: as `trihedron plugins SLOT PLUGIN` lists them; the others have their defaults.

        Returns:
            A `Stage`; of the slot `dataset` the data set, whose `dataset(0)` is its first frame.

        Raises:
            ConfigError: an option is unknown or out of range.
        """
        place = f"{self._slot}.{self._name}"
        known = {option.name for option in options_of(self._kind)}
        for name in options:
            if name not in known:
                raise ConfigError(f"{place}({name}=...)", "the plugin has no such option", did_you_mean(name, known))
        try:
            plugin = self._kind(**options)
        except (ValueError, TypeError) as error:
            raise ConfigError(place, str(error), f"see trihedron plugins {self._slot} {self._name}") from error
        return plugin if self._slot == "dataset" else Stage(self._slot, self._name, plugin)

    def __repr__(self) -> str:
        options = ", ".join(f"{option.name}={_default(option)!r}" for option in options_of(self._kind))
        return f"trihedron.{self._slot}.{self._name}({options})"


def _default(option: dataclasses.Field[Any]) -> Any:
    """Return the default of an option, `Parameter.empty` where it has none."""
    if option.default_factory is not dataclasses.MISSING:
        return option.default_factory()
    return inspect.Parameter.empty if option.default is dataclasses.MISSING else option.default


def _call_of(slot: str, kind: type[Any]) -> str:
    """Return the inputs that a stage is called on."""
    hints = inputs_of(slot)
    by_name = _typed({name: hints[name] for name in parameters_of_method(slot, kind) if name in hints and name != "frame"})
    return f"The stage is called on {IMAGES}" + (f"; by name on any of: {by_name}." if by_name else ".")


def _typed(hints: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={strip_none(hint).__name__}" for name, hint in hints.items())


def _described(kind: type[Any]) -> list[str]:
    """Return a line for each option of a plugin: its comment and range."""
    comments, ranges = field_comments(kind), constraints_of(kind)
    texts = {option.name: [comments.get(option.name, ""), " and ".join(map(str, ranges.get(option.name, ())))] for option in options_of(kind)}
    return [f"    {name}: {'; '.join(filter(None, text)) or 'see above'}." for name, text in texts.items()]


class Stage:
    """A plugin with its options that is called on arrays, frames and values.

    `stage(depth, camera)`, `stage(rgb, depth, camera)` or `stage(frame)`, then any inputs of the slot: by their names, as `normals=normals`, or by
    their types alone. What is missing and cannot be None is computed by the default plugin of its slot, which is printed once for each stage.

    Examples:
        >>> import trihedron as th
        >>> frame = th.dataset.synthetic(length=1, width=160, height=120)(0)
        >>> normals = th.normals.integral_image()(frame.depth_m, frame.camera)
        >>> planes = th.planes.connected_components(angle_deg=3)(frame, normals=normals)
        >>> len(planes.coefficients) > 0, planes.coefficients.shape[1]
        (True, 4)
    """

    def __init__(self, slot: str, name: str, plugin: Any) -> None:
        self.slot, self.name, self.plugin = slot, name, plugin
        self._printed: set[str] = set()
        self.__doc__ = "\n\n".join([inspect.getdoc(plugin) or "", *([] if slot in FOLDS else [_call_of(slot, type(plugin))])])

    def __call__(self, *arguments: Any, **inputs: Any) -> Any:
        """Compute the slot's value, or None.

        Args:
            arguments: images, a camera, a frame and values, recognised by shape and type: rgb (h, w, 3), depth (h, w).
            inputs: the same by the names of the slot's inputs, and `rgb`, `depth`, `camera`.

        Returns:
            The value, with the largest number and time of the given values, 0 for images alone; None where the plugin has none to give.

        Raises:
            UsageError: an argument is missing, unknown, or of no type that the slot takes, or the slot gathers many frames.
            DataError: an image has another shape or type than the camera's.
        """
        if self.slot in FOLDS:
            cure = f'give Slam(..., {self.slot}="{self.name}", outputs=["{self.slot}"])'
            raise UsageError(f"{self.slot}.{self.name}", "gathers many frames", cure)
        given = _Inputs(self, arguments, inputs)
        given.check(type(self.plugin))
        with single_threaded_libraries(), compilation_reported():
            return given.compute(self.slot, self.plugin)

    def say_default(self, slot: str, plugin: str) -> None:
        """Print, once, that an input is computed by the default plugin.

        Args:
            slot: of the input.
            plugin: the name of its default.
        """
        if slot not in self._printed:
            self._printed.add(slot)
            print(f"trihedron: {self.slot}.{self.name}: '{slot}' is not given; it is computed by {slot}.{plugin}, the default", file=sys.stderr)

    def __repr__(self) -> str:
        options = ", ".join(f"{field.name}={getattr(self.plugin, field.name)!r}" for field in dataclasses.fields(self.plugin))
        return f"trihedron.{self.slot}.{self.name}({options})"


class _Inputs:
    """The arguments of one call, by input of the slot, and the values computed from them."""

    def __init__(self, stage: Stage, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> None:
        self._stage, self._place = stage, f"{stage.slot}.{stage.name}"
        self._types = {name: strip_none(hint) for name, hint in inputs_of(stage.slot).items()}
        self._values: dict[str, Any] = {}
        arrays: dict[str, Any] = {"rgb": None, "depth": None, CAMERA: None}
        for argument in arguments:
            self._place_argument(argument, arrays)
        for name, value in named.items():
            if name in arrays:
                arrays[name] = value
            else:
                self._check(name, value)
                self._values[name] = value
        has_frame = isinstance(self._values.get("frame"), Frame)
        self._images = set(arrays) if has_frame else {name for name, value in arrays.items() if value is not None}
        self._camera = arrays[CAMERA]
        if arrays["depth"] is not None:
            if arrays[CAMERA] is None:
                raise UsageError(f"{self._place}: camera", "is not given", "give trihedron.Camera(...) after the images")
            self._values["frame"] = Frames(Camera.of(arrays[CAMERA]))(self._index(), self._stamp(), arrays["rgb"], arrays["depth"])

    def _place_argument(self, argument: Any, arrays: dict[str, Any]) -> None:
        """Put an argument without a name where its type belongs."""
        if isinstance(argument, (types.Camera, Calibration)):
            arrays[CAMERA] = argument
        elif isinstance(argument, Value):
            fitting = [name for name, kind in self._types.items() if type(argument) is kind and name not in self._values]
            name = "frame" if isinstance(argument, Frame) else fitting[0] if fitting else ""
            if not name:
                kinds = ", ".join(f"{name}: {kind.__name__}" for name, kind in self._types.items())
                raise UsageError(self._place, f"takes no {type(argument).__name__}", f"its inputs are {kinds}")
            self._values[name] = argument
        else:
            shape = np.shape(argument)
            name = "rgb" if len(shape) == 3 else "depth" if len(shape) == 2 else ""
            if not name:
                cause = f"the argument of the shape {shape} is no image"
                raise UsageError(self._place, cause, "give rgb (h, w, 3), depth (h, w), a camera, or inputs by name")
            arrays[name] = argument

    def _check(self, name: str, value: Any) -> None:
        known = {**self._types, "frame": Frame}
        if name not in known:
            raise UsageError(f"{self._place}: {name}", "the slot has no such input", did_you_mean(name, [*known, "rgb", "depth", CAMERA]))
        if value is not None and not isinstance(value, known[name]):
            raise UsageError(f"{self._place}: {name}", f"is {type(value).__name__}", f"give {known[name].__name__}")

    def check(self, kind: type[Any]) -> None:
        """Raise UsageError where neither an input of the stage's plugin nor the images that it is computed from are given."""
        slot, hints = self._stage.slot, inputs_of(self._stage.slot)
        missing = {name: lacking for name in parameters_of_method(slot, kind) if (lacking := self._missing_images(slot, name))}
        if "rgb" in missing.get("frame", ()):
            raise UsageError(f"{self._place}: rgb", f"is not given, and {slot} are found in it", "give rgb (h, w, 3) before depth")
        if "frame" in missing:
            raise UsageError(f"{self._place}: depth", "is not given", "give depth (h, w) and a camera, or a frame")
        if CAMERA in missing:
            raise UsageError(f"{self._place}: camera", "is not given", "give trihedron.Camera(...)")
        if missing:
            images = [image for image in ("rgb", "depth", CAMERA) if any(image in of for of in missing.values())]
            cause = f"lacks {', '.join(missing)}, and has no {', '.join(images)} to compute from"
            cure = f"give {IMAGES}, or by name {_typed({name: hints[name] for name in missing})}"
            raise UsageError(self._place, cause, cure)

    def _missing_images(self, slot: str, parameter: str) -> set[str]:
        """Return the images that are not given and that an input of `slot` is, or is computed from by default plugins."""
        if parameter == CAMERA:
            return {CAMERA} - self._images
        if parameter == RNG or accepts_none(inputs_of(slot)[parameter]):
            return set()
        if parameter == "frame":
            return {"depth", CAMERA, *(["rgb"] if slot in COLOUR else [])} - self._images
        if self._is_given(slot, parameter):
            return set()
        source = default_wires(slot)[parameter].topic
        taken = parameters_of_method(source, plugin_class(source, default_plugins()[source]))
        return {image for name in taken for image in self._missing_images(source, name)}

    def _is_given(self, slot: str, parameter: str) -> bool:
        return parameter in self._values and (slot == self._stage.slot or not parameter.startswith("previous"))

    def compute(self, slot: str, plugin: Any) -> Any:
        """Call a plugin on the inputs it takes."""
        hints, taken = inputs_of(slot), parameters_of_method(slot, type(plugin))
        arguments: dict[str, Any] = {}
        for parameter in taken:
            if parameter == RNG:
                arguments[RNG] = np.random.default_rng([0, self._index(), zlib.crc32(slot.encode())])
            elif parameter == CAMERA:
                arguments[CAMERA] = self._camera_alone()
            else:
                arguments[parameter] = self._input(slot, parameter, hints[parameter])
        return None if any(arguments[p] is None and not accepts_none(hints[p]) for p in taken if p in hints) else plugin(**arguments)

    def _input(self, slot: str, parameter: str, hint: Any) -> Any:
        """Return the input of a plugin of `slot`: given, None, or computed by the default plugin."""
        if self._is_given(slot, parameter):
            return self._values[parameter]
        if accepts_none(hint):
            return None
        source = default_wires(slot)[parameter].topic
        name = default_plugins()[source]
        self._stage.say_default(source, name)
        self._values[parameter] = self.compute(source, plugin_class(source, name)())
        return self._values[parameter]

    def _camera_alone(self) -> types.Camera:
        if isinstance(frame := self._values.get("frame"), Frame):
            return frame.camera
        return Camera.of(self._camera).calibration.camera

    def _index(self) -> int:
        return max((value.index for value in self._values.values() if isinstance(value, Value)), default=0)

    def _stamp(self) -> int:
        return max((value.stamp_ns for value in self._values.values() if isinstance(value, Value)), default=0)
