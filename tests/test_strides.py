"""Every S-th frame of a data set: numbers, files and replays of a run, as its user sees them."""

import numpy as np
import pytest

import trihedron as th
from trihedron.datasets.simulation.simulated_sensor import SimulatedSensor
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main

SMALL = ("dataset.width=160", "dataset.height=120")


@pytest.fixture(scope="module")
def strided(tmp_path_factory):
    """A run over frames 8, 12, … 36, which embeds no images."""
    out = tmp_path_factory.mktemp("strides") / "run"
    assert main(["run", *SMALL, "dataset.frames=8:40:4", f"out={out}"]) == 0
    return out


def test_a_recording_has_the_numbers_of_the_data_set(strided):
    recording, whole = th.Recording(strided / "run.mcap"), Synthetic(width=160, height=120)
    assert recording.frames == tuple(range(8, 40, 4)) == tuple(pose.index for pose in recording.values("pose"))
    image = recording.image(20)
    assert (image.index, image.stamp_ns, image.camera.fps) == (20, whole(20).stamp_ns, 7.5)
    assert np.array_equal(image.color, whole(20).color) and np.array_equal(image.depth_m, whole(20).depth_m)


@pytest.mark.parametrize("words", [(), ("only=[manhattan,rotation]",), ("dataset.frames=16:30", "only=[normals,keypoints,pose,map]")])
def test_a_replay_gives_the_same_bytes(strided, tmp_path, capsys, words):
    assert main(["run", f"replay={strided / 'run.mcap'}", *words, f"out={tmp_path / 'again'}"]) == 0
    assert main(["diff", str(strided / "run.mcap"), str(tmp_path / "again" / "run.mcap")]) == 0
    count, span = (4, "16..28") if len(words) == 2 else (8, "8..36")
    assert f"equal: {count} frames ({span}) of " in capsys.readouterr().out


def test_a_run_goes_on_after_the_last_frame_of_a_stride(tmp_path):
    """Frames 0, 4, 8, 12 with the map saved, then 16, 20, …: what one run gives."""

    def poses(name, *words):
        assert main(["run", *SMALL, *words, f"out={tmp_path / name}"]) == 0
        return {pose.index: pose.T_world_camera for pose in th.Recording(tmp_path / name / "run.mcap").values("pose")}

    saved = tmp_path / "map.mcap"
    whole, first = poses("whole", "dataset.frames=0:28:4"), poses("first", "dataset.frames=0:16:4", f"save_map={saved}")
    rest = poses("rest", "dataset.frames=16:28:4", f"load_map={saved}")
    assert list(first) == [0, 4, 8, 12] and list(rest) == [16, 20, 24]
    assert all(np.array_equal(whole[number], T) for number, T in {**first, **rest}.items())


def test_a_simulation_takes_every_third_frame():
    room = Synthetic(width=160, height=120, frames="1:12:3")
    sensor = SimulatedSensor(width=160, height=120, frames="1:12:3")
    for dataset, whole in ((room, Synthetic(width=160, height=120)), (sensor, SimulatedSensor(width=160, height=120))):
        assert [dataset(k).index for k in range(len(dataset))] == [1, 4, 7, 10]
        assert np.array_equal(dataset(2).color, whole(7).color) and dataset(2).stamp_ns == whole(7).stamp_ns
