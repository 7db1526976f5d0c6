"""Preview of a sweep (`--dry-run`): its jobs, which of them are done, and what they share; nothing is run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from trihedron.pipeline.core.config import rewrite_error
from trihedron.pipeline.core.errors import TrihedronError, printable
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.run.side_by_side import equivalence, users_of, vertices_of
from trihedron.pipeline.sweep.jobs import DONE, FAILED, read_job

TO_RUN, AGAIN, REFUSED = "to run", "to run again", "refused"


@dataclass(frozen=True)
class Planned:
    """A job: its folder, its words, its state, the reason of a refusal, and its graph, None where it is refused."""

    folder: Path
    words: Sequence[str]
    state: str
    reason: str = ""
    graph: Graph | None = None


def state_of(folder: Path, key: str) -> str:
    """Return whether the job with a key is done in its folder, or is to run."""
    job = read_job(folder)
    if job.get("key") == key and job.get("state") == DONE:
        return DONE
    return AGAIN if job.get("state") in (DONE, FAILED) else TO_RUN


def refused_job(folder: Path, words: Sequence[str], error: Exception) -> Planned:
    """Return the job whose configuration cannot be composed."""
    return Planned(folder, words, REFUSED, str(error if isinstance(error, TrihedronError) else rewrite_error(error)))


def preview(jobs: Sequence[Planned]) -> str:
    """Describe the jobs, one a line, and count them; a stage is shared when another job computes the same on the same frames."""
    graphs = [job.graph for job in jobs if job.graph is not None]
    classes = equivalence([vertices_of(graph) for graph in graphs])
    users = users_of(classes)
    common = common_words([job.words for job in jobs])
    rows, each = [("job", "state", "change", "stages", "shared with other jobs")], iter(classes)
    for job in jobs:
        change = " ".join(word for word in job.words if word not in common) or "-"
        if job.graph is None:
            rows.append((job.folder.name, job.state, change, "-", job.reason))
            continue
        shared = [name for name, number in next(each).items() if len(users[number]) > 1]
        rows.append((job.folder.name, job.state, change, str(len(job.graph.stages)), ", ".join(shared) or "-"))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    lines = ["  ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[4]]) for row in rows]
    return "\n".join([*map(printable, lines), *_counts(jobs, users)])


def _counts(jobs: Sequence[Planned], users: dict[int, list[int]]) -> list[str]:
    states, words = [job.state for job in jobs], common_words([job.words for job in jobs])
    counts = [f"{states.count(state)} {state}" for state in (DONE, TO_RUN, AGAIN, REFUSED) if state in states]
    stages = sum(map(len, users.values()))
    found = [f"{len(jobs)} jobs: {', '.join(counts)}"]
    if stages > len(users):
        found.append(f"{stages} stages, {len(users)} of them different; trihedron ablate computes what alternatives of a recording share once")
    return [*found, printable(f"words of all jobs: {' '.join(words)}")] if words else found


def common_words(jobs: Sequence[Sequence[str]]) -> list[str]:
    """Return the words that all of several jobs have, in the order of the first; none of a single job."""
    return [word for word in jobs[0] if all(word in job for job in jobs)] if len(jobs) > 1 else []
