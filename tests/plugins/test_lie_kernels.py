"""The kernels of SO(3) agree with `pipeline.core.geometry`, from tiny angles to almost π."""

import numpy as np
import pytest

from trihedron.pipeline.core import lie
from trihedron.plugins.shared import lie_kernels

ANGLES = (0.0, 1e-9, 1e-6, 2e-6, 1e-3, 1.0, 3.1)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_agree_with_geometry(angle):
    axis = np.array([0.36, -0.48, 0.8])
    phi, R = angle * axis, lie.exp_so3(angle * axis)
    np.testing.assert_allclose(lie_kernels.exp_so3(*phi), R, atol=1e-15)
    np.testing.assert_allclose(lie_kernels.log_so3(R), phi, atol=1e-14)
    np.testing.assert_allclose(lie_kernels.log_so3_each(np.stack([R, R.T])), [phi, -phi], atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_multiplication_is_a_product(angle):
    phi, R = angle * np.array([0.6, 0.0, -0.8]), lie.exp_so3(np.array([0.3, 1.2, -0.5]))
    expected = lie.exp_so3(phi) @ R
    lie_kernels.left_multiply_exp(phi, R)
    np.testing.assert_allclose(R, expected, atol=1e-15)
