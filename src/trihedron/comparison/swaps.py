"""The swaps of an ablation: which stages take which other plugins, options or wires, and every combination of them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from trihedron.pipeline.app.alternatives import Alternative, alternatives_of, same
from trihedron.pipeline.core.config import rewrite_error
from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.sweep.sweep import plugins_alone

MOST = 64  # alternatives of one recording, which are all in memory
AS_RECORDED = "as recorded"
Words = tuple[str, ...]


@dataclass(frozen=True)
class Swap:
    """A stage and the words of each of its alternatives; the first has none: the stage as recorded."""

    stage: str
    levels: tuple[Words, ...]


@dataclass(frozen=True)
class Combination:
    """One level of each swap, as words by stage; stages as recorded are left out."""

    levels: tuple[tuple[str, Words], ...]

    @property
    def words(self) -> Words:
        """The words of all stages."""
        return tuple(word for _, words in self.levels for word in words)

    @property
    def label(self) -> str:
        """The words, or "as recorded"."""
        return " ".join(word.lstrip("+") for word in self.words) or AS_RECORDED

    @property
    def stages(self) -> frozenset[str]:
        """The stages that are swapped."""
        return frozenset(stage for stage, _ in self.levels)

    def part(self, stages: frozenset[str]) -> Combination:
        """Return the same with other stages as recorded."""
        return Combination(tuple(level for level in self.levels if level[0] in stages))


def parse_swaps(words: Sequence[str]) -> list[Swap]:
    """Parse words `KEY=VALUE,VALUE` into one swap a stage, each value of a key with each of the stage's other keys. Raises UsageError."""
    keys: dict[str, dict[str, list[str]]] = {}
    for word in words:
        keys.setdefault(_stage_of(word), {}).update([_values_of(word)])
    swaps = []
    for stage, values in keys.items():
        choices = [[(), *((f"{key}={value}",) for value in some)] for key, some in values.items()]
        swaps.append(Swap(stage, tuple(tuple(word for one in chosen for word in one) for chosen in itertools.product(*choices))))
    return swaps


def _stage_of(word: str) -> str:
    key, equals, _ = word.partition("=")
    parts = key.lstrip("+").split(".")
    stage = parts[1] if parts[0] == "graph" and len(parts) == 3 else parts[0]
    if not equals or key.startswith("~"):
        raise UsageError(word, "is neither a file nor a swap", "give RUN.mcap, or STAGE=PLUGIN,PLUGIN or STAGE.OPTION=VALUE,VALUE")
    if stage not in SLOTS:
        raise UsageError(key, "is not a stage, nor an option or a wire of one", did_you_mean(stage, SLOTS))
    if stage == "dataset":
        raise UsageError(key, "an ablation has the frames of its recordings", "make a recording of the other frames, and give it too")
    return stage


def _values_of(word: str) -> tuple[str, list[str]]:
    """Key and values of a word, as Hydra reads them; `SLOT=*` has all plugins of the slot that can be chosen with nothing else."""
    if word.endswith("=*") and word[:-2] in SLOTS:
        return word[:-2], plugins_alone(word[:-2])
    try:
        override = OverridesParser.create().parse_override(word)
    except OverrideParseException as error:
        raise rewrite_error(error) from error
    key = word.partition("=")[0]
    if not override.is_sweep_override():
        return key, [override.get_value_element_as_str()]
    if not override.is_discrete_sweep():
        raise UsageError(key, f"'{override.input_line}' is a space to search in", "give values A,B")
    return key, list(override.sweep_string_iterator())


def without_repeats(swaps: Sequence[Swap], recordings: Sequence[Recording]) -> list[Swap]:
    """Drop levels that compute what the recorded stage, or a level before, computes. Raises DataError where the recordings disagree on that, or where
    nothing remains to be swapped."""
    found = [_distinct(swaps, recording) for recording in recordings]
    for recording, other in zip(recordings, found):
        if other != found[0]:
            cause = f"was made with another of the given values than {recordings[0].path}"
            raise DataError(str(recording.path), cause, "compare recordings of one configuration")
    if not found[0]:
        raise UsageError("ablate", "the recordings were made with all of the given values", "give another plugin or value")
    return found[0]


def _distinct(swaps: Sequence[Swap], recording: Recording) -> list[Swap]:
    single = [(swap, level) for swap in swaps for level in swap.levels if level]
    base, *others = alternatives_of(recording, [(), *(level for _, level in single)])
    levels: dict[str, list[tuple[Words, Alternative]]] = {swap.stage: [((), base)] for swap in swaps}
    for (swap, level), alternative in zip(single, others):
        if not any(same(alternative, known) for _, known in levels[swap.stage]):
            levels[swap.stage].append((level, alternative))
    return [Swap(stage, tuple(level for level, _ in known)) for stage, known in levels.items() if len(known) > 1]


def combinations_of(swaps: Sequence[Swap]) -> list[Combination]:
    """Return every combination of levels, that of none changed first. Raises UsageError for too many."""
    chosen = itertools.product(*([(swap.stage, level) for level in swap.levels] for swap in swaps))
    return _check_count([Combination(tuple((stage, level) for stage, level in levels if level)) for levels in chosen])


def single_swaps(swaps: Sequence[Swap]) -> list[Combination]:
    """Return what is recorded, then each level of each swap by itself: enough where no stage sees what another one computes. Raises UsageError for
    too many."""
    return _check_count([Combination(()), *(Combination(((swap.stage, level),)) for swap in swaps for level in swap.levels if level)])


def _check_count(found: list[Combination]) -> list[Combination]:
    if len(found) > MOST:
        raise UsageError("ablate", f"these values make {len(found)} alternatives, more than {MOST}", "give fewer values at once")
    return found


def folder_name(prefix: str, combination: Combination) -> str:
    """Return the name of an alternative's folder: its words, with what file systems and shells take badly replaced."""
    text = ",".join([*([prefix] if prefix else []), *(combination.words or ("as_recorded",))])
    return re.sub(r"[^\w.=,-]", "_", text)[:200]
