"""The folder of a run: made, held for this process before anything is written into it, and emptied again where no frame came.

A run replaces what an earlier one left in its folder. It is refused where that is what it reads, or what a user wrote by hand."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree

import yaml
from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.core.errors import ConfigError, DataError
from trihedron.pipeline.core.files import make_folder, write_file
from trihedron.pipeline.core.registry import files_of_folds
from trihedron.pipeline.record.mcap_file import RECORDING, recording_file
from trihedron.pipeline.run.results import OF_POSES, TIMING

CONFIG = ".hydra"  # folder of the composed configuration and the words it was composed of
CURE = "give another out=FOLDER"
OWN_FILES = {*OF_POSES, TIMING, RECORDING}  # of a run itself


@dataclass(frozen=True)
class FolderBefore:
    """A run folder before the run writes: `missing` are it and those above it that do not exist, from the inside out, `present` is what it holds."""

    folder: Path
    missing: tuple[Path, ...]
    present: frozenset[Path]
    recording: Path
    older: tuple[int, int] | None  # which file is there in its place

    @classmethod
    def of(cls, recording: Path) -> FolderBefore:
        """Look at the folder of a recording, neither of which need exist."""
        folder = recording.parent
        missing = tuple(path for path in (folder, *folder.parents) if not path.exists())
        return cls(folder, missing, frozenset(folder.iterdir() if folder.is_dir() else ()), recording, _identity(recording))

    def restore(self) -> None:
        """Remove the folder where it was made, else the files and the configuration that were added: other folders may be another run's."""
        if self.missing:
            rmtree(self.folder, ignore_errors=True)
            with suppress(OSError):  # another run is in it
                for path in self.missing[1:]:
                    path.rmdir()
            return
        added = {path for path in self.folder.iterdir() if path.is_file() and not path.is_symlink()} - self.present
        for path in added | ({self.recording} if _identity(self.recording) != self.older else set()):
            with suppress(OSError):
                path.unlink(missing_ok=True)
        if self.folder / CONFIG not in self.present:
            rmtree(self.folder / CONFIG, ignore_errors=True)


def _identity(path: Path) -> tuple[int, int] | None:
    with suppress(OSError):
        return (found := path.stat()).st_ino, found.st_ctime_ns
    return None


@contextmanager
def claim_folder(folder: Path, config: DictConfig, computed: Collection[str]) -> Iterator[bool]:
    """Make the folder of a run of this configuration, which computes these stages, and lock it for the block, as `lock_folder` does; True where it is
    that of an earlier run. Raises TrihedronError, before anything is written, as `check_replaced` does."""
    check_replaced(folder, config, computed)
    earlier = (folder / CONFIG).is_dir()
    with lock_folder(folder):
        yield earlier


def check_replaced(folder: Path, config: DictConfig, computed: Collection[str]) -> None:
    """Raise TrihedronError where a run would replace results that it reads, or that a user corrected by hand."""
    _check_sources(folder / RECORDING, config)
    for slot, files in files_of_folds().items() if _other_files(folder) else ():
        if files.check is not None:
            files.check(folder, config.get(slot) if slot in computed else None)


def _check_sources(recording: Path, config: DictConfig) -> None:
    """Raise ConfigError where the run reads the recording in whose place it would write."""
    for key in ("replay", "dataset.path", "dataset.options.path"):
        if isinstance(given := OmegaConf.select(config, key), str) and given and recording.exists():
            path = Path(given).expanduser()
            source = path if key != "replay" and OmegaConf.select(config, "dataset.plugin") != "mcap" else recording_file(path)
            if source.exists() and source.samefile(recording):
                raise ConfigError("out", f"{recording} would be replaced, which {key} reads", CURE)


def _other_files(folder: Path) -> set[str]:
    """Return the names of the files in a folder, which need not exist, beside those of every run. Only for these an owner is asked, which takes an
    import of all plugins."""
    return {path.name for path in (folder.iterdir() if folder.is_dir() else ()) if path.is_file()} - OWN_FILES


def remove_models(folder: Path) -> set[str]:
    """Remove the files of models that an earlier run, or a command on it, left in a folder, and return their names: beside the recording of another
    run they would be taken for its own."""
    others = _other_files(folder)
    models = {name for files in files_of_folds().values() for name in files.names} & others if others else set()
    for name in models:
        (folder / name).unlink()
    return models


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Make the folder and lock it for the block (`flock`, which ends with the process); a file system without locks gives none.

    Raises ConfigError or DataError, and has written nothing then."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError("out", f"the folder cannot be made: {error.strerror}: {error.filename}", CURE) from error
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DataError(str(folder), "is being written by another process", f"wait until that has ended, or {CURE}") from error
    except OSError:
        return


def write_configuration(folder: Path, config: DictConfig, words: Sequence[str]) -> None:
    """Write the composed configuration and the words of the command. Raises ConfigError."""
    try:
        make_folder(folder / CONFIG)
        write_file(folder / CONFIG / "config.yaml", OmegaConf.to_yaml(config))
        write_file(folder / CONFIG / "overrides.yaml", yaml.safe_dump(list(words), allow_unicode=True))
    except OSError as error:
        raise ConfigError("out", f"the folder cannot be written: {error.strerror}: {error.filename}", CURE) from error


def point_latest(out: Path) -> None:
    """Point `runs/latest` beside dated run folders at the newest."""
    runs = next((parent for parent in out.parents if parent.name == "runs"), None)
    if runs is not None:
        link = runs / "latest"
        if link.is_symlink() or not link.exists():
            link.unlink(missing_ok=True)
            with suppress(FileExistsError):  # another job of a sweep was quicker
                link.symlink_to(out.relative_to(runs), target_is_directory=True)
