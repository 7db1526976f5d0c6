"""Networks in ONNX files that the user gives: opened with fixed options, checked by SHA-256, and refused in one line where they do not fit.

Nothing is downloaded. ONNX Runtime (MIT) runs them on the processor with one thread, so that the bytes of one machine are always the same; those of
another processor may differ.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import ConfigError
from trihedron.pipeline.core.files import MAX_NETWORK_BYTES, read_file
from trihedron.pipeline.core.types import F32, F64, Frame
from trihedron.plugins.shared.libraries import onnxruntime

WHERE = "docs/reference/networks.md lists where networks are published"
MESSAGE = 256  # characters of a library's message that are shown
CENTRE, DESCRIPTOR_GAIN = 128.0, 256.0  # of the bytes that stand for the numbers of a unit vector
HISTOGRAM_BYTES = 128  # least length of descriptors that are compared by Euclidean distance


@dataclass(frozen=True)
class NetworkOptions:
    """Options of a plugin that runs a network."""

    slot: ClassVar[str]  # whose options these are, for messages

    model: str = ""  # the ONNX file
    sha256: str = ""  # that the file must have; a recording states that of its run

    @cached_property
    def network(self) -> Network:
        """The opened network. Raises ConfigError."""
        return Network.load(self.slot, self.model, self.sha256)


@dataclass(frozen=True)
class Network:
    """A network: its file and ONNX Runtime's session, which any number of threads may run."""

    slot: str
    path: str
    session: Any

    @staticmethod
    def load(slot: str, path: str, sha256: str) -> Network:
        """Open the file of the option `SLOT.model`. Raises ConfigError where it is not given, missing, another one, or no network, and LibraryError
        without ONNX Runtime."""
        place = f"{slot}.model"
        if not path:
            raise ConfigError(place, "no network is given", f"give {place}=FILE.onnx; {WHERE}")
        runtime = onnxruntime()
        try:
            content = read_file(Path(path).expanduser(), MAX_NETWORK_BYTES)
        except OSError as error:
            raise ConfigError(place, f"{path} cannot be read: {error.strerror}", f"give {place}=FILE.onnx; {WHERE}") from error
        found = hashlib.sha256(content).hexdigest()
        if sha256 and found != sha256:
            cause = f"{path} has the SHA-256 {found[:12]}…, and {sha256[:12]}… is required"
            raise ConfigError(place, cause, f"give the file of the recorded run, or {slot}.sha256= to take another")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = runtime.ExecutionMode.ORT_SEQUENTIAL
        options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.use_deterministic_compute = True
        options.log_severity_level = 4
        try:
            session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime has a class for each of its codes
            raise ConfigError(place, f"{path} is no network that ONNX Runtime can run: {_error_text(error)}", WHERE) from error
        return Network(slot, path, session)

    @cached_property
    def inputs(self) -> dict[str, tuple[list[Any], str]]:
        """Name -> shape, with numbers where a length is fixed, and type of each input."""
        return {one.name: (list(one.shape), str(one.type)) for one in self.session.get_inputs()}

    @cached_property
    def outputs(self) -> list[str]:
        """Names of the outputs."""
        return [one.name for one in self.session.get_outputs()]

    def run(self, given: Mapping[str, F32], wanted: tuple[str, ...]) -> list[NDArray[Any]]:
        """Return the outputs of these names for the inputs of those. Raises ConfigError where the network has others, or cannot take the inputs."""
        for name in given:
            self._check_input(name, given[name].shape)
        if missing := [name for name in self.inputs if name not in given]:
            raise self._config_error(f"takes the input '{missing[0]}' {tuple(self.inputs[missing[0]][0])}, which this stage does not give")
        if missing := [name for name in wanted if name not in self.outputs]:
            raise self._config_error(f"has no output '{missing[0]}', only {', '.join(self.outputs)}")
        try:
            return [np.asarray(value) for value in self.session.run(list(wanted), dict(given))]
        except Exception as error:
            raise self._config_error(f"fails: {_error_text(error)}") from error

    def size(self, name: str) -> tuple[int | None, int | None]:
        """Height and width of an input image (1, c, h, w), None where any is taken. Raises ConfigError for an input of another shape."""
        self._check_input(name, None)
        shape = self.inputs[name][0]
        if len(shape) != 4:
            raise self._config_error(f"takes '{name}' as {tuple(shape)}, which is no image (1, c, h, w)")
        height, width = (side if isinstance(side, int) else None for side in shape[2:])
        return height, width

    def rows(self, name: str, value: NDArray[Any], *shape: int | None) -> F32:
        """Return an output as an array of a shape (None: any length), without the batch's axis. Raises ConfigError for any other, or not finite."""
        found = np.asarray(value)
        while found.ndim > len(shape) and found.shape[0] == 1:
            found = found[0]
        if found.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, found.shape)):
            wanted = ", ".join("n" if side is None else str(side) for side in shape)
            raise self._config_error(f"gives '{name}' as {tuple(np.shape(value))}, and ({wanted}) is required")
        if found.dtype.kind not in "fiub":
            raise self._config_error(f"gives '{name}' as {found.dtype}, and numbers are required")
        found = np.ascontiguousarray(found, np.float32)
        if not np.isfinite(found).all():
            raise self._config_error(f"gives '{name}' that is not finite")
        return found

    def _check_input(self, name: str, shape: tuple[int, ...] | None) -> None:
        if name not in self.inputs:
            raise self._config_error(f"has no input '{name}', only {', '.join(self.inputs)}")
        wanted, kind = self.inputs[name]
        if kind != "tensor(float)":
            raise self._config_error(f"takes '{name}' as {kind}, and tensor(float) is given")
        if shape is not None and (len(wanted) != len(shape) or any(isinstance(w, int) and w != s for w, s in zip(wanted, shape))):
            raise self._config_error(f"takes '{name}' as {tuple(wanted)}, and {shape} is given")

    def _config_error(self, cause: str) -> ConfigError:
        return ConfigError(f"{self.slot}.model", f"{self.path} {cause}", f"see trihedron plugins {self.slot} for what a network must take and give")


def _error_text(error: Exception) -> str:
    return " ".join(str(error).split())[:MESSAGE]


@dataclass(frozen=True)
class NetworkImage:
    """An image as a network takes it, (1, c, h, w) in 0 … 1, and the pixels of the frame for each of its own in x and y."""

    tensor: F32
    scale: tuple[float, float]

    def pixels(self, found: NDArray[Any]) -> F64:
        """Pixels (..., 2) of the frame for those of the network's image; pixel centres at integers in both."""
        return np.asarray((np.asarray(found, np.float64) + 0.5) * self.scale - 0.5, np.float64)

    def own(self, pixels: NDArray[Any]) -> F64:
        """Pixels (..., 2) of the network's image for those of the frame."""
        return np.asarray((np.asarray(pixels, np.float64) + 0.5) / self.scale - 0.5, np.float64)


def network_image(frame: Frame, network: Network, name: str, channels: int, multiple: int) -> NetworkImage:
    """Make the input image `name` of a frame: grey (1 channel) or RGB (3), resized where the network has a size, else its sides cut to a multiple."""
    picture = frame.gray if channels == 1 else frame.color
    height, width = picture.shape[:2]
    rows, columns = network.size(name)
    rows, columns = rows or max(height // multiple, 1) * multiple, columns or max(width // multiple, 1) * multiple
    fixed = any(side is not None for side in network.size(name))
    scale = (width / columns, height / rows) if fixed else (1.0, 1.0)
    if fixed and (rows, columns) != (height, width):
        picture = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA if rows < height else cv2.INTER_LINEAR)
    elif not fixed:
        padded = ((0, max(rows - height, 0)), (0, max(columns - width, 0))) + ((0, 0),) * (picture.ndim - 2)
        picture = np.pad(picture[:rows, :columns], padded)
    planes = picture[None] if channels == 1 else np.moveaxis(picture, 2, 0)
    return NetworkImage(np.ascontiguousarray(planes[None], np.float32) / np.float32(255.0), scale)


def bytes_of(descriptors: F32) -> NDArray[np.uint8]:
    """Bytes (n, at least 128) of descriptors (n, d), made unit vectors: 256 steps for 1, so that distances of vectors are 1/256 of those of bytes."""
    length = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    found = np.full((len(descriptors), max(descriptors.shape[1], HISTOGRAM_BYTES)), int(CENTRE), np.uint8)
    found[:, : descriptors.shape[1]] = np.clip(np.rint(CENTRE + DESCRIPTOR_GAIN * descriptors / length), 0, 255).astype(np.uint8)
    return found


def vectors_of(descriptors: NDArray[np.uint8], width: int) -> F32:
    """The unit vectors (n, width) that `bytes_of` made bytes of."""
    vectors = (descriptors[:, :width].astype(np.float32) - np.float32(CENTRE)) / np.float32(DESCRIPTOR_GAIN)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12), np.float32)
