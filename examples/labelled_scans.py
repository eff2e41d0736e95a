"""Scans in the colours of their classes, two side by side: `python labelled_scans.py OUT.png SCAN SCAN [...]`."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.lidar.columns import usual_at_most
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import label_strip, save_png
from lidarsynth.verbs.completion import named_sensor

WIDTH, HEIGHT = 800, 150  # pixels of a strip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", metavar="OUT.png")
    parser.add_argument("paths", nargs="+", type=Path, metavar="SCAN")
    parser.add_argument("--sensor", help="of all scans, a word or a .toml file")
    args = parser.parse_args()
    if len(args.paths) % 2:
        parser.error(f"expected pairs of scans, found {len(args.paths)}")
    model, rows = ls.load("default"), []

    def named(path: Path) -> RangeImage:
        scan = ls.read(path)
        sensor = named_sensor(scan, path, "--sensor", args.sensor)
        return replace(model.named(scan, sensor if args.sensor else usual_at_most(sensor)), completed=None)

    for pair in zip(args.paths[::2], args.paths[1::2], strict=True):
        images = [named(path) for path in pair]
        strips = [label_strip(image, row_scale=1) for image in images]
        even = [s[np.arange(HEIGHT) * len(s) // HEIGHT][:, np.arange(WIDTH) * s.shape[1] // WIDTH] for s in strips]
        names = [f"{path.name}, {image.sensor.name}" for path, image in zip(pair, images, strict=True)]
        rows.append(list(zip(names, even, strict=True)))
        rows.append([("", perspective(image, size=(WIDTH, WIDTH * 9 // 16), by="label")) for image in images])
    save_png(args.target, panel(rows))
    print(f"wrote {args.target}")


if __name__ == "__main__":
    answer(main)
