"""Scenes that cannot tell every direction, by the whole default graph: what is seen is measured, what is not is held, and the status says so."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.record.reader import Recording

GRAPHS = Path(__file__).parent.parent / "conf" / "graph"
FRAMES, WIDTH, HEIGHT, FOCAL = 16, 320, 240, 260.0


def write_folder(folder, depth_of, places):
    """Plain grey images with the depth that `depth_of` (rays (h, w, 3), place) gives."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    x, y = np.meshgrid((np.arange(WIDTH) - WIDTH / 2) / FOCAL, (np.arange(HEIGHT) - HEIGHT / 2) / FOCAL)
    rays, rng = np.stack([x, y, np.ones_like(x)], axis=-1), np.random.default_rng(3)
    for k, place in enumerate(places):
        z = depth_of(rays, place)
        z = z + rng.normal(0.0, 1.0, z.shape) * np.maximum(0.001, 0.0027 * z * z)
        cv2.imwrite(str(folder / "rgb" / f"{k:04d}.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{k:04d}.png"), np.rint(5000.0 * z).astype(np.uint16))
    (folder / "camera.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfx: {FOCAL}\nfy: {FOCAL}\ncx: {WIDTH / 2}\ncy: {HEIGHT / 2}\ndepth_scale: 5000\n"
    )


def single_wall(rays, place):
    """A wall 2 m ahead of the start, across the line of sight."""
    return np.full(rays.shape[:2], 2.0) - place[2]


def corridor(rays, place):
    """Two walls 2 m apart, floor and ceiling 2.4 m apart, and no end."""
    with np.errstate(divide="ignore"):
        sides = np.where(rays[..., 0] > 0, 1.0 - place[0], -1.0 - place[0]) / rays[..., 0]
        floors = np.where(rays[..., 1] > 0, 1.2 - place[1], -1.2 - place[1]) / rays[..., 1]
    z = np.minimum(np.abs(sides), np.abs(floors))
    return np.where(z < 6.0, z, 0.0)


SCENES = {  # depth, what the camera does each frame, which coordinates are seen, which are not, and what is said: half a pose is no pose
    "single wall": (single_wall, np.array([0.004, 0.0, 0.006]), [2], [0, 1], "lost"),
    "bare corridor": (corridor, np.array([0.006, -0.004, 0.0]), [0, 1], [2], "degraded"),
}


REASONS = {
    "1 directions of motion are unobservable, held at the prediction",
    "the rotation was not measured, and only 1 of 1 matches with the map agree",
    "relocalisation failed since the pose was lost",
}


@pytest.mark.parametrize("name", SCENES)
def test_what_is_seen_is_measured_and_the_rest_is_held(tmp_path, name):
    depth_of, step, seen, unseen, status = SCENES[name]
    places = [k * step for k in range(FRAMES)]
    write_folder(tmp_path / "scene", depth_of, places)
    assert main(["run", "dataset=folder", f"dataset.path={tmp_path / 'scene'}", f"out={tmp_path / 'out'}"]) == 0
    poses = list(Recording(tmp_path / "out" / "run.mcap").values("pose"))
    assert len(poses) == FRAMES
    for pose, place in zip(poses, places):
        moved = pose.T_world_camera[:3, 3] - poses[0].T_world_camera[:3, 3]
        assert np.isfinite(pose.T_world_camera).all() and np.abs(moved[seen] - place[seen]).max() < 0.01, (pose.index, moved, place)
        assert np.abs(moved[unseen]).max() < 0.01  # nothing says that it moved there
    later = [pose for pose in poses[2:] if not pose.reason.startswith("first frame of sub-map")]
    assert len(later) >= FRAMES - 4 and all(pose.status != "ok" for pose in poses[2:])
    assert all(pose.status == status and pose.unobservable >= len(unseen) for pose in later)
    assert {pose.reason for pose in later} <= REASONS
    begun = next((pose.index for pose in poses[1:] if pose.reason.startswith("first frame of sub-map")), FRAMES)  # its covariance begins anew
    sigmas = np.sqrt([np.diag(pose.covariance)[:3] for pose in (poses[1], poses[begun - 1])])
    assert (sigmas[1][unseen] > 1.5 * sigmas[0][unseen]).all() and sigmas[1][seen].max() < 0.02  # and it is known to be unknown


QUICK = ("structural", "points", "direct", "plane_odometry")  # one of each kind: all features, points alone, images, no map


@pytest.mark.parametrize(
    "graph", [pytest.param(path.stem, marks=() if path.stem in QUICK else pytest.mark.slow) for path in sorted(GRAPHS.glob("*.yaml"))]
)
def test_no_system_is_sure_of_itself_in_front_of_one_bare_wall(tmp_path, graph):
    """Points on a textureless wall, and whatever else must fail there: it is said."""
    depth_of, step, *_ = SCENES["single wall"]
    write_folder(tmp_path / "scene", depth_of, [k * step for k in range(6)])
    assert main(["run", f"graph={graph}", "dataset=folder", f"dataset.path={tmp_path / 'scene'}", f"out={tmp_path / 'out'}", "record.topics=[]"]) == 0
    poses = list(Recording(tmp_path / "out" / "run.mcap").values("pose"))
    assert len(poses) == 6 and poses[0].status == "ok"
    assert all(pose.status in ("degraded", "lost") and pose.unobservable and pose.reason for pose in poses[1:]), [pose.status for pose in poses]
