"""A run with `calibrate=true`: the sequence is tracked once with the stated camera, calibrated from that, and tracked again.

A map that was begun with a wrong calibration cannot be moved to another, so the run proper begins anew. The estimate is that of the command
`trihedron calibrate`, which is found by its entry point.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.core.errors import ConfigError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.overrides import literal_text, quote
from trihedron.pipeline.core.registry import load_plugins, options_of, plugins_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.run.run_folder import CONFIG, CURE

UNCALIBRATED, CAMERA = "uncalibrated", "camera.yaml"  # in the run folder: what is tracked with the stated camera, and what is recommended
NEEDED = ("keypoints", "matches", "map")  # stages
FIRST = {  # root keys of the first pass
    "calibrate": False,
    "outputs": ["trajectory", "keypoints", "matches"],  # what calibration needs besides the frames
    "record": {"topics": [], "frames": False},
    "save_map": "",
    "view": None,
}
REFUSED = {  # keys of a run whose sequence cannot be tracked twice from the beginning: cause, cure
    "live": ("the sequence is tracked twice, and a live one comes once", "leave one of the two out"),
    "real_time": ("the sequence is tracked twice, and one in real time comes once", "leave one of the two out"),
    "replay": ("a replay has the camera of its run", "run the data set itself with calibrate=true"),
    "load_map": ("the loaded map was made with the stated camera", "make the map with calibrate=true, and load it with its camera.yaml"),
}


@dataclass(frozen=True)
class Recommendation:
    """The changes that a recording recommends: the text of the new camera file, empty where the one in use stays, and a line for each change."""

    camera: str
    changes: Sequence[str]


def check_calibrated(config: DictConfig) -> None:
    """Raise ConfigError for a run that cannot be calibrated."""
    for key, (cause, cure) in REFUSED.items():
        if config[key]:
            raise ConfigError("calibrate", f"{cause} ({key})", cure)
    name = str(config.dataset.plugin)
    if "camera" not in config.dataset:
        load_plugins()
        taking = sorted(other for other, plugin in plugins_of("dataset").items() if "camera" in {option.name for option in options_of(plugin)})
        raise ConfigError("calibrate", f"dataset={name} takes no camera file", f"leave it out; those that do: {', '.join(taking)}")
    if missing := next((slot for slot in NEEDED if config.get(slot) is None or config[slot].plugin == "none"), None):
        raise ConfigError("calibrate", f"needs matched key points, and this run has no stage {missing}", "leave it out, or choose graph=structural")


def check_camera_file(config: DictConfig, out: Path) -> None:
    """Raise ConfigError where the camera file of a run would replace one that the run reads, or that a user wrote."""
    file = out / CAMERA
    for key in ("path", "camera"):
        given = Path(str(config.dataset[key])).expanduser().resolve()
        if config.dataset[key] and file.resolve() in (given, given / CAMERA):
            raise ConfigError("out", f"{file} would be replaced, which dataset.{key} reads", CURE)
    if file.exists() and not (out / UNCALIBRATED / CONFIG).is_dir():
        raise ConfigError("out", f"{file} would be replaced, which no run with calibrate=true wrote", CURE)


def uncalibrated(config: DictConfig, folder: Path, words: Sequence[str]) -> tuple[DictConfig, Path, list[str]]:
    """Return the configuration, folder and words of the first pass: only what calibration needs."""
    config = config.copy()
    for key, value in {**FIRST, "out": literal_text(str(folder))}.items():
        OmegaConf.update(config, key, value)
    return config, folder, [word for word in words if word.lstrip("+~").partition("=")[0].partition(".")[0] not in FIRST]


def calibrated_config(config: DictConfig, out: Path) -> DictConfig:
    """Calibrate from the first pass in `out`, and write the camera file that is recommended. Returns the configuration with what is recommended, the
    one given where nothing is. Raises DataError for a recording that does not suffice."""
    found, file = recommendation(out / UNCALIBRATED), out / CAMERA
    file.unlink(missing_ok=True)
    for change in found.changes:
        print(f"calibrate: {change}")
    if not found.camera:
        print("calibrate: no change recommended, the run has the stated camera")
        return config
    write_file(file, found.camera)
    print(f"calibrate: the run has dataset.camera={file}")
    config = config.copy()
    config.dataset.camera = literal_text(str(file))
    return config


def recommended_words(config: DictConfig) -> list[str]:
    """Return the words by which a run has what an earlier one with calibrate=true was recommended, by the configuration of that."""
    return [f"dataset.camera={quote(str(config.dataset.camera))}"] if config.dataset.get("camera") else []


def recommendation(folder: Path) -> Recommendation:
    """Return what `trihedron calibrate` recommends by the recording in a folder."""
    command = next(iter(entry_points(group="trihedron.commands", name="calibrate")))
    found: Recommendation = import_module(command.module).recommend(Recording(folder))
    return found


def comparison_line(before: Mapping[str, Any], after: Mapping[str, Any], out: Path) -> str:
    """Compare the metrics of the two passes in a line."""
    folder = shlex.quote(str(out / UNCALIBRATED))
    return f"calibrate: {_summary(after)}; with the stated camera {_summary(before)} (trihedron compare {folder} {shlex.quote(str(out))})"


def _summary(metrics: Mapping[str, Any]) -> str:
    ate = f", ATE {metrics['final']['ate_rmse_m']:.4f} m" if "final" in metrics else ""
    if "status" not in metrics:  # a run whose outputs need no pose
        return "no poses"
    return f"{metrics['status']['ok']} of {metrics['frames']} frames ok{ate}"
