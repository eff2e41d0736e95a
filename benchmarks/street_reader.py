"""How well a wider network of streets reads real scans: from scratch, then on real scans that it labels itself.

python benchmarks/street_reader.py --keep reader.pt --minutes 60 --judge FOLDER...
python benchmarks/street_reader.py --keep reader.pt --minutes 0 --unlabelled FOLDER --more 40 --judge FOLDER...

The first teaches a RangeNet-21 of width 16, told `street_geometry.py`, streets as recorded on many days, one made anew
every second step: cross-entropy and the Lovasz-softmax (Berman et al. 2018), which counts rare classes as much as
others, in bfloat16 where the processor multiplies it itself. `--keep` writes the weights, and goes on from them. The
second learns from real scans too, of which nobody has told it the classes (`--unlabelled`, KITTI's .bin): the average
of its weights says them, the surer half of each class is believed, and real and synthetic scans are mixed in bands of
beams (LaserMix, Kong et al. 2023) and in arcs (PolarMix, Xiao et al. 2022). No real label is learned from.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from street_classes import Sample, average_in, balance, cuts, judged, opposite, unlabelled, varied
from street_network import Reader
from torch import Tensor, nn

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.systems.cascade.scores import lovasz
from lidarsynth.systems.precision import resolved_precision
from lidarsynth.systems.segmentation.adaptation import adapted
from lidarsynth.systems.segmentation.training import pixels

WIDTH, POOL, IMAGES, JUDGED = 16, 1200, 3, 12_000  # JUDGED: pixels of a batch that the Lovasz-softmax sees
RATE, LATER, KEPT = 3e-3, 8e-4, 0.99  # learning rates of both parts; share of the former average that a step keeps
BELIEVED, ANEW = 0.5, 400  # of each class's pixels, the surest; steps after which a network labels anew
Parts = list[tuple[Tensor, np.ndarray]]  # inputs (1, C, H, W) and classes (H, W), 0 where nobody knows


def streets_of(seed: int) -> Iterator[Sequence[RangeImage]]:
    """A pool of streets for every step, of which every second step makes one anew."""
    stream, rng = varied(seed, 1 << 40), np.random.default_rng(seed)
    pool = [next(stream) for _ in range(POOL)]
    for step in range(1 << 40):
        if step % 2:
            pool[rng.integers(POOL)] = next(stream)
        yield pool


def synthetic(reader: Reader, pool: Sequence[RangeImage], rng: np.random.Generator) -> Parts:
    """IMAGES whole scans of the pool, turned, mirrored and thinned."""
    drawn = (cuts(pool[k], rng) for k in rng.integers(len(pool), size=IMAGES))
    return [(reader.prepared(values[None]), label) for values, label in drawn]


def halves(parts: Parts, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """(2 n, C, H, 256) and (2 n, H, 256): of each of n scans two opposite cuts."""
    inputs, labels = [], []
    for part in parts:
        for x, classes in opposite(*part, rng):
            inputs.append(x)
            labels.append(classes)
    return torch.cat(inputs), torch.stack(labels)


def mixed(real: tuple[Tensor, np.ndarray], other: tuple[Tensor, np.ndarray], rng: np.random.Generator) -> tuple:
    """Bands of beams, or an arc, of one scan in the other, or the real one as it is."""
    (height, width), kind = real[1].shape, rng.random()
    if kind < 0.3:
        return real
    if kind < 0.7:
        edges = np.sort(rng.choice(np.arange(4, height - 4), int(rng.integers(1, 6)), replace=False))
        taken = (np.searchsorted(edges, np.arange(height), "right") % 2 == rng.integers(2))[:, None]
    else:
        arc = (rng.integers(width) + np.arange(rng.integers(width // 4, 3 * width // 4))) % width
        taken = np.isin(np.arange(width), arc)[None]
    x = torch.where(torch.from_numpy(np.broadcast_to(taken, (height, width)).copy()), real[0], other[0])
    return x, np.where(taken, real[1], other[1])


@torch.no_grad()
def named(teacher: Reader, scans: Sequence[RangeImage]) -> list[Sample]:
    """The scans, and what a network that has seen them without labels takes their surest pixels for."""
    teacher = adapted(teacher, teacher.inputs(scans))
    said, sure = [], []
    for x in teacher.inputs(scans, 1):
        chances = teacher(x)[0, 1:].softmax(0)
        sure.append(chances.max(0).values.numpy())
        said.append(np.where(x[0, 0].numpy() != 0, chances.argmax(0).numpy() + 1, 0))
    every, surety = np.stack(said), np.stack(sure)
    for k in range(1, len(CLASSES)):
        own = every == k
        if own.any():
            every[own & (surety < min(0.9, float(np.quantile(surety[own], 1 - BELIEVED))))] = 0
    return [(pixels(scan), label) for scan, label in zip(scans, every, strict=True)]


def real_parts(reader: Reader, scans: list[Sample], rng: np.random.Generator) -> Parts:
    """IMAGES of the scans with the classes they were given, half of them mirrored, answering a little otherwise."""
    parts = []
    for k in rng.integers(len(scans), size=IMAGES):
        values, label = scans[k][0].copy(), scans[k][1]
        values[4] = np.clip(values[4] * rng.uniform(0.9, 1.1), 0, 0.99)
        if rng.random() < 0.5:
            values, label = values[:, :, ::-1].copy(), label[:, ::-1]
            values[2] *= -1
        parts.append((reader.prepared(values[None]), label))
    return parts


def taught(
    reader: Reader, seed: int, minutes: float, rate: float, scans: Sequence[RangeImage] = (), kept: Path | None = None
) -> Reader:
    """The average of the weights over the last steps, after that many minutes; `kept` is written every five."""
    network, rng, reader = reader, np.random.default_rng(seed), copy.deepcopy(reader).train()
    pools, bf16 = streets_of(seed), resolved_precision("auto", torch.device("cpu")) == "bf16"
    optimizer, weights = torch.optim.AdamW(reader.parameters(), rate, weight_decay=1e-3), balance(next(pools)[::5])
    start, said = time.monotonic(), 0.0
    told: list[Sample] = []
    for step, pool in enumerate(pools):
        spent = (time.monotonic() - start) / 60
        if spent >= minutes:
            print(f"{step} steps", flush=True)
            break
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1, (step + 1) / 100) * (0.51 + 0.49 * np.cos(np.pi * spent / minutes))
        parts = synthetic(reader, pool, rng)
        if scans:
            told = named(network, scans) if step % ANEW == 0 else told
            pairs = zip(real_parts(reader, told, rng), parts, strict=True)
            parts = parts[:1] + [mixed(real, other, rng) for real, other in pairs]
        x, label = halves(parts, rng)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            logits = reader(x)
        logits = logits.float()
        losses = nn.functional.cross_entropy(logits, label, weights, ignore_index=0, reduction="none")
        flat, classes = logits.permute(0, 2, 3, 1).flatten(0, 2), label.flatten()
        some = torch.from_numpy(rng.integers(len(classes), size=JUDGED))
        some = some[classes[some] > 0]
        optimizer.zero_grad()
        (losses.sum() / (label > 0).sum() + lovasz(flat[some], classes[some])).backward()
        nn.utils.clip_grad_norm_(reader.parameters(), 2.0)
        optimizer.step()
        average_in(network, reader, KEPT)
        if kept and spent - said > 5:
            said = spent
            torch.save(network.state_dict(), kept)
    return network.eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60, help="with streets alone")
    parser.add_argument("--more", type=float, default=40, help="with the unlabelled scans too")
    parser.add_argument("--seed", type=int, default=33, help="of the streets")
    parser.add_argument("--keep", type=Path, help="weights to go on from, and to write")
    parser.add_argument("--judge", type=Path, nargs="+", default=[])
    parser.add_argument("--unlabelled", type=Path, help="folder of KITTI's .bin files")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    reader = Reader(True, WIDTH).eval()
    if args.keep and args.keep.exists():
        reader.load_state_dict(torch.load(args.keep, weights_only=True))
    if args.minutes:
        reader = taught(reader, args.seed, args.minutes, RATE, kept=args.keep)
    if args.unlabelled:
        scans = unlabelled(args.unlabelled, 1)
        if args.more:
            reader = taught(reader, args.seed + 1, args.more, LATER, scans, args.keep)
    if args.keep:
        torch.save(reader.state_dict(), args.keep)
    print(judged(reader, args.judge), flush=True)
    if args.unlabelled:
        reader = adapted(reader, reader.inputs(scans))
        print("with the statistics of the unlabelled scans:", judged(reader, args.judge), flush=True)


if __name__ == "__main__":
    main()
