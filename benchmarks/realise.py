"""How real `realise` makes perfect scans: which rays it drops, how bright the others are, what street-1 says of them.

python benchmarks/realise.py --streets 64 [--sensor hdl-64e-kitti] [--model default]     held-out worlds, cast perfectly
python benchmarks/realise.py --real FOLDER [--model default]           real scans of HDL-64E, their holes closed first

The perfect scan of a street is what its rays meet; that of a real scan has, in holes below or between returns, surfaces
as far as the fill of the same model says (`observing.closed`). Both are judged against what the sensor really reported.
Beside it: nothing dropped, as many rays dropped at random, and in each beam as many as the truth drops there (cf. the
frequency maps of DUSty v2), and with --inversion what a GAN drops whose image is that scan (DUSty v2, WACV 2023); these
get the mean reflectance of the truth. --picture draws the first three.
Columns:

dropped          share of the perfect scan's rays that do not return
beam, range, class   mean absolute difference of that share, per beam, per range bin, per class, in percentage points
same             share of the dropped rays that the truth drops too
MAE              of reflectance, where both return
histogram        Wasserstein-1 distance of the reflectances' distributions
FRD              of street-1, for images of 64 x 1024, against other held-out streets, or the real scans themselves
read             pixels of its points that street-1's RangeNet, which learned on streets, gives their class
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from street import HELD_OUT, SEED, WORD, Judge

from lidarsynth.evaluation.accumulation import load_networks
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.files.formats import read
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import reflectance_strip, save_png
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.observing import closed
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.segmentation.training import confusion
from lidarsynth.weights.load import load, load_parts

SHOWN = 3  # scans of a picture
BINS = np.array([0, 5, 10, 20, 30, 50, 80, 200])  # metres
Pair = tuple[RangeImage, RangeImage]  # perfect, as the sensor reported it


def street_pairs(sensor: Sensor, count: int) -> Iterator[Pair]:
    """Each from a held-out world of its own."""
    streets = SyntheticStreets(SEED, 1 << 40, sensor, apart=True)
    return (streets.pair(HELD_OUT + k) for k in range(count))


def real_pairs(folder: Path, sensor: Sensor, model: ScanModel) -> Iterator[Pair]:
    """Real scans of the sensor, their holes closed where something must be."""
    network = model.network
    assert isinstance(network, Cascade)
    for path in sorted([*folder.glob("*.bin"), *folder.glob("*.npz")]):
        seen = real_image(path, sensor)
        if seen is not None:
            yield closed(network.surest, seen), replace(seen, xyz=None)


def real_image(path: Path, sensor: Sensor) -> RangeImage | None:
    """A scan file, or stored range, reflectance and xyz, of the sensor's beams; None for others."""
    if path.suffix == ".bin":
        scan = read(path)
        return project(scan, sensor, "unfolding") if len(scan) > 80_000 else None
    with np.load(path) as file:
        values = {name: file[name] for name in ("range", "reflectance") if name in file}
    fits = len(values) == 2 and values["range"].shape == (sensor.height, sensor.width)
    return RangeImage(**values, mask=values["range"] > 0, sensor=sensor) if fits else None


def made(pairs: Sequence[Pair], model: ScanModel, gan: GanModel | None = None) -> dict[str, list[RangeImage]]:
    """The images of each method."""
    perfect = [p for p, _ in pairs]
    lost = 1 - np.mean([s.mask[p.mask].mean() for p, s in pairs])
    mean = float(np.mean([s.reflectance[s.mask].mean() for _, s in pairs]))
    lit = [replace(p, reflectance=(mean * p.mask).astype(np.float32)) for p in perfect]
    thinned = [p.keep(np.random.default_rng(k).random(p.shape) >= lost) for k, p in enumerate(lit)]
    rays = sum(p.mask.sum(1) for p in perfect)
    kept = sum((p.mask & s.mask).sum(1) for p, s in pairs) / np.maximum(rays, 1)
    beams = [p.keep(np.random.default_rng(k).random(p.shape) < kept[:, None]) for k, p in enumerate(lit)]
    real = [model.realised(p.to_scan(), p.sensor, seed=k) for k, p in enumerate(perfect)]
    real = [replace(r, completed=None, xyz=None) for r in real]
    inverted = {} if gan is None else {
        f"{gan.experiment.name}, inverted": [p.keep(gan.returned(p, seed=k)) for k, p in enumerate(lit)]
    }  # fmt: skip
    return {
        "nothing dropped": lit,
        "as many at random": thinned,
        "as many in each beam": beams,
        **inverted,
        "realised": real,
        "as the sensor saw it": [s for _, s in pairs],
    }


def row(images: Sequence[RangeImage], pairs: Sequence[Pair]) -> list[str]:
    """Cells of the numbers that need no network."""
    gone = np.concatenate([(p.mask & ~i.mask)[p.mask] for i, (p, _) in zip(images, pairs, strict=True)])
    truly = np.concatenate([(p.mask & ~s.mask)[p.mask] for p, s in pairs])
    beam = np.concatenate([np.nonzero(p.mask)[0] for p, _ in pairs])
    far = np.concatenate([np.digitize(p.range[p.mask], BINS) for p, _ in pairs])
    kinds = [beam, far]
    if all(p.label is not None for p, _ in pairs):
        kinds.append(np.concatenate([p.label[p.mask] for p, _ in pairs if p.label is not None]))
    apart = [f"{100 * spread(gone, truly, kind):.1f}" for kind in kinds] + ["-"] * (3 - len(kinds))
    both = [(i.reflectance[m], s.reflectance[m]) for i, (_, s) in zip(images, pairs, strict=True)
            for m in [i.mask & s.mask]]  # fmt: skip
    error = np.abs(np.concatenate([a - b for a, b in both])).mean()
    quantiles = np.linspace(0, 1, 1001)
    ours, theirs = (np.quantile(np.concatenate([i.reflectance[i.mask] for i in of]), quantiles)
                    for of in (images, [s for _, s in pairs]))  # fmt: skip
    same = f"{100 * truly[gone].mean():.0f}" if gone.any() else "-"
    return [f"{100 * gone.mean():.1f}", *apart, same, f"{error:.3f}", f"{np.abs(ours - theirs).mean():.3f}"]


def spread(gone: np.ndarray, truly: np.ndarray, kind: np.ndarray) -> float:
    """Mean absolute difference of two shares over the kinds that hold a thousandth of all."""
    count = np.bincount(kind)
    ours, theirs = (np.bincount(kind, values) / np.maximum(count, 1) for values in (gone, truly))
    return float(np.abs(ours - theirs)[count > 1e-3 * len(kind)].mean())


def frechet(judge: Judge, images: Sequence[RangeImage], reference: Sequence[RangeImage]) -> float:
    """FRD of street-1."""
    scores = judge.scores(judge.gather(images), judge.gather(reference, "real"))
    value = next(score.value for score in scores if score.name == "FRD")
    assert value is not None
    return value


def right(network: RangeNet, images: Sequence[RangeImage]) -> float:
    counts = confusion(network, images)[1:]
    return float(np.trace(counts[:, 1:]) / counts.sum())


def table(
    pairs: Sequence[Pair], model: ScanModel, others: Sequence[RangeImage], gan: GanModel | None = None
) -> Iterator[str]:
    """Lines of a Markdown table, as they are computed."""
    yield "| | dropped, % | beam | range | class | same, % | MAE | histogram | FRD | read, % |"
    yield "|---|" + "---:|" * 9
    network = load_parts(WORD)[1]
    assert isinstance(network, RangeNet)
    protocol, plain = get_protocol(WORD), pairs[0][0].shape == (64, 1024)
    several = len(pairs) > 1  # one scan has no covariance
    judge = Judge(protocol, load_networks(protocol, 1024)) if plain and several else None
    for name, images in made(pairs, model, gan).items():
        distance = "-" if judge is None else f"{frechet(judge, images, others):.2f}"
        labelled = plain and all(image.label is not None for image in images)
        share = f"{100 * right(network, images):.1f}" if labelled else "-"
        yield f"| {name} | {' | '.join(row(images, pairs))} | {distance} | {share} |"


def picture(pairs: Sequence[Pair], model: ScanModel) -> np.ndarray:
    """(H', W', 3) uint8: reflectances that the sensor measured, and those realised, of the first scans."""
    rows = []
    for k, (perfect, seen) in enumerate(pairs[:SHOWN]):
        real = model.realised(perfect.to_scan(), perfect.sensor, seed=k)
        rows += [[("as the sensor saw it", reflectance_strip(seen))]]
        rows += [[(f"realised from its surfaces by {model.experiment.name}", reflectance_strip(real))]]
    return panel(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streets", type=int, default=0, help="how many")
    parser.add_argument("--real", type=Path, help="a folder of KITTI's .bin files or labelled .npz images")
    parser.add_argument("--sensor", default="hdl-64e-kitti")
    parser.add_argument("--model", default="default")
    parser.add_argument("--picture", type=Path, help="a .png to write instead of the table")
    parser.add_argument("--inversion", help="a GAN beside it: DUSty v2, trained on scans of the sensor")
    args = parser.parse_args()
    if args.streets < 1 and args.real is None:
        parser.error("expected --streets COUNT or --real FOLDER, found neither")
    torch.set_num_threads(1)
    sensor = get_sensor(args.sensor)
    model = load(args.model).into(sensor)
    if args.real:
        pairs = list(real_pairs(args.real, sensor, model))
        others = [seen for _, seen in pairs]
    else:
        pairs = list(street_pairs(sensor, args.streets))
        others = [SyntheticStreets(SEED, 1 << 40, sensor, apart=True).image(k) for k in range(args.streets)]
    if args.picture:
        print(save_png(args.picture, picture(pairs, model)))
        return
    gan = None if args.inversion is None else load(args.inversion).into(sensor)
    if not (gan is None or isinstance(gan, GanModel)):
        raise SystemExit(f"{args.inversion}: expected a GAN, found {gan.experiment.model.network}")
    print(f"{len(pairs)} scans of {sensor.name}, {args.model}\n")
    for line in table(pairs, model, others, gan):
        print(line, flush=True)


if __name__ == "__main__":
    main()
