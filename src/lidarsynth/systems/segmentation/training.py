"""RangeNet learns the class of every pixel of labelled range images (Milioto et al. 2019).

All randomness of a sample is a function of (seed, step, its position in the global batch) (`training.randomness`).
Batch normalisation takes its statistics per process, so two processes do not give quite the curve of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.data.dataset import CachedImages, SeveralCaches
from lidarsynth.experiment.record import Experiment, Segmentation
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.metrics.reconstruction import accuracy, class_iou, confusion_matrix
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import label_strip, range_strip
from lidarsynth.training.randomness import sample_rng
from lidarsynth.training.task import Images, Phase, Task

COUNTED = 64  # images of a data set whose labels tell how frequent each class is
UNLABELED = 0  # the class that is neither learned nor judged


class SegmentationBatch(NamedTuple):
    """One process's share of one pass: b samples."""

    image: Tensor  # (b, 5, H, W) range, x, y, z in metres, reflectance in [0, 1]; range 0 = not measured; augmented
    label: Tensor  # (b, H, W) int64 classes, 0 = unlabeled or not measured
    weights: Tensor  # (classes,) of the cross-entropy


class CrossEntropy(nn.Module):
    """`objective(batch)` -> the weighted cross-entropy per sample, mean over its labelled pixels."""

    def __init__(self, network: RangeNet):
        super().__init__()
        self.network = network

    def forward(self, batch: SegmentationBatch) -> dict[str, Tensor]:
        x = self.network.network_input(batch.image, batch.image[:, :1] > 0)
        logits = self.network(x.contiguous(memory_format=torch.channels_last))  # 1.2 times as fast in bf16 on a CPU
        losses = nn.functional.cross_entropy(
            logits.float(), batch.label, batch.weights, ignore_index=UNLABELED, reduction="none"
        )
        labelled = (batch.label != UNLABELED).sum((1, 2))
        return {"cross_entropy": losses.sum((1, 2)) / labelled.clamp(min=1)}


def draw(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> SegmentationBatch:
    """The batch of labelled images that stand at `positions` of step `step`'s global batch.

    Raises ValueError for an image without labels, or a cut that is wider than the image.
    """
    seed = experiment.training.seed
    drawn = [
        augment(experiment, image, sample_rng(seed, step, position))
        for image, position in zip(images.take(indices), positions, strict=True)
    ]
    pixels, labels = (torch.from_numpy(np.stack(part)) for part in zip(*drawn, strict=True))
    return SegmentationBatch(pixels, labels, class_weights(class_shares(images)))


def augment(experiment: Experiment, image: RangeImage, rng: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(5, H, W') float32 and (H, W') int64: the scan turned, mirrored, thinned and cut as the experiment says."""
    data, options, width = experiment.data, segmentation_of(experiment), image.shape[1]
    columns = _columns(options, width)
    shift, first = (int(torch.randint(n, (), generator=rng)) for n in (width, width - columns + 1))
    flip, share = torch.rand(2, generator=rng).tolist()
    kept = torch.rand(image.shape, generator=rng).numpy() >= share * options.drop
    order = np.roll(np.arange(width), shift) if data.roll else np.arange(width)
    order = order[::-1] if data.mirror and flip < 0.5 else order
    turned = replace(
        image,
        range=image.range[:, order],
        reflectance=image.reflectance[:, order],
        mask=image.mask[:, order],
        label=_label(image)[:, order],
        xyz=None,  # the points follow from the new columns
    ).keep(kept)
    part = slice(first, first + columns)
    return pixels(turned)[:, :, part], _label(turned)[:, part]


def _columns(options: Segmentation, width: int) -> int:
    """How many columns of images of `width` are learned from at once. Raises ValueError unless they have so many."""
    columns = options.columns or width
    if columns > width or columns % 32:
        raise ValueError(f"segmentation.columns: expected a multiple of 32 up to {width}, found {columns}")
    return columns


def pixels(image: RangeImage) -> np.ndarray:
    """(5, H, W) float32: range, x, y, z in metres, reflectance in [0, 1], as `RangeNet.network_input` takes them."""
    planes = [image.range, *np.moveaxis(image.points(), -1, 0), image.reflectance]
    return np.stack(planes).astype(np.float32)


def _label(image: RangeImage) -> np.ndarray:
    if image.label is None:
        raise ValueError("expected images with labels, such as synthetic streets or SemanticKITTI's, found one without")
    return np.where(image.mask, image.label, UNLABELED)


@lru_cache(maxsize=2)
def class_shares(images: Images) -> np.ndarray:
    """(classes,) share of each class in the labelled pixels of at most `COUNTED` images from everywhere in the data.

    The same in every process and after every resume. Raises ValueError for an image without labels, or no labels.
    """
    if isinstance(images, CachedImages | SeveralCaches):
        chosen = images.spread(COUNTED)
    else:
        chosen = [17 * k for k in range(COUNTED)]  # one place of each world of endless streets
    labels = np.concatenate([_label(images.take([i])[0]).ravel() for i in chosen])
    counts = np.bincount(labels, minlength=len(CLASSES)).astype(np.float64)
    counts[UNLABELED] = 0
    if not counts.any():
        raise ValueError("expected labelled pixels, found none")
    return counts / counts.sum()


def suits(experiment: Experiment, images: Images, learned: bool) -> None:
    """Raises ValueError for images of a cache without labels, and for such that are too narrow to learn from."""
    if learned:
        _columns(segmentation_of(experiment), experiment.data.width)
    if isinstance(images, CachedImages | SeveralCaches):  # streets have labels
        class_shares(images)


def class_weights(shares: np.ndarray) -> Tensor:
    """(classes,) float32: 1 / ln(1.02 + share) (Paszke et al. 2016), so that labelled pixels weigh 1 on average."""
    weights = 1 / np.log(1.02 + shares)
    return torch.from_numpy(weights / (weights * shares).sum()).float()


@torch.no_grad()
def classify(network: RangeNet, image: RangeImage) -> RangeImage:
    """The image with the network's classes 1-19 as its label, 0 where not measured; 0 itself is never learned.

    A turn of other than a multiple of 32 columns is seen on into its next one.
    """
    width = image.shape[1]
    columns = np.arange(width + -width % 32) % width
    values = torch.from_numpy(pixels(image)[:, :, columns])[None].to(network.means)
    logits = network(network.network_input(values, values[:, :1] > 0))
    label = logits[0, 1:, :, :width].argmax(0).cpu().numpy() + 1
    return replace(image, label=np.where(image.mask, label, UNLABELED))


def confusion(network: RangeNet, images: Sequence[RangeImage]) -> np.ndarray:
    """(classes, classes) int64 pixels of labelled images, truth by row, prediction by column."""
    return sum(
        (confusion_matrix(_label(image), _label(classify(network, image))) for image in images),
        np.zeros((len(CLASSES), len(CLASSES)), np.int64),
    )


def judge(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """`miou`: mean intersection over union of the classes that occur in the truth; `accuracy`: share of right pixels.

    Unlabelled pixels do not count.
    """
    assert isinstance(network, RangeNet)
    counts = confusion(network, images)
    occurs = counts.sum(1) > 0
    occurs[UNLABELED] = False
    return {"miou": float(class_iou(counts, (UNLABELED,))[occurs].mean()), "accuracy": accuracy(counts, (UNLABELED,))}


def pictures(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2
) -> list[np.ndarray]:
    """(H', W', 3) uint8 each: range, the network's classes, the true ones."""
    assert isinstance(network, RangeNet)
    rows = (
        {"range": range_strip(i), "prediction": label_strip(classify(network, i)), "truth": label_strip(i)}
        for i in images[:count]
    )
    return [panel([[item] for item in row.items()]) for row in rows]


def segmentation_of(experiment: Experiment) -> Segmentation:
    """The experiment's group of that name. Raises ValueError where there is none."""
    if experiment.segmentation is None:
        raise ValueError(f"{experiment.name}: expected a segmentation group, found none")
    return experiment.segmentation


def _phases(experiment: Experiment, network: nn.Module) -> tuple[Phase, ...]:
    assert isinstance(network, RangeNet)
    return (Phase(CrossEntropy(network)),)


SEGMENTATION = Task(
    parts=("cross_entropy",),
    draw=draw,
    phases=_phases,
    judge=judge,
    pictures=pictures,
    suits=suits,
)
