"""Preview of an ablation (`--dry-run`): what each alternative computes, reads and shares with which others, and which are done; nothing is run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from trihedron.comparison.swaps import Combination
from trihedron.pipeline.app.alternatives import Alternatives
from trihedron.pipeline.core.errors import printable
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.run.replay import RECORDED
from trihedron.pipeline.run.side_by_side import SideBySide, users_of
from trihedron.pipeline.sweep.jobs import DONE
from trihedron.pipeline.sweep.preview import AGAIN, TO_RUN


def preview(computing: Alternatives, combinations: Sequence[Combination], folders: Sequence[Path], done: bool) -> str:
    """Describe the alternatives of one recording, numbered from 1, and count the stages that they compute; `done`: their figures are known."""
    together = SideBySide(computing.runners, computing.threads)
    users = users_of(together.node_of)
    states = [DONE if done else AGAIN if (folder / RECORDING).exists() else TO_RUN for folder in folders]
    lines = [f"{computing.recording.path}: {len(states)} alternatives, {together.count} frames"]
    for number, (runner, nodes) in enumerate(zip(computing.runners, together.node_of)):
        read = [name.removeprefix(RECORDED) for name in nodes if name.startswith(RECORDED)]
        lines.append(f"{number + 1}  {combinations[number].label}: {states[number]}")
        lines += _line("computes again", (name for name in runner.computed if name in computing.stages))
        lines += _line("computes once, not recorded", (name for name in runner.computed if name not in computing.stages))
        lines += _line("reads", read)
        for (verb, others), names in _group_shared_nodes(number, nodes, users).items():
            lines += _line(f"{verb} for {', '.join(str(other + 1) for other in others)} too", names)
    stages = [len(users[node]) for node in users if not node.startswith(RECORDED)]
    return "\n".join([*map(printable, lines), f"{sum(stages)} stages, {len(stages)} of them different, which are computed"])


def _group_shared_nodes(number: int, nodes: Mapping[str, str], users: Mapping[str, Sequence[int]]) -> dict[tuple[str, tuple[int, ...]], list[str]]:
    """Group the stages and topics of an alternative by the others that have the same."""
    found: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for name, node in nodes.items():
        verb = "read" if name.startswith(RECORDED) else "computed"
        if others := tuple(other for other in users[node] if other != number):
            found.setdefault((verb, others), []).append(name.removeprefix(RECORDED))
    return found


def _line(title: str, names: Iterable[str]) -> list[str]:
    text = ", ".join(names)
    return [f"   {title}: {text}"] if text else []
