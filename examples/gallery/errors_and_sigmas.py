"""Errors beside the standard deviations that were stated

Every pose has a covariance. Here each coordinate's error over time stands beside three times its stated standard deviation.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw errors within their bounds, and print the share that is inside."""
    words = {"dataset": {"width": 320, "height": 240, "length": 60}}
    with tempfile.TemporaryDirectory() as folder:
        poses = th.run(out=folder, quiet=True, **words).recording.poses
    truth = th.dataset.synthetic(**words["dataset"]).truth().poses
    first = np.linalg.inv(truth[0])
    errors, sigmas = [], []
    for pose in poses:
        R_world_camera = pose.T_world_camera[:3, :3]
        errors.append(1e3 * (pose.T_world_camera[:3, 3] - (first @ truth[pose.index])[:3, 3]))
        sigmas.append(1e3 * np.sqrt(np.diag(R_world_camera @ pose.covariance[:3, :3] @ R_world_camera.T)))
    error_mm, sigma_mm = np.array(errors), np.array(sigmas)

    figure = Figure(figsize=(9, 2.6), layout="constrained")
    for axis, axes in enumerate(figure.subplots(1, 3, sharey=True)):
        axes.fill_between(range(len(poses)), -3 * sigma_mm[:, axis], 3 * sigma_mm[:, axis], color="0.85", label="± 3 σ")
        axes.plot(error_mm[:, axis], color="crimson", label="error")
        axes.set(title="xyz"[axis], xlabel="frame")
    figure.axes[0].set_ylabel("mm")
    figure.axes[0].legend(fontsize=8)
    figure.savefig(out, dpi=90)
    print(f"{100 * np.mean(np.abs(error_mm[1:]) < 3 * sigma_mm[1:]):.0f} % of the errors are within 3 σ")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "errors.jpg"))
