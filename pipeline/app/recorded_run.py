"""The configuration of the run that made a recording: the one way in which anything of it becomes configuration again."""

from __future__ import annotations

from collections.abc import Iterable

from omegaconf import DictConfig

from trihedron.pipeline.core.config import RecordedConfig, compose_run
from trihedron.pipeline.core.recorded_config import recorded_config
from trihedron.pipeline.record.reader import Recording


def recorded_config_of(recording: Recording) -> RecordedConfig:
    """The recording's composed configuration as checked data. Raises RecordingError for anything but known options with values of their types."""
    return recorded_config(recording.metadata.get("config", ""), str(recording.path))


def composed_run(recording: Recording, overrides: Iterable[str] = ()) -> DictConfig:
    """Compose the recorded run with the user's own overrides on top. Raises TrihedronError, one line."""
    return compose_run(overrides, recorded_config_of(recording))
