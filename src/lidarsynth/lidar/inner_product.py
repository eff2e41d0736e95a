"""The inner product of two long vectors, by one thread."""

from __future__ import annotations

import numpy as np


def inner_product(a: np.ndarray, b: np.ndarray) -> np.float64:
    """a @ b of (N,) and (N,) float64, without the threads that `@` gives 10,000 numbers and more to: where other
    processes keep the cores busy, it waits for them a thousand times as long as the sum takes. Raises ValueError where
    the lengths differ and neither is 1."""
    return np.einsum("i,i", a, b)
