"""Ranges of options: each is enforced when a plugin is constructed, named in the error, and holds for the default."""

import sys
from dataclasses import dataclass, replace
from typing import Annotated

import pytest

from trihedron.pipeline.core import registry
from trihedron.pipeline.core.config import compose_run
from trihedron.pipeline.core.options import FrameRange, Frames, OneOf, PositiveFloat, Range, Share, check_increasing, constraints_of, frame_range
from trihedron.pipeline.core.recorded_config import recorded_config
from trihedron.pipeline.core.registry import load_plugins, plugins_of, register
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Frame, Normals


def test_options_of_a_recording_are_forgotten_by_the_next_composition():
    recorded = recorded_config("{pose: {plugin: refine, line_sigma_px: 2.0}}", "a.mcap")
    assert [compose_run([], given).pose.line_sigma_px for given in (None, recorded, None)] == [1.0, 2.0, 1.0]


BOUNDS = [  # range, its text, permitted, refused
    (Range(0, 90), "within 0 … 90", (0, 90, 45.0), (-1, 90.1, float("nan"))),
    (Range(1), "at least 1", (1, float("inf")), (0, float("nan"))),
    (Range(high=2), "at most 2", (2, -5), (3,)),
    (Range(above=0), "positive", (0.1,), (0, -1)),
    (Range(above=0, high=1), "above 0 and at most 1", (0.5, 1), (0, 1.1)),
    (Range(above=0, below=90), "above 0 and below 90", (89.9,), (0, 90)),
    (Range(0, below=45), "at least 0 and below 45", (0, 44.9), (45, -0.1)),
    (OneOf(3, 5, 7), "one of 3, 5, 7", (3, 7), (4,)),
    (
        FrameRange(),
        "a range of frames A:B[:S] with A < B, S > 0",
        ("", "3:", ":4", "3:4", "3:4:2", "::"),
        ("3", "4:3", "a:b", "-2:", "0:500:0", "0:500:-1", "1:2:3:4"),
    ),
]


@pytest.mark.parametrize("constraint, text, permitted, refused", BOUNDS, ids=[text for _, text, *_ in BOUNDS])
def test_a_range_permits_what_its_text_states(constraint, text, permitted, refused):
    assert str(constraint) == text
    assert all(constraint.permits(value) for value in permitted)
    assert not any(constraint.permits(value) for value in refused)


def test_a_range_of_frames():
    assert [frame_range(text) for text in ("", "3:", ":4", " 3 : 14 ", "3:14:4", "::5")] == [
        *(range(sys.maxsize), range(3, sys.maxsize), range(4), range(3, 14), range(3, 14, 4), range(0, sys.maxsize, 5)),
    ]


@dataclass(frozen=True)
class Example:
    share: Share = 0.5
    low: PositiveFloat = 1.0
    high: Annotated[float, Range(0, 10)] = 2.0
    frames: Frames = ""
    free: float = -1.0

    def __post_init__(self) -> None:
        check_increasing(self, "low", "high")

    def __call__(self, frame: Frame) -> Normals | None: ...


@dataclass(frozen=True)
class Inherits(Example):
    high: Annotated[float, Range(0, 4)] = 3.0
    window: Annotated[int, OneOf(3, 5)] = 3


@pytest.mark.parametrize(
    "kind, options, message",
    [
        (Example, {"share": 1.5}, "share: 1.5 is not within 0 … 1"),
        (Example, {"low": 0.0}, "low: 0.0 is not positive"),
        (Example, {"low": float("nan")}, "low: nan is not positive"),
        (Example, {"low": 3.0}, "low: 3.0 is not at most high, 2.0"),
        (Example, {"low": 30.0, "high": 20.0}, "high: 20.0 is not within 0 … 10"),  # the range before the order
        (Example, {"frames": "5"}, "frames: '5' is not a range of frames A:B[:S] with A < B, S > 0"),
        (Example, {"frames": "0:500:0"}, "frames: '0:500:0' is not a range of frames A:B[:S] with A < B, S > 0"),
        (Example, {"frames": "0:500:-1"}, "frames: '0:500:-1' is not a range of frames A:B[:S] with A < B, S > 0"),
        (Inherits, {"share": -1}, "share: -1 is not within 0 … 1"),
        (Inherits, {"high": 5.0}, "high: 5.0 is not within 0 … 4"),
        (Inherits, {"window": 4}, "window: 4 is not one of 3, 5"),
    ],
)
def test_a_registered_plugin_refuses_an_option_out_of_range(monkeypatch, kind, options, message):
    registry.load_plugins()
    monkeypatch.setattr(registry, "_PLUGINS", {slot: {} for slot in SLOTS})
    plugin = register("normals", "mine")(dataclass(frozen=True)(type("Mine", (kind,), {})))
    assert plugin(free=-5.0).free == -5.0
    for construct in (lambda: plugin(**options), lambda: replace(plugin(), **options)):
        with pytest.raises(ValueError) as error:
            construct()
        assert str(error.value) == message


def test_every_declared_range_is_enforced_on_every_plugin():
    load_plugins()
    count = 0
    for slot in SLOTS:
        for plugin in plugins_of(slot).values():
            for option, constraints in constraints_of(plugin).items():
                for value in (-1e9, 1e9, "9:3"):
                    broken = [c for c in constraints if isinstance(value, str) == isinstance(c, FrameRange) and not c.permits(value)]
                    if broken:
                        with pytest.raises(ValueError, match=rf"^{option}: "):
                            plugin(**{option: value})
                        count += 1
    assert count > 400


@pytest.mark.parametrize("value", ["x", None, [1]])
def test_an_option_of_another_kind_is_out_of_its_range(value):
    with pytest.raises(ValueError, match=r"^angle_deg: .* is not above 0 and below 90$"):
        registry.plugin_class("planes", "connected_components")(angle_deg=value)
