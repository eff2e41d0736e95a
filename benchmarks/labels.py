"""How good the classes are that `--labels` gives: of generated scans by another network, of known ones by the truth.

python benchmarks/labels.py --generated 16 --streets 16 --real FOLDER... [--inside 48] [--model default] [--by-class]
    [--least P...]

generated  scans from noise: how often street-1's RangeNet, which saw the same scan, gives the same class
streets    held-out worlds as hdl-64e-kitti sees them: whole, and of every fourth beam alone, against the truth; beside
           them the RangeNet on the whole scans
real       folders of labelled real scans, read as `benchmarks/street.py --classes` reads them
inside     held-out buildings, seen by virtual sensors of which nobody says how they stand: returns that get their
           class, furniture none; and how many of these scans, of streets of virtual sensors and of those of robots,
           0.25 to 1.8 m up, and of the scans of `streets` and `real` are taken for the inside of a building, as they
           have floors
by-class   the IoU of each class, of streets and real scans that are wholly known
least      of streets and real scans: how many pixels keep a class with so much confidence, and how many are right

mIoU is over the classes that occur in the truth, or, of generated scans, that the RangeNet finds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import any_sensor
import numpy as np
import torch
from street import HELD_OUT, SENSOR, WORD, labelled, streets

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER, CLASSES
from lidarsynth.metrics.reconstruction import class_iou, confusion_matrix
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.streets.interiors import draw_robot
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import named
from lidarsynth.systems.cascade.response import response_of
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.segmentation.training import classify
from lidarsynth.weights.load import load, load_parts


def cells(pairs: Iterable[tuple[RangeImage, RangeImage]]) -> str:
    """Two cells of (truth, answer): share of the labelled pixels with the same class, and mIoU."""
    counts = counted(pairs)
    there = np.flatnonzero(counts.sum(1)[1:]) + 1
    share = np.trace(counts[1:, 1:]) / max(counts[1:].sum(), 1)
    return f"{100 * share:.1f} % | {class_iou(counts, (0,))[there].mean():.3f} ({len(there)})"


def by_class(name: str, pairs: Iterable[tuple[RangeImage, RangeImage]]) -> str:
    """A line of (truth, answer): the IoU of each class that the truth has."""
    counts = counted(pairs)
    iou = class_iou(counts, (0,))
    return f"{name}: " + ", ".join(f"{CLASSES[k][0]} {iou[k]:.2f}" for k in range(1, 20) if counts[k].any())


def counted(pairs: Iterable[tuple[RangeImage, RangeImage]]) -> np.ndarray:
    """(20, 20) pixels of (truth, answer), truth by row."""
    counts = np.zeros((20, 20), np.int64)
    for truth, answer in pairs:
        assert truth.label is not None and answer.label is not None
        both = truth.mask & (truth.label > 0)
        counts += confusion_matrix(np.where(both, truth.label, 0), answer.label)
    return counts


def answered(model: ScanModel, image: RangeImage, every: int = 1) -> RangeImage:
    """The image with the model's classes, told every so many-th beam."""
    known = np.zeros(image.shape, bool)
    known[::every] = True
    bare = replace(image, label=None).keep(known)
    return model.complete(bare, known)


def rows(model: ScanModel, args: argparse.Namespace) -> Iterator[str]:
    """Lines of a Markdown table."""
    network = load_parts(WORD)[1]
    assert isinstance(network, RangeNet)
    yield "| classes of | pixels right | mIoU (classes) |\n|---|---:|---:|"
    if args.generated:
        made = model.generate(args.generated)
        both = cells((classify(network, image), image) for image in made)
        yield f"| {args.generated} generated scans, against RangeNet | {both} |"
    sets = {f"{args.streets} held-out streets": list(streets(HELD_OUT, args.streets))} if args.streets else {}
    sets |= {f"{folder.name} (real)": labelled(folder) for folder in args.real}
    for name, images in sets.items():
        yield f"| {name} | {cells((i, answered(model, i)) for i in images)} |"
        yield f"| {name}, every fourth beam | {cells((i, answered(model, i, 4)) for i in images)} |"
        yield f"| {name}, RangeNet of {WORD} | {cells((i, classify(network, i)) for i in images)} |"
    for name, images in sets.items() if args.by_class else ():
        yield by_class(name, ((i, answered(model, i)) for i in images))
    yield from ("", "| at least so sure | kept | right |", "|---|---:|---:|") if args.least else ()
    for name, images in sets.items():
        yield from (f"| {name}, {least:g} | {sure_cells(model, images, least)} |" for least in args.least)


def inside(model: CascadeModel, count: int, others: dict[str, list[RangeImage]]) -> Iterator[str]:
    """Lines of a Markdown table: of each class in buildings, how many of its returns get it, and IoU; and how many
    scans of each kind are taken for the inside of a building."""
    floor, counts, taken = CLASS_NUMBER["other-ground"], np.zeros((20, 20), np.int64), []
    wide, low = (VirtualStreets(any_sensor.HELD_OUT, POSES * count, drawn=drawn) for drawn in (None, draw_robot))
    sets = {
        f"{count} buildings": any_sensor.buildings(count),
        f"{count} streets": [wide.image(POSES * k) for k in range(count)],
        f"{count} streets by robots": [low.image(POSES * k) for k in range(count)],
    }
    for name, images in (sets | others).items():
        answers = [answered(model.into(image.sensor).with_labels(), image).label for image in images]
        taken.append((name, sum(bool((label == floor).any()) for label in answers if label is not None), len(images)))
        for image, label in zip(images, answers, strict=True) if len(taken) == 1 else ():
            assert image.label is not None and label is not None
            np.add.at(counts, (image.label[image.mask], label[image.mask]), 1)
    yield f"| inside: {100 * np.trace(counts) / counts.sum():.1f} % right | right | IoU |\n|---|---:|---:|"
    iou = np.diag(counts) / np.maximum(counts.sum(0) + counts.sum(1) - np.diag(counts), 1)
    for k in np.flatnonzero(counts.sum(1)):
        word = "furniture: none" if k == 0 else CLASSES[k][0]
        yield f"| {word} | {100 * counts[k, k] / counts[k].sum():.1f} % | {iou[k]:.2f} |"
    yield "; ".join(f"{name}: {found} of {total} taken for the inside of a building" for name, found, total in taken)


def sure_cells(model: ScanModel, images: Sequence[RangeImage], least: float) -> str:
    """Two cells: how many labelled pixels keep a class of so much confidence, and how many of these are right."""
    assert isinstance(model, CascadeModel) and model.network.classes is not None
    network, (first, *_) = model.network.classes, images
    answers = named(network, images, response_of(first, first.mask), first.sensor, least=least)
    counts = counted(zip(images, answers, strict=True))[1:]
    kept = counts[:, 1:].sum()
    return f"{100 * kept / counts.sum():.1f} % | {100 * np.trace(counts[:, 1:]) / max(kept, 1):.1f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generated", type=int, default=0, help="how many scans")
    parser.add_argument("--streets", type=int, default=0, help="how many scans")
    parser.add_argument("--real", type=Path, nargs="+", default=[], help="folders of labelled scans")
    parser.add_argument("--inside", type=int, default=0, help="how many scans")
    parser.add_argument("--model", default="default")
    parser.add_argument("--by-class", action="store_true")
    parser.add_argument("--least", type=float, nargs="+", default=[])
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model).into(SENSOR).with_labels()
    for line in rows(model, args):
        print(line, flush=True)
    if args.inside:
        assert isinstance(model, CascadeModel)
        others = {f"{args.streets} of KITTI's sensor": list(streets(HELD_OUT, args.streets))} if args.streets else {}
        for line in inside(model, args.inside, others | {folder.name: labelled(folder) for folder in args.real}):
            print(line, flush=True)


if __name__ == "__main__":
    main()
