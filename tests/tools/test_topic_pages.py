"""The page of a topic has the fields of its type, and its decoder, which knows nothing of us, reads recordings as we do."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.arrays import array_specs
from trihedron.pipeline.core.table import CHUNK, Column, Table
from trihedron.pipeline.record.codec import timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.schemas import hints_of, own_fields
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.plugins.mapping.landmarks import empty_map

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "site"))
from topic_pages import page, pages, topic_types

ELSEWHERE = {"bundle", "loop", "relocalise", "model", "building"}  # not in the recording below


def test_the_list_links_a_page_for_each_topic_with_its_fields():
    written = pages()
    index = written.pop("reference/topics/README.md")
    assert [f"reference/topics/{topic}.md" for topic in re.findall(r"^\| \[`/\w+`\]\((\w+)\.md\)", index, re.MULTILINE)] == list(written)
    assert written["reference/topics/pose.md"].startswith("# `/pose`: `trihedron.Pose`\n\nThe camera's pose.")
    for topic, kind in topic_types().items():
        text = written[f"reference/topics/{topic}.md"]
        if kind is not None and topic != "dataset":
            assert [name for name in own_fields(kind) if f"\n| `{name}" not in text] == []


def decoded(topic, path):
    """What the program on the page reads: a dictionary of names for each message."""
    (program,) = re.findall(r"```python\n(.*?)```", page(topic), re.DOTALL)
    assert "trihedron" not in program
    found = []
    exec(program.replace('"run.mcap"', repr(str(path))) + "        found.append(dict(globals()))\n", {"found": found})
    return found


def check(value, read):
    """Compare what a page reads with our value, field by field."""
    names = [name for name in vars(value) if name not in ("index", "stamp_ns") and not name.startswith("_") and name in type(value).__annotations__]
    assert (read["message"].index, read["message"].stamp_ns) == (value.index, value.stamp_ns)
    for name in names:
        ours, theirs = getattr(value, name), read[name]
        if isinstance(ours, Table):
            assert set(theirs) == set(ours.schema)
            for column in theirs:
                np.testing.assert_array_equal(theirs[column], ours.column(column), strict=True)
        elif isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(theirs, ours, strict=True)
        else:
            check_number(ours, theirs)


def check_number(ours, theirs):
    """Compare numbers, NaN with itself, texts, or those of a nested value: a camera."""
    if isinstance(ours, (str, int, float)):
        np.testing.assert_equal(theirs, ours)
        return
    for name, one in vars(ours).items():
        check_number(one, getattr(theirs, name))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Eight frames of the room with all that can be recorded."""
    folder = tmp_path_factory.mktemp("topics") / "run"
    words = ["dataset.width=160", "dataset.height=120", "dataset.length=8", "record.frames=true", "record.topics=[normals]"]
    assert main(["run", *words, "outputs=[trajectory,surface]", f"out={folder}"]) == 0
    return folder / "run.mcap"


@pytest.mark.parametrize("topic", [topic for topic in topic_types() if topic not in ELSEWHERE])
def test_the_page_s_decoder_reads_the_topic(topic, run):
    recording = Recording(run)
    read = decoded(topic, run)
    if topic == "dataset":
        frames, images = list(recording.values(topic)), [one["message"] for one in read]
        assert [one.timestamp.seconds * 10**9 + one.timestamp.nanos for one in images] == [value.stamp_ns for value in frames for _ in range(2)]
        for frame, color, depth in zip(frames, read[::2], read[1::2]):
            np.testing.assert_array_equal(color["color"], frame.color, strict=True)
            np.testing.assert_array_equal(depth["depth_m"], frame.depth_m, strict=True)
        assert len(frames) == 8
        return
    if topic == "timing":
        times = [timing_of(data) for _, data in recording.messages("/timing")]
        assert [(one["message"].index, one["message"].frame_ms, one["times"]) for one in read] == [
            (time["index"], time["frame_ms"], time["stage_ms"]) for time in times
        ]
        assert len(times) == 8 and {"keypoints", "pose"} < set(times[-1]["stage_ms"])
        return
    values = list(recording.values(topic))
    assert len(read) == len(values) > 0
    for value, one in zip(values, read):
        check(value, one)


@pytest.mark.parametrize("topic", sorted(ELSEWHERE))
def test_the_page_s_decoder_reads_any_value(topic, tmp_path):
    """Values of random bytes, whose axes have two elements, or 1500, which are stored transposed."""
    kind, rng = topic_types()[topic], np.random.default_rng(1)
    writer, values = RecordingWriter(tmp_path / "run.mcap", {}), []
    for length in (2, 1500):
        specs = {spec.name: spec for spec in array_specs(kind)}
        made = {"index": length, "stamp_ns": 5}
        for name, hint in hints_of(kind).items():
            if name in specs:
                axes = specs[name].shape.axes
                shape = [length if at == 0 and axis == axes[0] and not isinstance(axis, int) else axis for at, axis in enumerate(axes)]
                shape = [axis if isinstance(axis, int) else 2 for axis in shape]
                made[name] = (100 * rng.random(shape)).astype(specs[name].dtype)
            elif name not in made:
                made[name] = Table.empty({"x": Column("f8")}) if hint is Table else hint("1") if hint is not bool else True
        values.append(kind(**made))
        writer.write(topic, values[-1])
    writer.close()
    read = decoded(topic, tmp_path / "run.mcap")
    assert len(read) == 2
    for value, one in zip(values, read):
        check(value, one)


def test_tables_that_change_over_checkpoints_are_read(tmp_path):
    """150 versions of a map that grows, moves and gives chunks back."""
    table, ids = Table.empty({"x": Column("f8", (3,)), "alive": Column("?")}).appended(x=np.ones((900, 3)), alive=np.ones(900, bool))
    writer, versions = RecordingWriter(tmp_path / "run.mcap", {}), []
    for k in range(150):
        table = table.updated(ids[[3 * k, 899]], x=np.full((2, 3), float(k)))
        if k % 40 == 5:
            table = table.appended(x=np.zeros((300, 3)), alive=np.ones(300, bool))[0].emptied(np.array([k // 40], np.int32))
        versions.append(replace(empty_map(k, 1000 * k, 32, 32, 8), points=table))
        writer.write("map", versions[-1])
    writer.close()
    read = decoded("map", tmp_path / "run.mcap")
    assert len(read) == 150 and len(versions[-1].points) > 4 * CHUNK
    for value, one in zip(versions, read):
        check(value, one)
