"""How sure the new points of a cascade are: a chance by what the network shows, fitted on held-out streets.

A new point is right when its ray returns, and from within 0.3 m + 2 % of where the point was put.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.experiment.record import Confidence
from lidarsynth.networks.fill_unet import Filled
from lidarsynth.networks.rays import Rays, decode_range

METRES, SHARE = 0.3, 0.02  # what a point may be off: metres, and share of its range
LEAST = 0.02  # metres below which distances are all alike
FARTHEST = 1.5  # radians, where no return is known in the row and the column
NARROW = 0.2  # radians to the nearest known return, beyond which a point is in a wide hole
ANSWER = 6.0  # beyond it the network's logit says no more


def tolerance(metres: np.ndarray | Tensor) -> np.ndarray | Tensor:
    """Metres that a point at this range may be off."""
    return METRES + SHARE * metres


def signals(filled: Filled, rays: Rays) -> Tensor:
    """(B, 7, H, W) in the order of `Confidence`, without its constant: logarithms of metres by the tolerance, of
    radians, a logit, log range, and of radians by those of a narrow hole.

    filled  of a network that was asked for its doubt
    """
    assert filled.spread is not None and filled.near is not None
    metres = decode_range(filled.code)
    allowed = torch.as_tensor(tolerance(metres))
    height = torch.log1p(metres)  # a step of it times 1 + range is about a step in metres
    up = (height[:, :, 1:] - height[:, :, :-1]).abs()
    rows = torch.maximum(torch.cat([up[:, :, :1], up], 2), torch.cat([up, up[:, :, -1:]], 2))
    left = (height - height.roll(1, 3)).abs()
    columns = torch.maximum(left, left.roll(-1, 3))
    angle = torch.log(_angle(filled.near, rays) + 1e-3)
    parts = (
        _by_tolerance(filled.spread, allowed),
        angle,
        filled.logit.clamp(-ANSWER, ANSWER),
        _by_tolerance(rows * (1 + metres), allowed),
        _by_tolerance(columns * (1 + metres), allowed),
        height,
        (angle - math.log(NARROW)).clamp_min(0),
    )
    return torch.cat(parts, 1)


def _by_tolerance(metres: Tensor, allowed: Tensor) -> Tensor:
    return torch.log((metres + LEAST) / allowed)


def _angle(near: Tensor, rays: Rays) -> Tensor:
    """(B, 1, H, W) radians to the nearest known return in the row or the column, by the beams' distance there."""
    pixels = 1 / near.clamp_min(1e-4) - 1
    vertical = pixels[:, :2] * torch.maximum(rays.up, rays.down)
    horizontal = pixels[:, 2:] * rays.across
    return torch.cat([vertical, horizontal], 1).amin(1, keepdim=True).clamp(0.0, FARTHEST)


def confidence(filled: Filled, rays: Rays, weights: Confidence) -> Tensor:
    """(B, 1, H, W) chances that a point is right, of a network that was asked for its doubt."""
    *factors, constant, far = astuple(weights)
    by = torch.tensor([*factors, far], device=filled.code.device)[:, None, None]
    return torch.sigmoid((signals(filled, rays) * by).sum(1, keepdim=True) + constant)


def fitted(seen: np.ndarray, right: np.ndarray, steps: int = 50) -> Confidence:
    """Logistic regression: the weights by which `right` (N,) bool is most likely, given signals `seen` (N, 7).

    A signal whose weight would have the wrong sign, so that more doubt would mean more confidence, gets none.
    """
    signs = np.array([-1, -1, 1, -1, -1, -1, -1])
    used = np.ones(len(signs), bool)
    while True:
        weights = _newton(seen[:, used], right, steps)
        wrong = weights[:-1] * signs[used] < 0
        if not wrong.any():
            break
        used[np.flatnonzero(used)[wrong]] = False
    full = np.zeros(len(signs))
    full[used] = weights[:-1]
    factors = [round(float(w), 4) for w in full]
    return Confidence(*factors[:6], constant=round(float(weights[-1]), 4), far=factors[6])


def _newton(seen: np.ndarray, right: np.ndarray, steps: int) -> np.ndarray:
    """Weights and the constant, by Newton's method with a hair of ridge."""
    x = np.column_stack([seen, np.ones(len(seen))]).astype(np.float64)
    weights = np.zeros(x.shape[1])
    for _ in range(steps):
        chance = 1 / (1 + np.exp(-x @ weights))
        slope = x.T @ (chance - right) + 1e-3 * weights
        change = np.linalg.solve((x.T * (chance * (1 - chance))) @ x + 1e-3 * np.eye(len(weights)), slope)
        weights = weights - change
        if np.abs(change).max() < 1e-8:
            break
    return weights


def reliability(stated: Sequence[float] | np.ndarray, right: np.ndarray, bins: int = 10) -> list[tuple[float, ...]]:
    """Rows (from, to, share of all points, mean stated chance, share that is right) of equal steps of the chance."""
    stated = np.asarray(stated)
    place = np.minimum((stated * bins).astype(int), bins - 1)
    rows = []
    for k in range(bins):
        chosen = place == k
        values = (stated[chosen].mean(), right[chosen].mean()) if chosen.any() else (math.nan, math.nan)
        rows.append((k / bins, (k + 1) / bins, float(chosen.mean()), *map(float, values)))
    return rows
