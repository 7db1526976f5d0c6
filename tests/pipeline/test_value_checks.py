"""Values from a recording are checked before a compiled kernel sees them: each of these ended the process, or gave numbers of other memory."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from trihedron.comparison.error_budget import rewrite
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app.recorded_run import recorded_config_of
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record.codec import Encoder
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.run.replay import Replay
from trihedron.pipeline.run.runner import Runner

DAMAGED = "the file is damaged; record it again"
AT = 5  # the frame whose value is changed


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source")
    words = ["dataset.width=320", "dataset.height=240", "dataset.length=8", "record.topics=[normals]", "record.frames=true"]
    assert main(["run", *words, f"out={folder}"]) == 0
    return Recording(folder / "run.mcap")


@pytest.fixture(scope="module")
def graph(source):
    return graph_of(compose_run([], recorded_config_of(source)))


def with_number(field, number, column=...):
    """The value with one number of an array changed."""

    def changed(value):
        array = np.array(getattr(value, field))
        array[(0, column)[: array.ndim] if column is not ... else (0,) * array.ndim] = number
        return replace(value, **{field: array})

    return changed


def column_of(table, name, number):
    def changed(value):
        rows = getattr(value, table)
        column = np.full((1, *rows.schema[name].shape), number)
        return replace(value, **{table: rows.updated(np.zeros(1, np.int32), **{name: column})})

    return changed


LIMIT = 2**31 - 1
ATTACKS = [  # topic, change, stage to compute again, message after the place
    *(("tracks", with_number("keypoints", number, 1), "translation", f"the field 'keypoints' names row {number} of keypoints")
      for number in (LIMIT, 2**24, -1)),
    ("tracks", with_number("segments", LIMIT, 1), "translation", f"the field 'segments' names row {LIMIT} of segments"),
    ("tracks", with_number("keypoints", 2**24, 0), "tracks", None),  # computed again itself
    ("tracks", with_number("R_current_previous", 7.0), "rotation", f"the field 'R_current_previous' is not a rotation; {DAMAGED}"),
    ("matches", with_number("keypoints", LIMIT, 0), "pose", f"the field 'keypoints' names row {LIMIT} of keypoints"),
    ("matches", with_number("keypoints", 2**24, 1), "pose", f"the field 'keypoints' names row {2**24} of map.points"),
    ("matches", with_number("visible_points", LIMIT), "map", f"the field 'visible_points' names row {LIMIT} of map.points"),
    ("planes", with_number("labels", 255), "manhattan", "the field 'labels' names row 255 of coefficients"),
    ("planes", lambda value: replace(value, stride=0), "manhattan", f"the field 'stride' is not within 1 … 1024; {DAMAGED}"),
    ("planes", with_number("coefficients", np.nan), "manhattan", f"the field 'coefficients' holds planes without a unit normal; {DAMAGED}"),
    ("planes", lambda value: replace(value, labels=value.labels[:2, :2]), "map",
     "the field 'labels' has 2 x 2 cells of 2 pixels, too few for the image"),
    ("keypoints", with_number("pixels", np.inf), "tracks", f"the field 'pixels' is not finite; {DAMAGED}"),
    ("keypoints", lambda value: replace(value, descriptors=value.descriptors[:, :1].copy()), "tracks", "the field 'descriptors' has 1 bytes a row"),
    ("pose", lambda value: replace(value, status="fine"), "map", f"the field 'status' is none of ok, degraded, lost; {DAMAGED}"),
    ("pose", lambda value: replace(value, T_world_camera=2.0 * value.T_world_camera), "map",
     f"the field 'T_world_camera' is not a rotation with a translation; {DAMAGED}"),
    ("map", column_of("points", "first", 2**24), "pose", f"the field 'points' has a column 'first' that names row {2**24} of keyframes"),
    ("map", column_of("point_observations", "point", -1), "pose", "the field 'point_observations' has a column 'point' that names row -1 of points"),
    ("map", with_number("calibration_score", np.nan), "pose", f"the field 'calibration_score' is not finite; {DAMAGED}"),
    ("map", lambda value: replace(value, points=value.lines), "pose", "the field 'points' has no column 'position_m' of float64[3]"),
    ("rotation", with_number("R_world_camera", np.nan), "pose", f"the field 'R_world_camera' is not a rotation; {DAMAGED}"),
    ("frames", lambda value: replace(value, camera=replace(value.camera, fx=0.0)), "pose",
     f"the field 'camera.fx' is not within 0.001 … 1e+06; {DAMAGED}"),
]  # fmt: skip


def computed_again(graph, file, stage):
    for _ in Runner(graph, replay=Replay(Recording(file), (stage,))).steps(None, frozenset()):
        pass


@pytest.mark.parametrize("topic, change, stage, message", ATTACKS, ids=lambda value: value if isinstance(value, str) else "")
def test_a_wrong_number_is_one_line(source, graph, tmp_path, topic, change, stage, message):
    file, at = tmp_path / "edited.mcap", AT if topic != "map" else next(source.values("map")).index
    rewrite(source, file, {topic: lambda value: change(value) if value.index == at else value})
    with contextlib.nullcontext() if message is None else pytest.raises(RecordingError) as error:
        computed_again(graph, file, stage)
    assert message is None or str(error.value).startswith(f"{file}: topic /{topic}, frame {at}: {message}")
    assert message is None or "\n" not in str(error.value)


def test_the_command_prints_the_line(source, tmp_path, capsys):
    file = tmp_path / "edited.mcap"
    rewrite(source, file, {"rotation": lambda value: replace(value, R_world_camera=2.0 * value.R_world_camera) if value.index == AT else value})
    assert main(["run", f"replay={file}", "only=[pose]", f"out={tmp_path}/again"]) == 1
    line = f"trihedron: {file}: topic /rotation, frame {AT}: the field 'R_world_camera' is not a rotation; {DAMAGED}"
    assert capsys.readouterr().err.splitlines() == [line]


def test_a_recording_as_it_was_written_passes(source, graph, tmp_path, capsys):
    """Stages computed again together, and each alone from the recorded values of all others, give the same bytes."""
    stages = ("tracks", "rotation", "translation", "matches", "pose", "map")
    assert main(["run", f"replay={source.path}", f"only=[{','.join(stages)}]", f"out={tmp_path}/all"]) == 0
    assert main(["diff", str(source.path), f"{tmp_path}/all/run.mcap"]) == 0, capsys.readouterr().out
    for stage in stages:
        steps = Runner(graph, replay=Replay(source, (stage,))).steps(None, frozenset())
        again = [Encoder().encode(value) for step in steps if (value := step.values[stage]) is not None]
        assert again == [Encoder().encode(value) for value in source.values(stage)] and again, stage
