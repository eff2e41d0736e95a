"""The picture of the README's first screen: `python front_page.py SCAN OUT.png [MODEL]`."""

import sys

import lidarsynth as ls
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import range_strip, save_png

source, target, *name = sys.argv[1:]
model = ls.load(name[0] if name else "default")

truth = model.image_of(ls.read(source))
known = ls.corrupt(truth, "beams:4")
sparse = truth.keep(known)
dense = model.complete(sparse, known)
new = model.generate(2, seed=10)

shown = {"16 beams, measured": sparse, "64 beams, completed": dense, "generated": new[0], "generated ": new[1]}
views = [(caption, perspective(image, size=(800, 450))) for caption, image in shown.items()]
strips = [("", range_strip(image)) for image in shown.values()]
save_png(target, panel([views[:2], strips[:2], views[2:], strips[2:]], width=1640))
