"""Is a new point as often right as its confidence says? Right: its ray returns, within 0.3 m + 2 % of its range.

python benchmarks/confidence.py                          on streets that nothing was trained or fitted on
python benchmarks/confidence.py SCANS --corrupt beams:4  on scans of your own; --sensor, where it is not recognised
python benchmarks/confidence.py --fit FOLDER             fit the confidences of a cascade, and keep them in FOLDER
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarsynth.cli.terminal import answer
from lidarsynth.data.folder import scan_files
from lidarsynth.experiment.record import RECORD
from lidarsynth.files.formats import read
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.systems.cascade.calibration import calibrated, held_out, judged, with_confidence
from lidarsynth.systems.cascade.confidence import reliability
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.verbs.completion import named_sensor
from lidarsynth.weights.load import load


def scans_of(
    paths: list[Path], model: CascadeModel, recipe: str, sensor: str | None = None
) -> Iterator[tuple[RangeImage, str]]:
    """Each scan in the rays of its sensor, None = as recognised, and what is to be hidden of it."""
    for file in [file for path in paths for file in (scan_files(path) if path.is_dir() else [path])]:
        scan = read(file)
        own = model.into(named_sensor(scan, file, "--sensor", sensor, model.sensor)) if model.own else model
        yield own.image_of(scan), recipe


def table(stated: np.ndarray, right: np.ndarray, off: np.ndarray, bins: int) -> str:
    """Rows by confidence, and what dropping the least sure points leaves."""
    place = np.minimum((stated * bins).astype(int), bins - 1)
    rows = ["| confidence | share of new points | said | right | median off |", "|---|---|---|---|---|"]
    for k, (low, high, share, said, hits) in enumerate(reliability(stated, right, bins)):
        median = f"{np.median(off[place == k]):.2f} m" if share else ""
        rows.append(f"| {low:.1f} to {high:.1f} | {share:.1%} | {said:.2f} | {hits:.2f} | {median} |")
    apart = sum(share * abs(said - hits) for _, _, share, said, hits in reliability(stated, right, bins) if share)
    rows += [
        "",
        f"{len(stated):,} new points, {right.mean():.1%} right; said and right are {apart:.3f} apart on average",
    ]
    for least in (0.5, 0.8, 0.9):
        kept = stated >= least
        rows.append(f"of {least} or more: {kept.mean():.1%} of the points, {right[kept].mean():.1%} of them right")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path)
    parser.add_argument("--model", default="default")
    parser.add_argument("--corrupt", default="beams:4")
    parser.add_argument("--sensor", help="of the scans, a word or a .toml file")
    parser.add_argument("--fit", type=Path, metavar="FOLDER")
    parser.add_argument("--streets", type=int, default=26)
    parser.add_argument("--bins", type=int, default=10)
    args = parser.parse_args()
    model = load(str(args.fit) if args.fit else args.model)
    if not isinstance(model, CascadeModel):
        parser.error(f"{args.model}: expected a cascade, such as default, found {model.kind}")
    if args.fit:
        weights = calibrated(model, count=2 * args.streets)
        model = with_confidence(model, weights)
        (args.fit / RECORD).write_text(json.dumps(model.experiment.to_dict(), indent=1) + "\n")
        print(f"{weights}\nwrote {args.fit / RECORD}\n")
    pairs = scans_of(args.scans, model, args.corrupt, args.sensor) if args.scans else held_out(515152, args.streets)
    print(table(*judged(model, pairs), args.bins))


if __name__ == "__main__":
    answer(main)
