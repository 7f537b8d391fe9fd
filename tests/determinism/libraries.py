"""Whether a setting of the matrix changes anything here: results that may differ by machine.

No registration uses these operations.
"""

import math

import numba
import numpy as np
import torch

from chsel.numerics.arrays import digest


def digests():
    """Digest of each library's results for fixed arguments."""
    x = np.random.Generator(np.random.Philox(5)).random((96, 96)) + 0.1
    by_libm = [(math.exp(v), math.sin(v), math.log(v), math.pow(v, 0.3)) for v in x.reshape(-1)]
    t = torch.from_numpy(x.astype(np.float32))
    return {
        "C library": digest(np.array(by_libm)),
        "numpy": digest(np.exp(x), np.sin(x), np.log(x), x**0.3, np.exp(x.astype(np.float32))),
        "numpy BLAS": digest(x @ x, np.linalg.inv(x)),
        "torch": digest(t.exp().numpy(), t.pow(0.3).numpy(), t.lerp(t.T, 0.3).numpy()),
        "torch BLAS": digest((t @ t).numpy()),
        "fused kernels": digest(fused(x.reshape(-1))),
    }


@numba.njit(fastmath={"contract"})
def fused(x):
    """x^2 - x (N,), rounded once on a CPU that can multiply and add in one: never done so."""
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = x[i] * x[i] - x[i]
    return out
