"""Pieces of an image that hang together in space."""

from __future__ import annotations

import numpy as np

BESIDE = ((0, 1), (0, 2), (1, -1), (1, 0), (1, 1))  # rows down and columns around the turn, of neighbours
APART = (0.2, 0.03)  # metres, and share of the range, by which neighbours of one piece differ at most


def pieces(metres: np.ndarray, among: np.ndarray) -> np.ndarray:
    """(H, W) int: which piece each of the pixels `among` (H, W) bool is of, numbers from 0 on, and -1 elsewhere; metres
    (H, W). Neighbours, up to two columns away and a beam up or down, are of one piece where they are about as far."""
    place, found = np.arange(metres.size).reshape(metres.shape), np.full(metres.shape, -1)
    first, second = [], []
    for down, right in BESIDE:
        here, there = slice(len(metres) - down), slice(down, None)
        far, whose, other = (np.roll(part, -right, 1)[there] for part in (metres, among, place))
        near = APART[0] + APART[1] * metres[here]
        alike = among[here] & whose & (np.abs(far - metres[here]) < near)
        first.append(place[here][alike])
        second.append(other[alike])
    least = connected(np.concatenate(first), np.concatenate(second), metres.size)
    found[among] = np.unique(least[among.ravel()], return_inverse=True)[1].ravel()
    return found


def connected(one: np.ndarray, other: np.ndarray, count: int) -> np.ndarray:
    """(count,) for each of `count` cells the least number of all that it is connected with, by pairs (N,) of cells."""
    least = np.arange(count)
    while len(one):
        a, b = least[one], least[other]
        apart = a != b
        one, other, a, b = one[apart], other[apart], a[apart], b[apart]
        np.minimum.at(least, np.maximum(a, b), np.minimum(a, b))
        while not np.array_equal(shorter := least[least], least):
            least = shorter
    return least
