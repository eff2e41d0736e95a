"""How sure a cascade may be, from streets that it has not seen: scans with pixels hidden, filled and compared."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from lidarsynth.experiment.record import Confidence
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.streets.virtual import SHARING, VirtualStreets
from lidarsynth.systems.cascade.confidence import fitted, tolerance
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.filling import Filling

RECIPES = (
    *("beams:2", "beams:4", "points:0.1", "beams:4:1", "beams:8", "points:0.03"),
    *("points:0.3", "beams:4+points:0.5", "sector:60", "points:0.01", "region:5:20:-5:5"),
    *("sector:180", "beams:4+sector:120"),
)
POINTS = 4000  # of a scan
ONE_STEP = Filling("conditional", 1)


def held_out(seed: int, count: int) -> Iterator[tuple[RangeImage, str]]:
    """`count` streets of as many virtual sensors, and what is to be hidden of each."""
    streets = VirtualStreets(seed, SHARING * count)
    for i in range(count):
        yield streets.image(SHARING * i), RECIPES[i % len(RECIPES)]


def right(filled: RangeImage, truth: RangeImage) -> np.ndarray:
    """(H, W) bool: filled pixels whose ray returns within the tolerance."""
    allowed = np.asarray(tolerance(filled.range))
    return filled.mask & truth.mask & (np.abs(filled.range - truth.range) <= allowed)


def calibrated(model: CascadeModel, seed: int = 515151, count: int = 52) -> Confidence:
    """The weights of confidence that suit a trained cascade, by `count` streets."""
    rng, seen, hits = np.random.default_rng(seed), [], []
    for number, (truth, recipe) in enumerate(held_out(seed, count)):
        own, known = model.into(truth.sensor), corrupt(truth, recipe, number)
        filled = own.fill(truth.keep(known), known, ONE_STEP)
        chosen = np.flatnonzero(filled.mask & ~known)
        chosen = rng.permutation(chosen)[:POINTS]
        seen.append(own.doubts(truth.keep(known), known).numpy().reshape(7, -1)[:, chosen].T)
        hits.append(right(filled, truth).reshape(-1)[chosen])
    return fitted(np.concatenate(seen), np.concatenate(hits))


def with_confidence(model: CascadeModel, weights: Confidence) -> CascadeModel:
    """The model, which then says how sure it is."""
    return replace(model, experiment=replace(model.experiment, confidence=weights))


def judged(model: CascadeModel, scans: Iterable[tuple[RangeImage, str]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of all new points of several scans: stated confidence, whether right, and metres off (inf without a return)."""
    stated, hits, off = [], [], []
    for number, (truth, recipe) in enumerate(scans):
        known = corrupt(truth, recipe, number)
        filled = model.into(truth.sensor).fill(truth.keep(known), known, ONE_STEP)
        if filled.confidence is None:
            raise ValueError(f"{model.experiment.name}: expected a model with confidences, found one without")
        new = filled.mask & ~known
        stated.append(filled.confidence[new])
        hits.append(right(filled, truth)[new])
        off.append(np.where(truth.mask, np.abs(filled.range - truth.range), np.inf)[new])
    return np.concatenate(stated), np.concatenate(hits), np.concatenate(off)
