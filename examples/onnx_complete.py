"""Complete a binary .pcd (x y z intensity, float32) with a file of `lidarsynth export default OUT.onnx`: no torch.

python examples/onnx_complete.py OUT.onnx scan.pcd dense.npy        # dense.npy: (N, 5) x y z reflectance confidence
"""

import json
import os
import sys

import numpy as np
import onnxruntime

if len(sys.argv) != 4:
    sys.exit(__doc__)
_, network, source, target = sys.argv
for path in (network, source):
    if not os.path.isfile(path):
        sys.exit(f"{path}: expected a file, found none")
try:
    session = onnxruntime.InferenceSession(network, providers=["CPUExecutionProvider"])
    sensor = json.loads(session.get_modelmeta().custom_metadata_map["sensor"])
except Exception:  # onnxruntime's own are all of one kind
    sys.exit(f"{network}: expected a file of `lidarsynth export`, found another or a damaged one")
elevations, width = np.array(sensor["elevations"]), sensor["width"]

with open(source, "rb") as file:  # the points
    header = {}
    while "DATA" not in header and (line := file.readline(500)):
        key, *values = line.decode("latin-1").split() or ["#"]
        header[key] = values
    if (data := " ".join(header.get("DATA", ["no DATA"]))) != "binary":
        sys.exit(f"{source}: expected a .pcd with DATA binary, found {data}")
    kind = {"F4": "f4", "U1": "u1", "U2": "u2", "U4": "u4", "I4": "i4", "F8": "f8", "I1": "i1", "I2": "i2"}
    types = [kind[t + s] for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
    cloud = np.fromfile(file, np.dtype(list(zip(header["FIELDS"], types, strict=True))), int(header["POINTS"][0]))
if lacking := [name for name in ("x", "y", "z", "intensity") if name not in (cloud.dtype.names or ())]:
    sys.exit(f"{source}: expected the fields x y z intensity, found no {' '.join(lacking)}")
if len(cloud) < int(header["POINTS"][0]):
    sys.exit(f"{source}: expected {header['POINTS'][0]} points, found the file cut off after {len(cloud)}")
xyz = np.stack([cloud[axis] for axis in "xyz"], 1).astype(np.float32)
metres, light = np.linalg.norm(xyz, axis=1), cloud["intensity"].astype(np.float32)
hit = np.isfinite(metres) & (metres > 0)  # others are rays without a return
xyz, metres, light = xyz[hit], metres[hit], light[hit]
light = light if light.max() <= 1 else light / 255

# row: the beam nearest in elevation, some of which stand a little above the origin; column 0 looks backwards
offsets = np.array(sensor.get("offsets") or np.zeros(len(elevations)))
seen = np.degrees(np.arctan2(xyz[:, 2:] - offsets, np.hypot(xyz[:, :1], xyz[:, 1:2])))
row = np.abs(seen - elevations).argmin(1)
column = ((1 - np.arctan2(xyz[:, 1], xyz[:, 0]) / np.pi) / 2 * width).astype(int) % width
order = np.argsort(-metres)  # the nearest point of a pixel is written last
inside = order[(metres[order] > sensor["min_range"]) & (metres[order] < sensor["max_range"])]
feed = {name: np.zeros((1, 1, len(elevations), width), np.float32) for name in ("range", "reflectance", "known")}
for name, values in zip(feed, (metres, light, np.ones_like(metres)), strict=True):
    feed[name][0, 0, row[inside], column[inside]] = values[inside]

for more in session.get_inputs()[3:]:  # the noise of `kitti-streets`
    feed[more.name] = np.random.default_rng(0).standard_normal(more.shape, np.float32)
full, shade, *sure = (out[0, 0] for out in session.run(None, feed))
rows, columns = np.nonzero((full > 0) & (feed["known"][0, 0] == 0))  # the new points, along their pixels' rays
azimuth, elevation = np.pi - (columns + 0.5) / width * 2 * np.pi, np.radians(elevations[rows])
ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
lift, far = offsets[rows], full[rows, columns]  # of the beam's origin; metres from the sensor's
travel = -lift * ray[:, 2] + np.sqrt(far**2 - lift**2 * (1 - ray[:, 2] ** 2))
new = ray * travel[:, None] + lift[:, None] * [0, 0, 1]
chance = sure[0][rows, columns] if sure else np.ones(len(new), np.float32)
old = np.column_stack([xyz, light, np.ones(len(xyz))])
np.save(target, np.vstack([old, np.column_stack([new, shade[rows, columns], chance])]).astype(np.float32))
print(f"wrote {target}: {len(xyz)} points and {len(new)} new ones")
