"""Run a solver table in NumPy, float64: the definition of what `solve` compiles."""

import numpy as np


def walk(table, field, x):
    """State after the last row; `field(x, sigma)` may return anything NumPy can read."""
    x = np.asarray(x, np.float64)
    stored = table.begin.reshape((-1,) + (1,) * x.ndim) * x[None]
    for sigma, side, mix in zip(table.sigma, table.side, table.mix, strict=True):
        sigma = np.nextafter(sigma, sigma + side) if side else sigma
        vectors = np.concatenate([stored, np.asarray(field(stored[0], sigma))[None]])
        stored = np.tensordot(mix, vectors, axes=1)
    return stored[0]
