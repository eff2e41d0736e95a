"""Keep every fourth beam of a scan file: `python thin_beams.py SCAN OUT [EVERY]`, in the rays of the scan's sensor."""

import argparse
from pathlib import Path

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.verbs.completion import named_sensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SCAN")
    parser.add_argument("target", type=Path, metavar="OUT")
    parser.add_argument("every", nargs="?", default="4", metavar="EVERY")
    parser.add_argument("--sensor", help="a word or a .toml file")
    args = parser.parse_args()
    scan = ls.read(args.source)
    image = ls.project(scan, named_sensor(scan, args.source, "--sensor", args.sensor))
    sparse = image.keep(ls.corrupt(image, f"beams:{args.every}"))
    ls.write(args.target, sparse.to_scan())
    print(f"wrote {args.target}: {sparse.mask.sum()} of {image.mask.sum()} points of {image.sensor.name}")


if __name__ == "__main__":
    answer(main)
