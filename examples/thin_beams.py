"""Keep every fourth beam of a scan file: `python thin_beams.py SCAN OUT [EVERY]`."""

import sys

import lidarsynth as ls

source, target, *every = sys.argv[1:]
image = ls.project(ls.read(source), sensor="hdl-64e-kitti")
sparse = image.keep(ls.corrupt(image, f"beams:{every[0] if every else 4}"))
ls.write(target, sparse.to_scan())
print(f"wrote {target}: {sparse.mask.sum()} of {image.mask.sum()} points")
