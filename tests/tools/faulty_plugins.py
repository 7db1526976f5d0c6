"""Plugins with a known fault, for tests of what finds it."""

from dataclasses import dataclass, replace
from functools import wraps

import numpy as np
import pytest

from trihedron.pipeline.core import registry
from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.types import Camera, Frame, Keypoints, Map, Normals, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.planes.connected_components import ConnectedComponents
from trihedron.plugins.translation.levenberg_marquardt import LevenbergMarquardt


@dataclass(frozen=True)
class WrongSign:
    """The default translation with the camera's motion the wrong way round."""

    def __call__(
        self, camera: Camera, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, segments: Segments, planes: Planes,
        previous_pose: Pose | None, earlier_pose: Pose | None, map: Map | None,
    ) -> Translation:  # fmt: skip
        found = LevenbergMarquardt()(camera, rotation, tracks, keypoints, segments, planes, previous_pose, earlier_pose, map)
        if previous_pose is None:
            return found
        return replace(found, t_world_camera=2.0 * previous_pose.T_world_camera[:3, 3] - found.t_world_camera)


@dataclass(frozen=True)
class NoisyPlanes:
    """The default planes with ten times the noise of their distance and normal."""

    def __call__(self, frame: Frame, normals: Normals, rng: np.random.Generator) -> Planes:
        found = ConnectedComponents()(frame, normals)
        planes = found.coefficients.copy()
        noise = np.array([rng.multivariate_normal(np.zeros(3), 100.0 * one) for one in found.covariance]).reshape(-1, 3)
        planes[:, :3] += np.einsum("nij,nj->ni", tangent_basis(planes[:, :3]), noise[:, :2])
        planes[:, :3] /= np.linalg.norm(planes[:, :3], axis=1)[:, None]
        planes[:, 3] = np.maximum(planes[:, 3] + noise[:, 2], 0.0)
        return replace(found, coefficients=planes)


def broken(kind, change):
    """A plugin with the inputs of another, whose values it changes."""

    class Broken(kind):
        @wraps(kind.__call__)
        def __call__(self, **inputs):
            value = super().__call__(**inputs)
            return None if value is None else change(value)

    return Broken()


@pytest.fixture
def faulty(monkeypatch):
    """Plugins with a known fault, for the length of a test."""
    registry.load_plugins()  # before the copy, which is discarded with all that is registered in it
    registry.load_plugins()
    monkeypatch.setattr(registry, "_PLUGINS", {slot: dict(plugins) for slot, plugins in registry._PLUGINS.items()})
    registry.register("translation", "wrong_sign")(WrongSign)
    registry.register("planes", "noisy")(NoisyPlanes)
