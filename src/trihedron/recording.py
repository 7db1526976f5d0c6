"""Recordings: read every topic, and run stages again."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.buildings import Building
from trihedron.pipeline.app.recorded_values import frames_of, last_map, open_recording, poses_of, references_of, trajectory_of
from trihedron.pipeline.core.errors import RecordingError, UsageError, did_you_mean
from trihedron.pipeline.core.types import Frame, Map, Pose, Surface, Value
from trihedron.pipeline.record import reader
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.mcap_file import recording_file
from trihedron.recorded_building import building_of
from trihedron.trajectory import Trajectory
from trihedron.words import words_of

if TYPE_CHECKING:
    from trihedron.ablations import Ablation


class Recording:
    """A recording (run.mcap), or the folder of a run that has one; what it holds so far, where it is still being written.

    Args:
        path: the file or the folder; ~ is the home folder.

    Raises:
        RecordingError: it cannot be read, or is no recording of this version.

    Examples:
        >>> import trihedron as th
        >>> run = th.run("dataset.length=6", "dataset.width=160", "dataset.height=120", "record.frames=true", out="runs/room", quiet=True)
        >>> recording = th.Recording("runs/room")
        >>> recording.frames
        (0, 1, 2, 3, 4, 5)
        >>> [pose.status for pose in recording.poses] == ["ok"] * 6
        True
        >>> recording.image(2).color.shape
        (120, 160, 3)
        >>> len(recording.trajectory)
        6
    """

    def __init__(self, path: str | Path) -> None:
        self.path = recording_file(Path(path).expanduser())
        self._file: reader.Recording = open_recording(self.path)
        self._temporary: tempfile.TemporaryDirectory[str] | None = None  # of a replay: it lives as long as this object

    @property
    def topics(self) -> tuple[str, ...]:
        """The names of the topics."""
        return tuple(sorted(self._file.topics))

    @property
    def metadata(self) -> dict[str, str]:
        """Version, commit, overrides and configuration of the run."""
        return dict(self._file.metadata)

    def values(self, topic: str) -> Iterator[Any]:
        """Read the values of a topic in frame order.

        Args:
            topic: one of `topics`, as "planes"; its page in the documentation describes the values.

        Returns:
            An iterator over the values, each read from the file when it is asked for.

        Raises:
            RecordingError: the topic is not recorded, or, while it is read, a value is damaged.

        Examples:
            >>> import trihedron as th
            >>> run = th.run("dataset.length=3", "dataset.width=160", "dataset.height=120", "outputs=[planes]", out="runs/planes", quiet=True)
            >>> [planes.index for planes in th.Recording("runs/planes").values("planes")]
            [0, 1, 2]
        """
        if topic not in self._file.topics:
            raise RecordingError(str(self.path), f"has no topic '{topic}'", did_you_mean(topic, self._file.topics))
        return self._file.values(topic)

    def frame(self, index: int) -> dict[str, Value]:
        """Read the values of every topic at one frame.

        Args:
            index: the number of the frame in the data set, one of `frames`.

        Returns:
            Topic to value, without the topics that have none at this frame; empty where there is no frame of this number.

        Raises:
            RecordingError: a value is damaged.
        """
        return self._file.frame(index)

    def image(self, index: int) -> Frame:
        """Read the images of a frame: those embedded, else those of the data set that was tracked.

        Args:
            index: the number of the frame in the data set, one of `frames`.

        Returns:
            Colour (h, w, 3), RGB, and depth (h, w), m, 0 = none, registered and undistorted.

        Raises:
            RecordingError: there is no frame of this number, or it has no images.
            DataError: images are not embedded, and the data set is gone.
        """
        if index not in self._references:
            numbers = list(self._references)
            held = f"its frames are {numbers[0]} to {numbers[-1]}" if numbers else "it has none"
            raise RecordingError(str(self.path), f"has no frame {index}", held)
        frame = frames_of(self._file)(self._references[index])
        if frame is None:
            raise RecordingError(str(self.path), f"has no images of frame {index}", "record with record.frames=true")
        return frame

    @property
    def frames(self) -> tuple[int, ...]:
        """The numbers of the frames."""
        return tuple(self._references)

    @cached_property
    def _references(self) -> dict[int, Any]:
        return references_of(self._file) if FRAMES_TOPIC in self._file.topics else {}

    @property
    def poses(self) -> list[Pose]:
        """The poses as they were estimated at the time.

        Raises:
            DataError: none were recorded.
        """
        return poses_of(self._file)

    @property
    def trajectory(self) -> Trajectory:
        """The poses of all tracked frames, relative to the keyframes of the last map.

        Raises:
            DataError: no poses were recorded.
        """
        return Trajectory.of(trajectory_of(self._file))

    @property
    def map(self) -> Map | None:
        """The last map, or None."""
        return last_map(self._file)

    def mesh(self) -> Surface:
        """Read the surface, in the world frame.

        Raises:
            RecordingError: none was recorded; it is with `outputs=[surface]`.
        """
        surface: Any = next(self.values("surface"), None)
        if not isinstance(surface, Surface):
            raise RecordingError(str(self.path), "holds no surface", "record a run with 'outputs=[surface]'")
        return surface

    @cached_property
    def building(self) -> Building:
        """The plan of the building: as recorded (outputs=[building]), else made of the frames, planes and poses by `manhattan_layout`, which takes
        time.

        Raises:
            DataError: planes or poses are not recorded, or the images are gone.
        """
        return Building(building_of(self._file))

    def replay(self, *overrides: str, only: list[str] | tuple[str, ...] = (), out: str | Path | None = None, **options: Any) -> Recording:
        """Run stages again, and return the recording of what they gave.

        Args:
            overrides: words of the command line.
            only: the stages; () = all. The rest is read from this recording.
            out: the folder of the results; without it they last as long as the returned object.
            options: as of `Slam`, for example `manhattan="branch_and_bound"`.

        Returns:
            The recording of the stages that ran again.

        Raises:
            UsageError: `only` is a text, or a word is no override.
            ConfigError: a stage, plugin or option is unknown, or an option out of range.
            RecordingError: a stage needs images that the recording does not embed and that are gone.
            StageError: a stage failed.

        Examples:
            >>> import trihedron as th
            >>> run = th.run("dataset.length=6", "dataset.width=160", "dataset.height=120", out="runs/first", quiet=True)
            >>> again = run.recording.replay(only=["manhattan"], manhattan="branch_and_bound")
            >>> again.topics
            ('frames', 'manhattan')
            >>> all(frame.gap >= 0 for frame in again.values("manhattan"))  # the certificate that `mean_shift` does not give
            True
        """
        from trihedron.runs import run

        if isinstance(only, str):
            raise UsageError("only", f"is the text '{only}'", f'give a list, only=["{only}"]')
        temporary = tempfile.TemporaryDirectory(prefix="trihedron-") if out is None else None
        folder = Path(temporary.name) if temporary is not None else Path(str(out)).expanduser()
        words = words_of(overrides, options)
        made = run(f"replay={self.path}", *([f"only=[{','.join(only)}]"] if only else []), *words, out=folder, quiet=out is None)
        made.recording._temporary = temporary
        return made.recording

    def ablate(self, *swaps: str, out: str | Path, feedback: str = "new", budget: bool = False, **options: Any) -> Ablation:
        """Swap stages and compute again only what follows from them, as `trihedron.ablate` does for several recordings.

        Args:
            swaps: words `STAGE=PLUGIN,PLUGIN` or `STAGE.OPTION=VALUE,VALUE`.
            out: the folder of the alternatives.
            feedback: "new" computes all that follows, "recorded" the swapped stages alone.
            budget: the error budget too.
            options: swaps by name; two underscores stand for a dot, as `planes__angle_deg=3`.

        Returns:
            Verdicts, tables and run folders of all alternatives, with the recorded configuration, computed anew, as the first.

        Raises:
            UsageError: nothing is swapped, or `feedback` is none of the two.
            ConfigError: a plugin or option of a swap is unknown, or out of range.

        Examples:
            >>> import trihedron as th
            >>> run = th.run("dataset.length=3", "dataset.width=160", "dataset.height=120", "outputs=[planes]", out="runs/original", quiet=True)
            >>> ablation = run.recording.ablate("planes.angle_deg=5,8", out="runs/angles")
            >>> list(ablation.folders)
            ['as recorded', 'planes.angle_deg=5', 'planes.angle_deg=8']
        """
        from trihedron.ablations import ablate

        return ablate(self.path, *swaps, out=out, feedback=feedback, budget=budget, **options)

    def __repr__(self) -> str:
        return f"Recording({self.path}; {len(self._references)} frames; {len(self.topics)} topics)"
