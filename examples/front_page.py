"""The picture of the README's first screen: `python front_page.py OUT.png SCAN SCAN`, each scan in its own sensor."""

import sys

import lidarsynth as ls
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import range_strip, save_png

target, *sources = sys.argv[1:]
model = ls.load("default")

rows = []
for source in sources:
    scan = ls.read(source)
    own = model.suited_to(scan)
    truth = own.image_of(scan)
    known = ls.corrupt(truth, "beams:4")
    sparse = truth.keep(known)
    dense = own.complete(sparse, known)
    shown = {
        f"{truth.shape[0] // 4} beams of a real {own.sensor.name}, measured": sparse,
        f"{truth.shape[0]} beams, completed": dense,
    }
    rows.append([(caption, perspective(image, size=(800, 450))) for caption, image in shown.items()])
    rows.append([("", range_strip(image)) for image in shown.values()])
save_png(target, panel(rows, width=1640))
