"""Numba kernels of `appearance.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import I32
from trihedron.plugins.shared.descriptors_kernels import hamming

# Bags of binary words: a vocabulary trained on the run's own descriptors, and how alike two images are by the words in them.
#
# Words are the centres of a k-majority clustering (Grana et al. 2013: k-means for bits); images are compared as in DBoW2 (Gálvez-López and Tardós,
# T-RO 2012), by the L1 distance of their normalised tf-idf vectors.

U64 = NDArray[np.uint64]


@kernel
def nearest_words(bits: U64, vocabulary: U64) -> I32:
    """(n,) row of the nearest word of each descriptor, the first of equally near ones."""
    out = np.zeros(len(bits), np.int32)
    for i in range(len(bits)):
        best = 1 << 30
        for k in range(len(vocabulary)):
            distance = hamming(bits[i], vocabulary[k])
            if distance < best:
                best = distance
                out[i] = k
    return out
