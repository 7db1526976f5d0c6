"""Values of a robot's recording, whatever the format of its messages: images, intrinsics, transforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix, rotation_from_quaternion
from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.types import F64


class UnreadableMessage(ValueError):
    """A message whose bytes do not fit its type; the text is the cause."""


@dataclass(frozen=True)
class Picture:
    """An image as it was sent. `encoding` names the pixels of a raw one; of a compressed one it is the sender's description of the format, and
    the size is not known."""

    stamp_ns: int
    frame_id: str
    encoding: str
    data: bytes
    compressed: bool
    width: int = 0
    height: int = 0
    step: int = 0  # bytes of a row
    big_endian: bool = False


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with lens distortion; `P` is the (3, 4) projection of its rectified images, zero where it was not given."""

    frame_id: str
    width: int
    height: int
    model: str
    D: tuple[float, ...]
    K: F64
    P: F64


@dataclass(frozen=True)
class Link:
    """`T_parent_child` at a time; `child` may be empty where the message does not name what moves."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: F64


def intrinsics(frame_id: str, width: int, height: int, model: str, D: list[float], K: list[float], P: list[float]) -> Intrinsics:
    """Intrinsics, checked. Raises UnreadableMessage for numbers that are none."""
    k, p, d = (np.array([float(x) for x in values]) for values in (K, P, D))
    if k.shape != (9,) or p.shape not in ((12,), (0,)) or len(d) > 14 or not all(np.isfinite(values).all() for values in (k, p, d)):
        raise UnreadableMessage("holds no calibration")
    return Intrinsics(frame_id, width, height, model, tuple(d.tolist()), k.reshape(3, 3), p.reshape(3, 4) if len(p) else np.zeros((3, 4)))


def link(stamp_ns: int, parent: str, child: str, t: list[float], q: list[float]) -> Link:
    """A transform from a translation and a quaternion x y z w, checked. Raises UnreadableMessage for numbers that are none."""
    values = np.array([float(x) for x in (*t, *q)])
    if not np.isfinite(values).all() or np.abs(values).max() > 1e9 or not 1e-3 < norm(values[3:]) < 1e3:
        raise UnreadableMessage("holds no pose")
    return Link(stamp_ns, parent.lstrip("/"), child.lstrip("/"), pose_matrix(rotation_from_quaternion(values[3:]), values[:3]))
