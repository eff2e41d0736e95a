"""Synthetic streets: how fast, and how close to real KITTI scans.

python benchmarks/synthetic.py                              scans per second on one core, world building included
python benchmarks/synthetic.py --compare ../shared/scans    a table of numbers beside the real scans of its train/
python benchmarks/synthetic.py --compare DIR --picture docs/images   the side-by-side pictures as well
"""

from __future__ import annotations

import argparse
import lzma
import time
from pathlib import Path

import numpy as np

from lidarsynth.data.synthetic.reader import SyntheticStreets
from lidarsynth.lidar.sensor import SENSORS

SENSOR = SENSORS["hdl-64e-kitti"]
EXPECTED = "expected DIR/train/*.scan.xz or *.bin"


def read_kitti(path: Path) -> np.ndarray:
    """(N, 4) float32: x, y, z, reflectance of a `.bin`, or of a `.scan.xz` as ../shared/scans/README.md has it."""
    if path.suffix == ".bin":
        return np.fromfile(path, np.float32).reshape(-1, 4)
    raw = lzma.decompress(path.read_bytes())
    count = int(np.frombuffer(raw, "<i4", 1)[0])
    steps = np.frombuffer(raw, "<i4", 3 * count, 4).reshape(3, count)
    points = np.cumsum(steps, axis=1, dtype=np.int32).T / 1000.0
    reflectance = np.frombuffer(raw, np.uint8, count, 4 + 12 * count) / 100.0
    return np.column_stack([points, reflectance]).astype(np.float32)


def unfold(points: np.ndarray, width: int = 1024) -> tuple[np.ndarray, np.ndarray]:
    """Range and reflectance images (64, width) of a KITTI scan, rings from its point order, the nearest return wins."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    ring = np.concatenate([[0], np.cumsum(np.abs(np.diff(azimuth % (2 * np.pi))) > np.pi)])
    column = np.floor((np.pi - azimuth) / (2 * np.pi) * width).astype(int) % width
    distance = np.linalg.norm(points[:, :3], axis=1)
    order = np.argsort(-distance)
    order = order[ring[order] < 64]
    images = np.zeros((2, 64, width), np.float32)
    images[0, ring[order], column[order]] = distance[order]
    images[1, ring[order], column[order]] = points[order, 3]
    return images[0], images[1]


def real_images(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(N, 64, 1024) range and reflectance of every second training scan."""
    files = sorted((folder / "train").glob("*.scan.xz")) or sorted((folder / "train").glob("*.bin"))
    if not files:
        raise SystemExit(f"{EXPECTED}, found nothing in {folder}")
    pairs = [unfold(read_kitti(f)) for f in files[::2]]
    return np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs])


def synthetic_images(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 64, 1024) range and reflectance; two scans of each world, so that many worlds are seen."""
    reader = SyntheticStreets(seed=seed, length=16 * count)
    images = [reader.image(16 * (k // 2) + 8 * (k % 2) + 1) for k in range(count)]
    return np.stack([im.range for im in images]), np.stack([im.reflectance for im in images])


def bev(distance: np.ndarray) -> np.ndarray:
    """(100, 100) share of points per 1.6 m cell over 160 m, 3 to 70 m, all scans pooled (as metrics/ does)."""
    counts = np.zeros((100, 100))
    for image in distance:
        xyz = SENSOR.points(image)[(image > 3) & (image < 70)]
        counts += np.histogram2d(xyz[:, 0], xyz[:, 1], bins=100, range=[[-80, 80], [-80, 80]])[0]
    return counts / counts.sum()


def jensen_shannon(p: np.ndarray, q: np.ndarray) -> float:
    """Jensen-Shannon divergence of two histograms, natural logarithm: 0 equal, 0.69 disjoint."""
    p, q = p.ravel() / p.sum(), q.ravel() / q.sum()
    m = (p + q) / 2
    return float(sum((a[a > 0] * np.log(a[a > 0] / m[a > 0])).sum() for a in (p, q)) / 2)


def steps(distance: np.ndarray, axis: int) -> np.ndarray:
    """Relative range steps |ln r - ln r'| between measured neighbours along an axis (1 down, 2 along a ring)."""
    log = np.log(np.maximum(distance, 1e-3))
    both = (distance > 0) & np.roll(distance > 0, -1, axis)
    step = np.abs(np.roll(log, -1, axis) - log)[both]
    return np.histogram(np.log10(step + 1e-4), bins=40, range=(-4, 1))[0].astype(float)


def range_histograms(distance: np.ndarray) -> np.ndarray:
    """(64, 41) per beam: counts over 40 logarithmic bins of 2 to 80 m, and of empty pixels in the last column."""
    edges = np.geomspace(2, 80, 41)
    rows = [np.append(np.histogram(distance[:, r], bins=edges)[0], (distance[:, r] == 0).sum()) for r in range(64)]
    return np.array(rows, float)


def compare(real: tuple[np.ndarray, np.ndarray], synthetic: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Lines of a Markdown table: the number, on real scans, on synthetic ones."""
    lines = ["| number | real | synthetic |", "|---|---|---|"]
    (r, f), (r2, f2) = real, synthetic
    lines.append(f"| filled pixels | {(r > 0).mean():.3f} | {(r2 > 0).mean():.3f} |")
    for low, high in ((0, 8), (8, 16), (16, 32), (32, 48), (48, 64)):
        band = np.s_[:, low:high]
        for name, a, b in (("range, m", r, r2), ("reflectance", f, f2)):
            cells = []
            for image, mask in ((a, r > 0), (b, r2 > 0)):
                quartiles = np.percentile(image[band][mask[band]], [5, 25, 50, 75, 95])
                cells.append(" ".join(f"{q:.2f}" if name == "reflectance" else f"{q:.1f}" for q in quartiles))
            lines.append(f"| beams {low}-{high - 1}, {name}: 5 25 50 75 95 % | {cells[0]} | {cells[1]} |")
        lines.append(f"| beams {low}-{high - 1}, filled | {(r[band] > 0).mean():.3f} | {(r2[band] > 0).mean():.3f} |")
    return lines + distances(real, synthetic)


def distances(real: tuple[np.ndarray, np.ndarray], synthetic: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Table lines of Jensen-Shannon divergences; `real` column: between the two halves of the real scans."""
    half = len(real[0]) // 2
    groups = [(tuple(a[:half] for a in real), tuple(a[half:] for a in real)), (real, synthetic)]
    bins = np.linspace(-0.005, 0.995, 101)
    measures = {
        "range per beam and empty pixels": lambda a: range_histograms(a[0]),
        "reflectance": lambda a: np.histogram(a[1][a[0] > 0], bins=bins)[0].astype(float),
        "bird's-eye view": lambda a: bev(a[0]),
        "steps along a ring": lambda a: steps(a[0], 2),
        "steps from beam to beam": lambda a: steps(a[0], 1),
    }
    lines = ["| Jensen-Shannon divergence | real, half against half | real against synthetic |", "|---|---|---|"]
    for name, measure in measures.items():
        cells = [f"{jensen_shannon(measure(a), measure(b)):.4f}" for a, b in groups]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return lines


def speed(count: int) -> str:
    """Scans per second of this process, reading in order."""
    reader = SyntheticStreets(seed=1, length=count)
    reader.image(0)
    fresh = SyntheticStreets(seed=2, length=count)
    start = time.process_time()
    for index in range(count):
        fresh.image(index)
    return f"{count / (time.process_time() - start):.1f} scans of {SENSOR.height} x {SENSOR.width} per second"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=48, help="how many synthetic scans")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", type=Path, help="folder with train/, the real scans")
    args = parser.parse_args()
    if args.compare is None:
        print(speed(args.scans))
        return
    print("\n".join(compare(real_images(args.compare), synthetic_images(args.scans, args.seed))))


if __name__ == "__main__":
    main()
