"""A library that is missing is named in one line, with the command that installs it."""

import subprocess
import sys

import numpy as np
import pytest

from trihedron.comparison.mesh_files import read_mesh
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import LibraryError
from trihedron.pipeline.core.libraries import distribution_of, imports_of, library_error
from trihedron.pipeline.core.types import Camera
from trihedron.plugins.shared import libraries
from trihedron.plugins.shared.pycolmap_pose import absolute_pose

OPEN3D = distribution_of("open3d")  # of the system
TINY = ["dataset=synthetic", "dataset.width=64", "dataset.height=48", "dataset.length=3"]
SWEEP = ["-m", *TINY, "outputs=[keypoints]", "keypoints=opencv_orb", "seed=0,1"]
COMMANDS = {  # module -> words of `trihedron run` that need it, its distribution, what pip is to install
    "distributed": ([*SWEEP, "hydra/launcher=dask", "hydra.launcher.address=tcp://127.0.0.1:9"], "distributed", "'trihedron[cluster]'"),
    "onnxruntime": ([*TINY, "keypoints=onnx", "keypoints.model=a.onnx", "outputs=[keypoints]"], "onnxruntime", "'trihedron[onnx]'"),
    "open3d": ([*TINY, "planes=open3d_ransac", "outputs=[planes]"], OPEN3D, OPEN3D),
    "optuna": (["-m", *TINY, "hydra/sweeper=optuna", "lines.tolerance_deg=interval(10,20)", "outputs=[lines]"], "optuna", "'trihedron[search]'"),
    "pyrealsense2": (["dataset=realsense", "outputs=[keypoints]"], "pyrealsense2", "'trihedron[realsense]'"),
    "rerun": ([*TINY, "view=rerun", "outputs=[keypoints]"], "rerun-sdk", "'trihedron[view]'"),
    "submitit": ([*SWEEP, "hydra/launcher=submitit_slurm"], "submitit", "'trihedron[cluster]'"),
}


def line(name, installed):
    return f"trihedron: {name}: is not installed; install it with: pip install {installed}"


@pytest.mark.parametrize("module", COMMANDS)
def test_a_run_names_the_library_it_lacks(module, tmp_path, capfd, monkeypatch):
    words, name, installed = COMMANDS[module]
    libraries._open3d.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["run", *words, f"out={tmp_path}"]) == 1
    printed = capfd.readouterr().err.splitlines()
    assert [text for text in printed if "compiling" not in text] == [line(name, installed)]


def test_slurm_without_its_launcher(tmp_path):
    """In a process of its own: Hydra looks for launchers once."""
    program = "import sys; sys.modules['hydra_plugins.hydra_submitit_launcher'] = None; from trihedron.pipeline.app.cli import main; "
    words = ["run", *SWEEP, "hydra/launcher=submitit_slurm", f"out={tmp_path}"]
    done = subprocess.run([sys.executable, "-c", f"{program}sys.exit(main({words}))"], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.splitlines() == [line("hydra-submitit-launcher", "'trihedron[cluster]'")]


def test_pycolmap(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(LibraryError, match=r"^pycolmap: is not installed; install it with: pip install pycolmap$"):
        absolute_pose(np.ones((8, 3)), np.ones((8, 2)), Camera(64, 48, 50.0, 50.0, 31.5, 23.5), 4.0, seed=0)


def test_a_mesh_is_not_called_damaged(tmp_path, monkeypatch):
    (tmp_path / "a.ply").write_bytes(b"ply")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(LibraryError, match=r"^trimesh: is not installed; install it with: pip install trimesh$"):
        read_mesh(tmp_path / "a.ply")


def test_any_other_library_that_a_command_imports(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    assert main(["download", "tum/fr3_structure_notexture_far", "--to", str(tmp_path)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == line("pooch", "pooch")


def test_a_library_that_is_there_and_does_not_load():
    with pytest.raises(LibraryError) as error, imports_of("optuna"):
        raise ModuleNotFoundError("No module named 'alembic'", name="alembic")
    assert str(error.value) == "optuna: does not load: No module named 'alembic'; install it with: pip install 'trihedron[search]'"
    missing = ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
    cure = "`python -m trihedron.tools.system_check` names the missing Debian packages"
    assert str(library_error("cv2", missing)) == f"opencv-contrib-python-headless: does not load: {missing}; {cure}"
