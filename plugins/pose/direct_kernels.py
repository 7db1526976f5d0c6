"""Kernel of `direct.py`: robust weights of a bivariate t-distribution."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64

FREEDOM = 5.0  # degrees of freedom of the t-distribution (Kerl et al.)
SCALE_ROUNDS = 4


@kernel
def student_weights_kernel(r: F64, cosine: F64, sigma: F64) -> F64:
    """Weights (n, 3) of a bivariate t-distribution with its 2 × 2 scale estimated from the residuals, in SCALE_ROUNDS fixed-point iterations."""
    n = len(r)
    a, b, c = 1.0 / 25.0, 0.0, 1.0  # the inverse of the scale: of brightness and depth in σ
    for _ in range(SCALE_ROUNDS):
        saa, sab, sbb, count = 0.0, 0.0, 0.0, 0
        for i in range(n):
            if cosine[i] > 0.0:
                e0, e1 = r[i, 0], r[i, 1] / (cosine[i] * sigma[i])
                w = (FREEDOM + 2.0) / (FREEDOM + a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1)
                saa, sab, sbb, count = saa + w * e0 * e0, sab + w * e0 * e1, sbb + w * e1 * e1, count + 1
        if count < 10:
            break
        saa, sab, sbb = saa / count + 0.25, sab / count, sbb / count + 0.01
        det = saa * sbb - sab * sab
        a, b, c = sbb / det, -sab / det, saa / det
    W = np.zeros((n, 3))
    for i in range(n):
        if cosine[i] > 0.0:
            s = 1.0 / (cosine[i] * sigma[i])
            e0, e1 = r[i, 0], r[i, 1] * s
            w = (FREEDOM + 2.0) / (FREEDOM + a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1)
            W[i, 0], W[i, 1], W[i, 2] = w * a, w * b * s, w * c * s * s
    return W
