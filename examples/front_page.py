"""The README's pictures of scans, each in its own sensor:
`python front_page.py OUT SCAN SCAN [--without traffic | --insert car:2]`."""

import argparse
from pathlib import Path

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import range_strip, save_png
from lidarsynth.verbs.completion import named_sensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path, metavar="OUT.png")
    parser.add_argument("sources", nargs="+", type=Path, metavar="SCAN")
    parser.add_argument("--sensor", help="of all scans, a word or a .toml file")
    parser.add_argument("--without", metavar="CLASSES", help="draw the scans, and the same without these, instead")
    parser.add_argument("--seed", type=int, default=0, help="of what is inserted")
    parser.add_argument("--insert", metavar="THINGS", help="draw the scans, and the same with these, instead")
    args = parser.parse_args()
    model = ls.load("default")
    rows = []
    for source in args.sources:
        scan = ls.read(source)
        own = model.into(named_sensor(scan, source, "--sensor", args.sensor))
        truth = own.image_of(scan)
        if args.without:
            empty = own.complete(scan, without=args.without)
            shown = {f"a real {own.sensor.name}": truth, f"without {args.without}": empty}
        elif args.insert:
            found = model.into(own.sensor).insert(scan, args.insert, seed=args.seed).scan
            shown = {f"a real {own.sensor.name}": truth, f"with {args.insert}": own.image_of(found)}
        else:
            known = ls.corrupt(truth, "beams:4")
            sparse = truth.keep(known)
            dense = own.complete(sparse, known)
            shown = {
                f"{truth.shape[0] // 4} beams of a real {own.sensor.name}, measured": sparse,
                f"{truth.shape[0]} beams, completed": dense,
            }
        rows.append([(caption, perspective(image, size=(800, 450))) for caption, image in shown.items()])
        rows.append([("", range_strip(image)) for image in shown.values()])
    save_png(args.target, panel(rows, width=1640))


if __name__ == "__main__":
    answer(main)
