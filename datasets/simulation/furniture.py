"""Pieces of furniture that stand against a wall or hang on it: `piece(wall, at)` is a list of solids, `at` metres along the wall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trihedron.datasets.simulation.room import HEIGHT_M, UP, Solid, Wall, cylinder, sphere, turned_box

Piece = Callable[[Wall, float], list[Solid]]


def _door(wall: Wall, at: float) -> list[Solid]:
    """A closed door in its frame."""
    jambs = [wall.mount_box(at + side, (0.0, 2.05), 0.08, 0.07, "plastic") for side in (-0.49, 0.49)]
    return [wall.mount_box(at, (0.0, 2.05), 0.9, 0.03, "wood", "door"), wall.mount_box(at, (2.05, 2.14), 1.06, 0.07, "plastic"), *jambs]


def _picture(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (1.2, 1.85), 0.8, 0.025, "plastic", "picture")]


def _portrait(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (1.25, 1.9), 0.45, 0.025, "plastic", "picture")]


def _window(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (1.1, 2.2), 1.5, 0.03, "plastic", "picture"), wall.mount_box(at, (1.04, 1.1), 1.7, 0.12, "plastic")]


def _pilaster(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (0.0, HEIGHT_M), 0.4, 0.15, "marble")]


def _cabinet(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (0.0, 0.9), 1.2, 0.4, "wood", "drawers")]


def _locker(wall: Wall, at: float) -> list[Solid]:
    return [wall.mount_box(at, (0.0, 1.8), 0.8, 0.38, "plastic", "door")]


def _globe(wall: Wall, at: float) -> list[Solid]:
    """A globe on a cabinet."""
    x, y, _ = wall.start + wall.along * at + wall.normal * 0.2
    return [*_cabinet(wall, at), sphere(float(x), float(y), 1.07, 0.17, "globe")]


def _bin(wall: Wall, at: float) -> list[Solid]:
    x, y, _ = wall.start + wall.along * at + wall.normal * 0.2
    return [cylinder(float(x), float(y), (0.0, 0.7), 0.16, "marble")]


def _crates(wall: Wall, at: float) -> list[Solid]:
    """One along the wall, and a turned one on top."""
    low = wall.mount_box(at, (0.0, 0.45), 0.6, 0.4, "crate")
    centre = low.centre + UP * 0.4
    return [low, turned_box(centre, np.array([0.16, 0.12, 0.175]), low.yaw + np.radians(20.0), "crate")]


def _shelf(wall: Wall, at: float) -> list[Solid]:
    """An open shelf with three rows of books."""
    sides = [wall.mount_box(at + side, (0.0, 2.0), 0.03, 0.3, "wood") for side in (-0.585, 0.585)]
    boards = [wall.mount_box(at, (z, z + 0.03), 1.14, 0.3, "wood") for z in (0.05, 0.5, 0.95, 1.4, 1.97)]
    books = [wall.mount_box(at + side, (z, z + 0.29), 0.75, 0.24, "paper", "books") for z, side in ((0.53, -0.18), (0.98, 0.15), (1.43, -0.1))]
    return [*sides, *boards, *books]


def _desk(wall: Wall, at: float) -> list[Solid]:
    """A table with a monitor."""
    legs = [wall.mount_box(at + side, (0.0, 0.71), 0.06, 0.06, "wood", off_m=off) for side in (-0.65, 0.65) for off in (0.02, 0.52)]
    monitor = [
        wall.mount_box(at, (0.87, 1.22), 0.6, 0.04, "plastic", "screen", 0.18),
        wall.mount_box(at, (0.75, 0.87), 0.2, 0.2, "plastic", off_m=0.1),
    ]
    return [wall.mount_box(at, (0.71, 0.75), 1.4, 0.6, "wood"), *legs, *monitor]


def _sofa(wall: Wall, at: float) -> list[Solid]:
    arms = [wall.mount_box(at + side, (0.0, 0.6), 0.2, 0.65, "fabric") for side in (-0.8, 0.8)]
    return [wall.mount_box(at, (0.0, 0.42), 1.4, 0.65, "fabric"), wall.mount_box(at, (0.42, 0.85), 1.4, 0.2, "fabric"), *arms]


def _bench(wall: Wall, at: float) -> list[Solid]:
    legs = [wall.mount_box(at + side, (0.0, 0.41), 0.06, 0.3, "wood", off_m=0.03) for side in (-0.55, 0.55)]
    return [wall.mount_box(at, (0.41, 0.46), 1.3, 0.38, "wood"), *legs]


PIECES: dict[str, Piece] = {
    "door": _door, "picture": _picture, "portrait": _portrait, "window": _window, "pilaster": _pilaster, "cabinet": _cabinet, "locker": _locker,
    "globe": _globe, "bin": _bin, "crates": _crates, "shelf": _shelf, "desk": _desk, "sofa": _sofa, "bench": _bench,
}  # fmt: skip


def furniture_along(wall: Wall, plan: str) -> list[Solid]:
    """The solids of a plan `piece at, piece at, …` along a wall."""
    entries = (entry.split() for entry in plan.split(",") if entry.strip())
    return [solid for name, at in entries for solid in PIECES[name](wall, float(at))]


def curved_pieces() -> list[Solid]:
    """A column, a ball and a plant along the room's north wall: what no plane describes. The plant's crown is a clutter of small balls."""
    column, ball = cylinder(3.0, 3.35, (0.0, HEIGHT_M), 0.22, "marble"), sphere(3.85, 3.2, 0.28, 0.28, "globe")
    x, y = 2.55, 3.6
    pot = [cylinder(x, y, (0.0, 0.3), 0.15, "fabric"), cylinder(x, y, (0.3, 0.8), 0.025, "wood")]
    turns = np.arange(24) * np.pi * (3.0 - np.sqrt(5.0))  # the golden angle spreads them evenly
    heights = np.linspace(-1.0, 1.0, len(turns))
    reach = 0.22 * np.sqrt(1.0 - heights**2) + 0.03
    radii = 0.05 + 0.02 * (np.arange(len(turns)) % 3)
    crown = [sphere(x + r * np.cos(t), y + r * np.sin(t), 1.02 + 0.26 * h, radius, "fabric") for t, h, r, radius in zip(turns, heights, reach, radii)]
    return [column, ball, *pot, *crown]
