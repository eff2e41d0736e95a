"""Surfaces in gaps: where nothing is known for a few pixels around, what was filled in is put straight.

The fill chooses among hypotheses pixel by pixel, and each is a little off where what it is of is far away: rings on a
road jump by a few per cent. Chosen on training scans and synthetic streets (docs/completion.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.inner_product import inner_product
from lidarsynth.lidar.scan import RangeImage

# Pixels around, without a known one, that make a gap; how far a return may be from straight, and a ring's step to be of
# one surface, as shares of 1 / range; how much bends between beams count, and staying where it was filled in.
REACH, NEAR, STEP, UPRIGHT, STAYING = 2, 0.06, 0.15, 0.3, 0.03
ROUNDS, SOLVING, ENOUGH, MOST = 2, 12, 1e-6, 1.5  # the latter as a ratio of ranges


def straight_in_gaps(image: RangeImage, told: np.ndarray) -> RangeImage:
    """The filled image, ranges of returns in gaps between the pixels `told` (H, W) bool straight where they nearly are.

    On a plane 1 / range is straight along a ring, and 1 / (range * cosine) from beam to beam, against the tangent of
    the elevation. All others stay, bit by bit.
    """
    free = _in_gap(told) & image.mask
    if not free.any():
        return image
    bends = _Bends(image, free)
    change = np.ones(bends.count)
    for _ in range(ROUNDS):
        change = np.clip(change + bends.straighter(change), 1 / MOST, MOST)
    metres = image.range.copy()
    straight = np.minimum(metres[free] / change, max(image.sensor.max_range, float(image.range.max())))
    metres[free] = np.where(straight > image.sensor.min_range, straight, metres[free])
    return replace(image, range=metres)


def _in_gap(told: np.ndarray) -> np.ndarray:
    """(H, W) bool: no pixel told within REACH columns and, beyond the usual gap between told rows, REACH rows."""
    rows = np.flatnonzero(told.any(1))
    if not len(rows):
        return np.zeros_like(told)
    side = min(REACH, (told.shape[1] - 1) // 2)
    up = REACH + int(np.diff(rows).max(initial=1)) // 2
    wide = np.pad(np.pad(told, ((0, 0), (side, side)), mode="wrap"), ((up, up), (0, 0)))
    total = np.pad(wide.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32), ((1, 0), (1, 0)))
    high, broad = 2 * up + 1, 2 * side + 1
    return (total[high:, broad:] - total[:-high, broad:] - total[high:, :-broad] + total[:-high, :-broad]) == 0


class _Bends:
    """How far returns are from between two neighbours, and the changes of those that are free that lessen it.

    A change is 1 / range over that which was filled in; those not free have 1, at the end of the free ones.
    """

    def __init__(self, image: RangeImage, free: np.ndarray) -> None:
        elevation = np.radians(np.asarray(image.sensor.elevations))
        cosine = np.cos(elevation).clip(1e-3)[:, None]  # a beam may look straight up
        inverse = np.where(image.mask, 1 / (np.maximum(image.range, 0.1) * cosine), 0).ravel()
        self.count = int(free.sum())
        place = np.full(free.size, self.count)
        place[free.ravel()] = np.arange(self.count)
        one, middle, other, share, self.weight = _triples(image.mask, free, np.tan(elevation))
        self.one, self.middle, self.other = place[one], place[middle], place[other]
        self.by_one = (1 - share) * inverse[one] / inverse[middle]
        self.by_other = share * inverse[other] / inverse[middle]
        self.steps = np.stack([inverse[one], inverse[other]]) / inverse[middle]

    def straighter(self, change: np.ndarray) -> np.ndarray:
        """What to add to changes (N,): a few steps of conjugate gradients on weighted squares."""
        whole = np.append(change, 1.0)
        bend = self._bend(change, 1.0)
        steps = np.abs(self.steps * whole[np.stack([self.one, self.other])] / whole[self.middle] - 1).max(0)
        weight = self.weight * np.clip(2 - np.abs(bend) / whole[self.middle] / NEAR, 0, 1)
        weight *= np.where(self.weight == 1, np.clip(2 - steps / STEP, 0, 1), 1)
        scale = STAYING + self._summed(weight, self.by_one**2, self.by_other**2, 1)
        left = STAYING * (1 - change) - self._back(weight * bend)
        added, ahead = np.zeros_like(change), left / scale
        size = first = inner_product(left, ahead)
        for _ in range(SOLVING):
            if size <= ENOUGH * first:
                break
            pull = self._back(weight * self._bend(ahead, 0.0)) + STAYING * ahead
            step = size / inner_product(ahead, pull)
            added, left = added + step * ahead, left - step * pull
            before, size = size, inner_product(left, left / scale)
            ahead = left / scale + size / before * ahead
        return added

    def _bend(self, change: np.ndarray, fixed: float) -> np.ndarray:
        whole = np.append(change, fixed)
        return self.by_one * whole[self.one] + self.by_other * whole[self.other] - whole[self.middle]

    def _back(self, bend: np.ndarray) -> np.ndarray:
        return self._summed(bend, self.by_one, self.by_other, -1)

    def _summed(self, values: np.ndarray, by_one: np.ndarray, by_other: np.ndarray, by_middle: float) -> np.ndarray:
        """(N,) the sum of values (M,), each times its share of the three returns that it is of."""
        size = self.count + 1
        total = np.bincount(self.one, by_one * values, size) + np.bincount(self.other, by_other * values, size)
        return (total + by_middle * np.bincount(self.middle, values, size))[:-1]


def _triples(returned: np.ndarray, free: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, ...]:
    """Flat indices (M,) of one, the middle and the other of three returns in a line, a free one among them; the other's
    share (M,) of the line between both at the middle; and weights (M,), 1 of those along a ring.

    height  (H,) tangents of the elevations
    """
    place = np.arange(returned.size).reshape(returned.shape)
    left, right = np.roll(place, 1, 1), np.roll(place, -1, 1)

    def three(one: np.ndarray, middle: np.ndarray, other: np.ndarray) -> np.ndarray:
        all_of_them = [part.ravel()[k] for part in (returned, free) for k in (one, middle, other)]
        return all_of_them[0] & all_of_them[1] & all_of_them[2] & (all_of_them[3] | all_of_them[4] | all_of_them[5])

    along = three(left, place, right)
    apart = height[:-2] - height[2:]
    share = np.where(apart > 1e-6, (height[:-2] - height[1:-1]) / np.maximum(apart, 1e-6), 0.5)
    between = np.broadcast_to(share[:, None], place[1:-1].shape)
    down = three(place[:-2], place[1:-1], place[2:])
    counts = int(along.sum()), int(down.sum())
    return (
        np.concatenate([left[along], place[:-2][down]]),
        np.concatenate([place[along], place[1:-1][down]]),
        np.concatenate([right[along], place[2:][down]]),
        np.concatenate([np.full(counts[0], 0.5), between[down]]),
        np.repeat([1.0, UPRIGHT], counts),
    )
