"""The Python API in several threads: one `Slam` refuses a second thread at once, several are independent, whatever was imported first."""

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.config import compose_run

ROOM = Synthetic(length=6, width=160, height=120)
REFUSAL = "Slam: another thread is using it; make one Slam for each thread, or hold a lock of your own around all calls"


def track(slam, numbers=range(6)):
    return [slam.track(ROOM(k).color, ROOM(k).depth_m, ROOM(k).stamp_ns / 1e9) for k in numbers]


@pytest.fixture(scope="module")
def slam():
    with th.Slam(ROOM(0).camera, threads=1) as made:
        yield made


@pytest.mark.parametrize(
    "call",
    [
        lambda slam, file: track(slam, [1]),
        lambda slam, file: slam.save(file),
        lambda slam, file: slam.values["planes"],
        lambda slam, file: dict(slam.values),
        lambda slam, file: slam.map,
        lambda slam, file: slam.trajectory,
        lambda slam, file: slam.save_map(file),
    ],
    ids=["track", "save", "values", "all values", "map", "trajectory", "save_map"],
)
def test_a_second_thread_is_refused_at_once(slam, tmp_path, monkeypatch, call):
    """While the first one is within `track`: here it waits for the frame that it pushed."""
    within, go = threading.Event(), threading.Event()

    def frame(*arguments):
        within.set()
        go.wait()
        raise th.TrihedronError("here", "the frame ends")

    with monkeypatch.context() as patch, ThreadPoolExecutor(1) as pool:
        patch.setattr(slam, "_frames", frame)
        first = pool.submit(slam.track, ROOM(0).color, ROOM(0).depth_m, 1.0)
        within.wait()
        try:
            with pytest.raises(th.TrihedronError) as error:
                call(slam, tmp_path / "run.mcap")
            assert str(error.value) == REFUSAL
        finally:
            go.set()
        assert str(first.exception()) == "here: the frame ends"


def test_threads_take_turns_with_a_lock_of_ones_own():
    lock = threading.Lock()
    with th.Slam(ROOM(0).camera, threads=1, outputs=["planes"]) as slam, ThreadPoolExecutor(3) as pool:

        def push(number):
            with lock:
                return slam.track(*(ROOM(0).color, ROOM(0).depth_m), 1.0 + slam._last).index

        assert sorted(pool.map(push, range(6))) == list(range(6))


def test_a_slam_in_each_of_several_threads_at_once():
    """Built, used and closed side by side, they give what one alone gives."""
    begin = threading.Barrier(3)

    def poses(_):
        begin.wait()
        with th.Slam(ROOM(0).camera, threads=1) as slam:
            return np.stack([pose.T_world_camera for pose in track(slam)])

    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(poses, range(3)))
    with th.Slam(ROOM(0).camera, threads=1) as slam:
        alone = np.stack([pose.T_world_camera for pose in track(slam)])
    for found in together:
        np.testing.assert_array_equal(found, alone)


def test_configurations_are_composed_in_several_threads_at_once():
    with ThreadPoolExecutor(8) as pool:
        seeds = [config.seed for config in pool.map(lambda seed: compose_run([f"seed={seed}"]), range(16))]
    assert seeds == list(range(16))


def test_a_program_may_use_hydra_itself():
    """As `@hydra.main` does: its own configuration stays as it is."""
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        before = GlobalHydra.instance().hydra
        assert compose_run(["threads=1"]).threads == 1
        assert GlobalHydra.instance().hydra is before is not None
    assert not GlobalHydra.instance().is_initialized()


def test_several_are_closed_in_any_order_and_twice(tmp_path):
    slams = [th.Slam(ROOM(0).camera, threads=1, outputs=["planes"]) for _ in range(3)]
    for k in (1, 0, 2, 0, 1):
        slams[k].close()
    with pytest.raises(th.TrihedronError, match=r"Slam\.save: no frame was tracked, so there is nothing to save; call track first"):
        slams[0].save(tmp_path / "none.mcap")
    with pytest.raises(th.TrihedronError, match="Slam: is closed, and tracks no more frames; make another"):
        slams[2].track(ROOM(0).color, ROOM(0).depth_m, 1.0)


def test_a_frame_without_colour_or_depth_is_one_with_that_image_missing():
    """As frame validation replaces a faulty image: black, or without readings. Neither ends tracking."""
    black, no_depth = np.zeros_like(ROOM(3).color), np.zeros_like(ROOM(4).depth_m)
    poses = []
    for images in ([(None, ROOM(3).depth_m), (ROOM(4).color, None)], [(black, ROOM(3).depth_m), (ROOM(4).color, no_depth)]):
        with th.Slam(ROOM(0).camera, threads=1) as slam:
            track(slam, range(3))
            poses.append([slam.track(*pair, ROOM(3 + k).stamp_ns / 1e9) for k, pair in enumerate(images)])
    for given, missing in zip(*poses):
        assert given.status == missing.status != "lost"
        np.testing.assert_array_equal(given.T_world_camera, missing.T_world_camera)


PROGRAM = """
import hashlib
{first}
{second}
from threadpoolctl import threadpool_info
threads = {{pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}}  # of the libraries loaded so far
a = numpy.random.default_rng(0).normal(size=(300, 300))
a @ a
room = th.dataset.synthetic(length=4, width=160, height=120)
with th.Slam(room(0).camera, threads=1) as slam:
    for k in range(4):
        pose = slam.track(room(k).color, room(k).depth_m, room(k).stamp_ns / 1e9)
    arrays = [pose.T_world_camera, pose.covariance, slam.values["planes"].coefficients, slam.map.points.column("position_m")]
after = {{pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}}
print(hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest(), bool(threads), threads.items() <= after.items())
"""


def test_numpy_and_trihedron_are_imported_in_any_order():
    """The same results, and NumPy's BLAS has as many threads as before once the run is over."""
    imports = "import numpy; numpy.ones((200, 200)) @ numpy.ones((200, 200))", "import trihedron as th; th.Slam"
    programs = [PROGRAM.format(first=imports[i], second=imports[1 - i]) for i in (0, 1)]
    printed = [subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split() for program in programs]
    assert printed[0] == printed[1] and printed[0][1:] == ["True", "True"]
