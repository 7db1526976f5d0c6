"""Draw the ten pictures of docs/explanation/manhattan-frames.md.

python examples/manhattan_in_ten_pictures.py            # into runs/manhattan
python examples/manhattan_in_ten_pictures.py FOLDER
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import trihedron as th

FRAME, COLORS = 20, ("tab:red", "tab:green", "tab:blue")


def main(folder: str = "runs/manhattan") -> None:
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    dataset = th.dataset.synthetic()
    frame = dataset(FRAME)
    normals, segments = th.normals.integral_image()(frame), th.segments.ransac()(frame, lines=th.lines.lsd()(frame))
    planes = th.planes.connected_components()(frame, normals)
    found = th.manhattan.mean_shift()(frame, normals=normals, segments=segments, planes=planes)
    axes = found.rotations[0]
    directions = normals.normals.reshape(-1, 3)
    directions = directions[np.isfinite(directions[:, 0])]

    show(out / "01.jpg", frame.color)
    show(out / "02.jpg", frame.depth_m, cmap="viridis")
    show(out / "03.jpg", np.nan_to_num(0.5 - 0.5 * normals.normals))
    sphere(out / "04.jpg", directions[::20], np.eye(3)[:, :0])
    cone(out / "05.jpg", directions, axes)
    sphere(out / "06.jpg", directions[::20], axes)
    lines(out / "07.jpg", frame, segments, axes)
    walls(out / "08.jpg", frame, planes, axes)
    labels = np.kron(planes.labels, np.ones((planes.stride, planes.stride), int))
    wall = replace(frame, depth_m=np.where(labels == 1 + int(planes.pixels.argmax()), frame.depth_m, np.float32(0)))  # nothing else is seen
    few = th.normals.integral_image()(wall)
    supported = th.manhattan.mean_shift(use_lines=False)(wall, normals=few).supported
    flat = few.normals.reshape(-1, 3)
    sphere(out / "09.jpg", flat[np.isfinite(flat[:, 0])][::20], np.eye(3)[:, :0])
    drift = drifts(out / "10.jpg")
    print(f"frame {FRAME}: {len(planes.pixels)} planes, {len(segments.endpoints_m)} segments; one wall alone is supported: {supported}")
    print(f"after 150 frames: {drift['procrustes']:.2f}° from tracks, {drift['drift_free']:.2f}° with the Manhattan frame")


def save(out: Path, figure: Figure) -> None:
    figure.savefig(out, dpi=80, pil_kwargs={"quality": 80})


def show(out: Path, image: Any, **options: Any) -> None:
    """One image without axes."""
    figure = Figure(figsize=(5, 3.75), layout="constrained")
    axes = figure.subplots()
    axes.imshow(image, **options)
    axes.set_axis_off()
    save(out, figure)


def sphere(out: Path, directions: Any, columns: Any) -> None:
    """Directions on the unit sphere, and axes through it."""
    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    axes.scatter(*directions.T, s=1, color="0.4")
    for axis, color in zip(columns.T, COLORS):
        axes.plot(*np.stack([-axis, axis]).T, color=color, linewidth=3)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xlabel="x", ylabel="y", zlabel="z")
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=-55, azim=-70)
    save(out, figure)


def cone(out: Path, directions: Any, R_camera_manhattan: Any) -> None:
    """The density of normals in the tangent plane of each axis; the circle is the cone that mean shift gathers."""
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    in_frame = directions @ R_camera_manhattan
    for k, axes in enumerate(figure.subplots(1, 3)):
        near = in_frame[np.abs(in_frame[:, k]) > np.cos(np.radians(20))]
        flat = np.degrees(np.delete(near, k, axis=1) * np.sign(near[:, k : k + 1]))
        axes.hist2d(flat[:, 0], flat[:, 1], bins=60, range=[[-20, 20]] * 2, cmap="magma_r")
        angle = np.linspace(0, 2 * np.pi, 100)
        axes.plot(12 * np.cos(angle), 12 * np.sin(angle), color=COLORS[k])
        axes.set(aspect="equal", title=f"axis {k + 1}: {len(near)} normals", xlabel="degrees")
    save(out, figure)


def lines(out: Path, frame: Any, segments: Any, R_camera_manhattan: Any) -> None:
    """Line segments in the colour of the axis that they are parallel to."""
    figure = Figure(figsize=(5, 3.75), layout="constrained")
    axes = figure.subplots()
    axes.imshow(frame.color, alpha=0.4)
    for ends, in_space in zip(segments.endpoints_px, segments.endpoints_m):
        way = in_space[1] - in_space[0]
        cosines = np.abs(way @ R_camera_manhattan) / np.linalg.norm(way)
        parallel = np.isfinite(cosines).all() and cosines.max() > np.cos(np.radians(5))
        axes.plot(*ends.T, color=COLORS[int(cosines.argmax())] if parallel else "0.6", linewidth=2)
    axes.set_axis_off()
    save(out, figure)


def walls(out: Path, frame: Any, planes: Any, R_camera_manhattan: Any) -> None:
    """Planes in the colour of the axis that is their normal."""
    cosines = np.abs(planes.coefficients[:, :3] @ R_camera_manhattan)
    of_axis = np.where(cosines.max(axis=1) > np.cos(np.radians(5)), cosines.argmax(axis=1) + 1, 0)
    palette = np.array([(150, 150, 150), (214, 39, 40), (44, 160, 44), (31, 119, 180)])
    labels = np.kron(planes.labels, np.ones((planes.stride, planes.stride), int))
    tinted = 0.4 * frame.color + 0.6 * palette[np.concatenate([[0], of_axis])[labels]]
    show(out, np.where(labels[..., None] > 0, tinted, frame.color).astype(np.uint8))


def drifts(out: Path) -> dict[str, float]:
    """The error of the rotation over time without and with the Manhattan frame, and at the end; degrees."""
    figure = Figure(figsize=(6, 2.8), layout="constrained")
    axes, last = figure.subplots(), {}
    truth = th.dataset.synthetic().truth().poses[:, :3, :3]
    for rotation in ("procrustes", "drift_free"):
        with tempfile.TemporaryDirectory() as folder:
            done = th.run("dataset.width=320", "dataset.height=240", graph="structural_no_refine", rotation=rotation, out=folder, quiet=True)
            found = [value.R_world_camera for value in done.recording.values("rotation")]
        apart = [np.trace(R @ (truth[0].T @ true).T) for R, true in zip(found, truth)]
        errors = np.degrees(np.arccos(np.clip((np.array(apart) - 1) / 2, -1, 1)))
        axes.plot(errors, label=f"rotation={rotation}")
        last[rotation] = float(errors[-1])
    axes.set(xlabel="frame", ylabel="error of the rotation, degrees", ylim=(0, None))
    axes.legend(fontsize=8)
    save(out, figure)
    return last


if __name__ == "__main__":
    main(*sys.argv[1:])
