"""Synthetic streets: how fast, and how close to real KITTI scans.

python benchmarks/synthetic.py                                        scans per second and core, worlds included
python benchmarks/synthetic.py --compare SCANS                        tables of numbers beside real scans
python benchmarks/synthetic.py --compare SCANS --pictures docs/images                the pictures as well
python benchmarks/synthetic.py --sample src/lidarsynth/shipped/street.npz            the scan of the demo
"""

from __future__ import annotations

import argparse
import lzma
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidarsynth.files.formats import write
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.sharpness import Sharpness
from lidarsynth.pictures.colours import label_colours
from lidarsynth.pictures.figure import compare as figure
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import bev as bev_picture
from lidarsynth.pictures.render import label_strip, range_strip, save_png
from lidarsynth.streets.reader import SyntheticStreets

SENSOR = SENSORS["hdl-64e-kitti"]
PER_WORLD = 16
BANDS = ((0, 8), (8, 16), (16, 32), (32, 48), (48, 64))  # beams, from the top
SHOWN = (14, 60, 84)  # real scans of the pictures: numbers in train/


def read_kitti(path: Path) -> Scan:
    """A `.bin`, or a `.scan.xz`: the count, then steps of x, y and z in millimetres, as int32, and reflectances."""
    if path.suffix == ".bin":
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        return Scan(points[:, :3], points[:, 3])
    raw = lzma.decompress(path.read_bytes())
    count = int(np.frombuffer(raw, "<i4", 1)[0])
    steps = np.frombuffer(raw, "<i4", 3 * count, 4).reshape(3, count)
    xyz = (np.cumsum(steps, axis=1, dtype=np.int32).T / 1000).astype(np.float32)
    return Scan(xyz, np.frombuffer(raw, np.uint8, count, 4 + 12 * count).astype(np.float32) / 100)


def real_images(folder: Path) -> list[RangeImage]:
    """Every training scan, projected by scan unfolding. Raises ValueError where there is none."""
    files = sorted((folder / "train").glob("*.scan.xz")) or sorted((folder / "train").glob("*.bin"))
    if not files:
        raise ValueError(f"expected {folder}/train/*.scan.xz or *.bin, found none")
    return [project(read_kitti(path), SENSOR, "unfolding") for path in files]


def synthetic_images(count: int, seed: int) -> list[RangeImage]:
    """Two scans of each world, so that many worlds are seen."""
    reader = SyntheticStreets(seed=seed, length=PER_WORLD * count)
    return [reader.image(PER_WORLD * (k // 2) + PER_WORLD // 2 * (k % 2) + 1) for k in range(count)]


def bird_eye(images: list[RangeImage]) -> np.ndarray:
    """(100, 100) points per 1.6 m cell over 160 m, 3 to 70 m away, all scans pooled (as metrics/ does)."""
    counts = np.zeros((100, 100))
    for image in images:
        xyz = image.points()[(image.range > 3) & (image.range < 70)]
        counts += np.histogram2d(xyz[:, 0], xyz[:, 1], bins=100, range=[[-80, 80], [-80, 80]])[0]
    return counts


def steps(images: list[RangeImage], kind: str) -> np.ndarray:
    """(40,) histogram of |ln r - ln r'| between measured neighbours: `along` a ring, or `down` from beam to beam."""
    sharpness = Sharpness()
    for image in images:
        sharpness.update(image)
    return sharpness.counts[kind]


def ranges(images: list[RangeImage]) -> np.ndarray:
    """(64, 41) per beam: counts over 40 logarithmic bins of 2 to 80 m, and of empty pixels in the last column."""
    stack = np.stack([image.range for image in images], axis=1)
    edges = np.geomspace(2, 80, 41)
    return np.array([[*np.histogram(row, bins=edges)[0], (row == 0).sum()] for row in stack], float)


def reflectances(images: list[RangeImage]) -> np.ndarray:
    """(64, 50) per beam: counts of reflectance in steps of 0.02."""
    edges = np.linspace(-0.005, 0.995, 51)
    rows = zip(np.stack([im.reflectance for im in images], 1), np.stack([im.mask for im in images], 1), strict=True)
    return np.array([np.histogram(value[mask], bins=edges)[0] for value, mask in rows], float)


MEASURES: dict[str, Callable[[list[RangeImage]], np.ndarray]] = {
    "range and empty pixels, per beam": ranges,
    "reflectance, all": lambda images: reflectances(images).sum(axis=0),
    "reflectance, per beam": reflectances,
    "bird's-eye view": bird_eye,
    "range steps along a ring": lambda images: steps(images, "along"),
    "range steps from beam to beam": lambda images: steps(images, "down"),
}


def jensen_shannon(p: np.ndarray, q: np.ndarray) -> float:
    """Jensen-Shannon divergence of two histograms, natural logarithm: 0 equal, 0.69 disjoint."""
    p, q = p.ravel() / p.sum(), q.ravel() / q.sum()
    m = (p + q) / 2
    return float(sum((a[a > 0] * np.log(a[a > 0] / m[a > 0])).sum() for a in (p, q)) / 2)


def divergences(real: list[RangeImage], synthetic: list[RangeImage]) -> list[str]:
    """Lines of a Markdown table; first what real scans differ among themselves, from one half of them to the other."""
    half = len(real) // 2
    lines = ["| Jensen-Shannon divergence | real: one half, other half | real, synthetic |", "|---|---|---|"]
    for name, measure in MEASURES.items():
        cells = [jensen_shannon(measure(a), measure(b)) for a, b in ((real[:half], real[half:]), (real, synthetic))]
        lines.append(f"| {name} | {cells[0]:.4f} | {cells[1]:.4f} |")
    return lines


def quantiles(real: list[RangeImage], synthetic: list[RangeImage]) -> list[str]:
    """Lines of a Markdown table: filled pixels and quantiles of range and reflectance per band of beams."""
    lines = ["| beams | number | real | synthetic |", "|---|---|---|---|"]
    for low, high in ((0, 64), *BANDS):
        cells: dict[str, list[str]] = {}
        for images in (real, synthetic):
            mask = np.stack([im.mask[low:high] for im in images])
            cells.setdefault("filled", []).append(f"{mask.mean():.3f}")
            for name, digits in (("range", 1), ("reflectance", 2)):
                values = np.stack([getattr(im, name)[low:high] for im in images])[mask]
                text = " ".join(f"{q:.{digits}f}" for q in np.percentile(values, [5, 25, 50, 75, 95]))
                cells.setdefault(f"{name}, 5 25 50 75 95 %", []).append(text)
        lines += [f"| {low}-{high - 1} | {name} | {' | '.join(pair)} |" for name, pair in cells.items()]
    return lines


def drop_rates(real: list[RangeImage], synthetic: list[RangeImage]) -> str:
    """One line: how far apart the shares of empty pixels of each beam are."""
    apart = [np.mean([~im.mask for im in images], axis=(0, 2)) for images in (real, synthetic)]
    gap = np.abs(apart[0] - apart[1])
    return f"Shares of empty pixels per beam: {gap.mean():.3f} apart on average, {gap.max():.3f} at most."


def pictures(real: list[RangeImage], seed: int, folder: Path) -> list[Path]:
    """Strips and bird's-eye views of real scans beside synthetic ones, and one synthetic scan by class."""
    chosen = [real[k] for k in SHOWN]
    made = [SyntheticStreets(seed, PER_WORLD * 40).image(PER_WORLD * k + 5) for k in (2, 5, 9)]
    note = ", KITTI, CC BY-NC-SA 3.0"
    strips = {}
    for k, (a, b) in enumerate(zip(chosen, made, strict=True)):
        strips |= {f"real {k + 1}{note}": a, f"synthetic {k + 1}": b}
    views = [[(f"real {k + 1}{note}", bev_picture(im, size=400)) for k, im in enumerate(chosen)],
             [(f"synthetic {k + 1}", bev_picture(im, size=400)) for k, im in enumerate(made)]]  # fmt: skip
    classes = [[("range", range_strip(made[1]))], [("SemanticKITTI class", label_strip(made[1]))], _legend(made[1])]
    return [
        save_png(folder / "synthetic_strips.png", figure(strips, max_range=80)),
        save_png(folder / "synthetic_bev.png", panel(views)),
        save_png(folder / "synthetic_classes.png", panel(classes)),
    ]


def _legend(image: RangeImage) -> list[tuple[str, np.ndarray]]:
    names = list(CLASS_NUMBER)
    assert image.label is not None
    present = np.unique(image.label[image.mask])
    return [(names[k], np.broadcast_to(label_colours(np.array([[k]])), (12, 90, 3)).copy()) for k in present]


def speed(count: int, seed: int) -> str:
    """Processor time of reading in order, the first scan (which loads the library of things) left out."""
    SyntheticStreets(seed=seed).image(0)
    reader = SyntheticStreets(seed=seed + 1, length=count)
    start = time.process_time()
    for index in range(count):
        reader.image(index)
    return f"{count / (time.process_time() - start):.1f} scans of {SENSOR.height} x {SENSOR.width} per second and core"


def sample(path: Path) -> Path:
    """One whole scan, coordinates in steps of 1/256 m so that the file is small."""
    scan = SyntheticStreets(seed=11, length=64)[5]
    xyz = (np.round(scan.xyz * 256) / 256).astype(np.float32)
    write(path, Scan(xyz, scan.reflectance, scan.ring, label=scan.label))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=96, help="how many synthetic scans")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", type=Path, help="folder with train/, the real scans")
    parser.add_argument("--pictures", type=Path, help="folder for PNG files; needs --compare")
    parser.add_argument("--sample", type=Path, help="write the shipped scan here")
    args = parser.parse_args()
    if args.sample:
        print(sample(args.sample))
    elif args.compare:
        real, synthetic = real_images(args.compare), synthetic_images(args.scans, args.seed)
        print(
            "\n".join([*quantiles(real, synthetic), "", *divergences(real, synthetic), "", drop_rates(real, synthetic)])
        )
        if args.pictures:
            print("\n".join(map(str, pictures(real, args.seed, args.pictures))))
    else:
        print(speed(args.scans, args.seed))


if __name__ == "__main__":
    main()
