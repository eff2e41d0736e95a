"""Protocols that compare image i with image i: errors of range and reflectance, agreement of classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarsynth.evaluation.image_sets import Cloud, points_of
from lidarsynth.evaluation.protocol import EvaluationProtocol
from lidarsynth.evaluation.report import Report, Result, dark
from lidarsynth.evaluation.statistics import hash_of, hash_of_points
from lidarsynth.lidar.beams import same_beams
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.metrics.reconstruction import (
    Errors,
    class_iou,
    confusion_matrix,
    mean_errors,
    mean_iou,
    point_errors,
    reconstruction_errors,
    voxel_errors,
    weighted_iou,
)
from lidarsynth.networks.device import usual_torch
from lidarsynth.networks.rangenet import RangeNet

VOXELS = ("range-mae-full", "voxel-iou", "voxel-precision", "voxel-recall", "voxel-f1")  # of ILN, of one pair each
FULL = 100.0  # metres that no return counts as, and at which ranges are cut


class Pairs:
    """Errors of images that arrive with their truth. `classes` is a RangeNet in evaluation mode, or None.

    `seen`, where given, keeps the classes of each truth by its hash, for others that are compared with the same ones.
    `others` are the sensors, in words, of pairs of unlike beams; `unlike` is how many pairs are not one image twice.
    Of bounded size but for a few numbers per pair; `merge` adds what another process gathered, `state` and `restore`
    are for files.
    """

    def __init__(
        self,
        protocol: EvaluationProtocol,
        classes: RangeNet | None = None,
        seen: dict[int, np.ndarray] | None = None,
    ):
        self.protocol, self.classes, self.seen = protocol, classes, seen
        self.errors: list[Errors] = []
        self.chamfer: list[float] | None = [] if any(row.measure == "chamfer" for row in protocol.rows) else None
        self.voxels: list[list[float]] | None = [] if any(row.measure in VOXELS for row in protocol.rows) else None
        self.confusion = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
        self.others: list[str] = []
        self.unlike = 0
        self._lit = [0, 0]  # images with any reflectance, of results and of truths
        self._digests = [0, 0]

    @usual_torch()
    def update(self, results: Sequence[RangeImage], truths: Sequence[RangeImage]) -> None:
        """Take in a batch of images and their truths, all pixels of both. Raises ValueError for different sizes."""
        for result, truth in zip(results, truths, strict=True):
            self.errors.append(reconstruction_errors(result, truth))
            if self.chamfer is not None:
                self.chamfer.append(_chamfer(*self._points(result, truth)))
            if self.voxels is not None:
                self.voxels.append(_voxels(result, truth))
            self._lit = [n + bool(i.reflectance.any()) for n, i in zip(self._lit, (result, truth), strict=True)]
            if not same_beams(result.sensor, truth.sensor):
                self.others.append(f"{result.sensor.name} against {truth.sensor.name}")
            self._add_pair(hash_of(result), hash_of(truth))
        if self.classes and results:
            self.confusion += confusion_matrix(self._labels_of_truths(truths), self._labels(results))

    def update_points(self, results: Sequence[Cloud], truths: Sequence[Cloud]) -> None:
        """Take in a batch of point lists, as the protocol's `clouds` have them, and their truths."""
        assert self.chamfer is not None
        for result, truth in zip(results, truths, strict=True):
            self.chamfer.append(_chamfer(result.xyz, truth.xyz))
            self._add_pair(hash_of_points(result), hash_of_points(truth))

    def _points(self, result: RangeImage, truth: RangeImage) -> list[np.ndarray]:
        clouds = self.protocol.clouds
        assert clouds is not None
        return [points_of(image, image.sensor, clouds, real).xyz for image, real in ((result, False), (truth, True))]

    @property
    def lit(self) -> bool:
        """Whether both sides have any reflectance."""
        return all(self._lit)

    @property
    def count(self) -> int:
        """How many pairs so far."""
        return len(self.errors if self.chamfer is None else self.chamfer)

    def _add_pair(self, result: int, truth: int) -> None:
        self.unlike += result != truth
        self._add_digests([result, truth])

    def _add_digests(self, digests: Sequence[int]) -> None:
        self._digests = [(own + its) % (1 << 128) for own, its in zip(self._digests, digests, strict=True)]

    def merge(self, other: Pairs) -> None:
        """Take in all that `other` has seen. Raises ValueError for another protocol."""
        if self.protocol != other.protocol:
            raise ValueError(f"expected pairs of {self.protocol.title}, found {other.protocol.title}")
        self.restore(other.state())

    def state(self) -> dict[str, Any]:
        """Plain lists and numbers, for a file; the inverse of `restore`."""
        errors = [list(asdict(e).values()) for e in self.errors]
        digests = [f"{digest:032x}" for digest in self._digests]
        state = {"errors": errors, "confusion": self.confusion.tolist(), "lit": self._lit, "digests": digests}
        state |= {"others": self.others, "unlike": self.unlike}
        more = {"chamfer": self.chamfer, "voxels": self.voxels}
        return state | {name: values for name, values in more.items() if values is not None}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take in what `state` of another gave."""
        self.errors += [Errors(*values) for values in state["errors"]]
        self.confusion += np.array(state["confusion"], np.int64)
        self._lit = [own + its for own, its in zip(self._lit, state["lit"], strict=True)]
        self.others += state["others"]
        self.unlike += state.get("unlike", 0)  # those of before did not count
        if self.chamfer is not None:
            self.chamfer += state["chamfer"]
        if self.voxels is not None:
            self.voxels += state["voxels"]
        self._add_digests([int(digest, 16) for digest in state["digests"]])

    def __getstate__(self) -> dict[str, Any]:
        """For another process: all but the network and what it said."""
        return {**vars(self), "classes": None, "seen": None}

    def _labels_of_truths(self, images: Sequence[RangeImage]) -> np.ndarray:
        if self.seen is None:
            return self._labels(images)
        keys = [hash_of(image) for image in images]
        for key, image in zip(keys, images, strict=True):
            if key not in self.seen:
                self.seen[key] = self._labels([image])[0].astype(np.uint8)
        return np.stack([self.seen[key] for key in keys]).astype(np.int64)

    @torch.no_grad()
    def _labels(self, images: Sequence[RangeImage]) -> np.ndarray:
        """(B, H, W) class of every pixel, also of those without a return, as LiDARGen judges."""
        assert self.classes
        device = self.classes.means.device
        pixels = np.stack([np.stack([i.range, *np.moveaxis(i.points(), -1, 0), i.reflectance]) for i in images])
        masks = torch.from_numpy(np.stack([image.mask for image in images])).to(device)
        inputs = self.classes.network_input(torch.from_numpy(pixels.astype(np.float32)).to(device), masks)
        return self.classes(inputs).argmax(1).cpu().numpy()

    def report(self, missing: Mapping[str, str] | None = None, weights: Mapping[str, str] | None = None) -> Report:
        """The protocol's rows so far. Raises ValueError for no pair."""
        mean, results = None if self.chamfer and not self.errors else mean_errors(self.errors), []
        each = {"chamfer": self.chamfer or [], **dict(zip(VOXELS, zip(*self.voxels or [], strict=True), strict=False))}
        for row in self.protocol.rows:
            reason = ""
            if row.network and not self.classes:
                reason = (missing or {}).get(row.network, f"no {row.network} is here")
            elif row.network or row.measure == "reflectance-mae":
                lacking = [side for n, side in zip(self._lit, ("samples have", "reference has"), strict=True) if not n]
                reason = f"the {lacking[0]} no reflectance" if lacking else ""
            value = None if reason else MEASURES[row.measure](mean, self.confusion, each) * row.scale
            results.append(Result(row.name, value, row.unit, row.digits, reason))
        results += [Result(name, None, reason=reason) for name, reason in self.protocol.absent]
        counts = {"samples": self.count, "reference": self.count}
        names = ("samples", "reference")
        hashes = {name: f"{digest:032x}" for name, digest in zip(names, self._digests, strict=True)}
        iou = class_iou(self.confusion, (0,)).tolist() if self.classes and self.lit else []
        classes = {name: value for (name, _), value in zip(CLASSES[1:], iou[1:], strict=False)} or None
        hashes |= weights or {}
        return Report(self.protocol, tuple(results), counts, hashes, {}, self._notes(), classes=classes)

    def _notes(self) -> tuple[str, ...]:
        told = []
        if any(row.network or row.measure == "reflectance-mae" for row in self.protocol.rows):
            sides = zip(self._lit, ("samples", "reference"), strict=True)
            told += [dark(self.count - n, self.count, name) for n, name in sides if 0 < n < self.count]
        if self.others:
            told.append(f"{len(self.others)} of {self.count} samples are of other beams than their reference, first "
                        f"{self.others[0]}")  # fmt: skip
        return tuple(told)


def _chamfer(points: np.ndarray, truth: np.ndarray) -> float:
    """CD of LiDAR-Diffusion, m^2: half the sum of both mean squared distances between points (N, 3) and (M, 3)."""
    return point_errors(points, truth).chamfer_squared / 2


def _voxels(result: RangeImage, truth: RangeImage) -> list[float]:
    """`VOXELS` of a pair, of the points that lie on their pixels' rays, from the least to the greatest range of the
    truth's sensor; 0 where either has none."""
    full = [np.where(image.mask, np.minimum(image.range, FULL), FULL) for image in (result, truth)]
    mae = float(np.abs(full[0] - full[1]).mean())
    near, far = truth.sensor.min_range, truth.sensor.max_range
    kept = [image.mask & (image.range >= near) & (image.range <= far) for image in (result, truth)]
    if not all(mask.any() for mask in kept):
        return [mae, 0.0, 0.0, 0.0, 0.0]
    points, true = (i.sensor.points(i.range)[mask] for i, mask in zip((result, truth), kept, strict=True))
    return [mae, *asdict(voxel_errors(points, true)).values()]


def _mean_of(name: str, errors: Any, confusion: np.ndarray, each: Mapping[str, Sequence[float]]) -> float:
    return float(np.mean(each[name]))


Measure = Callable[[Any, np.ndarray, Mapping[str, Sequence[float]]], float]
MEASURES: dict[str, Measure] = {  # of mean errors, confusion, numbers of each pair by their names
    "range-mae": lambda errors, confusion, each: errors.range_mae,
    "reflectance-mae": lambda errors, confusion, each: errors.reflectance_mae,
    "iou": lambda errors, confusion, each: mean_iou(confusion),
    "iou-weighted": lambda errors, confusion, each: weighted_iou(confusion),
    **{name: partial(_mean_of, name) for name in ("chamfer", *VOXELS)},
}


def classes_of(networks: Mapping[str, nn.Module]) -> RangeNet | None:
    """The segmenter among a protocol's networks, or None."""
    network = networks.get("rangenet")
    return network if isinstance(network, RangeNet) else None
