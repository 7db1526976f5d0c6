"""Frames of a film, in order, by OpenCV's FFmpeg."""

from __future__ import annotations

import threading
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from trihedron.datasets.readers.images import MAX_PIXELS
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import open_file
from trihedron.pipeline.core.types import U8

MARK, MARK_AT = b"ftyp", 4  # of MP4 and QuickTime; a playlist, which may name other files, has none


class Video:
    """A film in an MP4 or QuickTime file, of one user at a time. Frames are decoded one after another: going back begins anew, since films with
    varying rates are not sought to a frame exactly."""

    def __init__(self, path: Path) -> None:
        """Raises DataError for a file that is missing, no film, or larger than an image may be."""
        self._path, self._lock, self._next = path.absolute(), threading.Lock(), 0
        try:
            with open_file(path) as file:
                head = file.read(MARK_AT + len(MARK))
        except OSError as error:
            raise DataError(str(path), f"cannot be opened ({error.strerror})", "give the folder as the phone exported it") from error
        if not head.endswith(MARK):
            raise DataError(str(path), "is not an MP4 film", "give the folder as the phone exported it")
        self.width, self.height = (int(self._film.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not (self.width > 0 and self.height > 0 and self.width * self.height <= MAX_PIXELS):
            raise DataError(str(path), "cannot be decoded", "is the film damaged? export it again")

    @cached_property
    def _film(self) -> Any:
        film = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as the sensor sees it, as depth does
        return film

    def frame(self, number: int) -> U8:
        """Return frame `number`, from 0, as (h, w, 3) RGB. Raises UnreadableImage beyond the last, or where the film is damaged."""
        with self._lock:
            if number < self._next:
                del self._film
                self._next = 0
            while self._next < number and self._film.grab():
                self._next += 1
            image = self._film.read()[1] if self._next == number else None
            self._next += image is not None
        if image is None or image.ndim != 3 or image.shape[:2] != (self.height, self.width):
            raise UnreadableImage("is not in the film, or damaged")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
