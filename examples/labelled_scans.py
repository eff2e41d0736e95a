"""Scans in the colours of their classes, two side by side: `python labelled_scans.py OUT.png SCAN SCAN [...]`."""

import sys
from dataclasses import replace

import numpy as np

import lidarsynth as ls
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import label_strip, save_png

WIDTH, HEIGHT = 800, 150  # pixels of a strip

if len(sys.argv) < 4 or len(sys.argv) % 2:
    sys.exit(__doc__)
target, *paths = sys.argv[1:]
model, rows = ls.load("default"), []
for left, right in zip(paths[::2], paths[1::2], strict=True):
    images = [replace(model.named(ls.read(path)), completed=None) for path in (left, right)]
    strips = [label_strip(image, row_scale=1) for image in images]
    even = [s[np.arange(HEIGHT) * len(s) // HEIGHT][:, np.arange(WIDTH) * s.shape[1] // WIDTH] for s in strips]
    names = [f"{path.split('/')[-1]}, {image.sensor.name}" for path, image in zip((left, right), images, strict=True)]
    rows.append(list(zip(names, even, strict=True)))
    rows.append([("", perspective(image, size=(WIDTH, WIDTH * 9 // 16), by="label")) for image in images])
save_png(target, panel(rows))
print(f"wrote {target}")
