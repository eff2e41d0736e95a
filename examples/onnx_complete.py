"""Complete a binary .pcd (x y z intensity) with a file of `lidarsynth export default OUT.onnx`: no torch.

python examples/onnx_complete.py OUT.onnx scan.pcd dense.npy        # dense.npy: (N, 5) x y z reflectance confidence
"""

import json
import os
import sys

import numpy as np
import onnxruntime

NUMBERS = {"F4", "F8", *(kind + size for kind in "IU" for size in "1248")}  # TYPE and SIZE of a .pcd
STRAY, CHANCE = 0.03, 0.1  # of the points: how many may lie beyond all beams; how many more on than between beams


def refuse(reason):
    """One line, and the exit code of what cannot be done."""
    print(reason, file=sys.stderr)
    sys.exit(2)


def read_pcd(path):
    """The points of a binary .pcd, (N,) with the fields' own names."""
    with open(path, "rb") as file:
        header = {}
        while "DATA" not in header and (line := file.readline(500)):
            key, *values = line.decode("latin-1").split() or ["#"]
            header[key] = values
        body = file.read()
    if (data := " ".join(header.get("DATA", ["no DATA"]))) != "binary":
        refuse(f"{path}: expected a .pcd with DATA binary, found {data}")
    try:
        names, kinds = header["FIELDS"], [t + s for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        if unknown := set(kinds) - NUMBERS:
            raise ValueError(f"TYPE and SIZE {' '.join(sorted(unknown))}")
        names = [f"_{i}" if name == "_" else name for i, name in enumerate(names)]  # _ is padding
        shapes = [() if count == "1" else (int(count),) for count in header.get("COUNT", ["1"] * len(names))]
        point = np.dtype([(n, f"<{k.lower()}", c) for n, k, c in zip(names, kinds, shapes, strict=True)])
        size = [int(header[key][0]) for key in (["POINTS"] if "POINTS" in header else ["WIDTH", "HEIGHT"])]
    except (ValueError, KeyError, IndexError) as error:
        found = f"no {error.args[0]}" if isinstance(error, KeyError) else error
        refuse(f"{path}: expected FIELDS, SIZE, TYPE, COUNT and POINTS of a .pcd, found {found}")
    if lacking := [name for name in ("x", "y", "z", "intensity") if name not in names or point[name].shape]:
        refuse(f"{path}: expected the fields x y z intensity, found no {' '.join(lacking)}")
    if not (points := int(np.prod(size))) * point.itemsize <= len(body) < (points + 1) * point.itemsize:
        refuse(f"{path}: expected {points} points of {point.itemsize} bytes, found {len(body)} bytes")
    return np.frombuffer(body, point, points)


def reflectance_of(light):
    """(N,) in [0, 1]: floats are 0-1 up to 1; they and whole numbers 0-255 up to 255, 0-65535 above; no number is 0."""
    light = np.where(np.isfinite(light), light, 0)
    top, unit = light.max(), light.dtype.kind == "f" and light.max() <= 1
    if light.min() < 0 or top > 65535:
        refuse(f"{source}: expected an intensity of 0 to 65535, found {light.min():.6g} to {top:.6g}")
    return (light / (1 if unit else 255 if top <= 255 else 65535)).astype(np.float32)


if len(sys.argv) != 4:
    refuse(__doc__)
_, network, source, target = sys.argv
for path in (network, source):
    if not os.path.isfile(path):
        refuse(f"{path}: expected a file, found {'a folder' if os.path.isdir(path) else 'none'}")
if not target.endswith(".npy") or os.path.isdir(target):
    refuse(f"{target}: expected a file that ends in .npy, found {'a folder' if os.path.isdir(target) else 'another'}")
if not os.path.isdir(os.path.dirname(target) or "."):
    refuse(f"{target}: expected a folder to write into, found none")
try:
    session = onnxruntime.InferenceSession(network, providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    sensor, does = json.loads(facts["sensor"]), facts["does"]
except Exception:  # onnxruntime's own are all of one kind
    refuse(f"{network}: expected a file of `lidarsynth export`, found another or a damaged one")
if "completion" not in does:
    refuse(f"{network}: expected a network of completion in one step, found one of {does}")
elevations, width = np.array(sensor["elevations"]), sensor["width"]

cloud = read_pcd(source)
xyz = np.stack([cloud[axis] for axis in "xyz"], 1).astype(np.float32)
metres = np.linalg.norm(xyz, axis=1)
hit = np.isfinite(metres) & (metres > 0)  # others are rays without a return
if not hit.any():
    refuse(f"{source}: expected points with a return, found none of {len(cloud)} points")
xyz, metres, light = xyz[hit], metres[hit], reflectance_of(cloud["intensity"][hit])

# row: the beam nearest in elevation, some of which stand a little above the origin; column 0 looks backwards
offsets = np.array(sensor.get("offsets") or np.zeros(len(elevations)))
seen = np.degrees(np.arctan2(xyz[:, 2:] - offsets, np.hypot(xyz[:, :1], xyz[:, 1:2])))
row, off = np.abs(seen - elevations).argmin(1), np.abs(seen - elevations).min(1)
column = ((1 - np.arctan2(xyz[:, 1], xyz[:, 0]) / np.pi) / 2 * width).astype(int) % width
order = np.argsort(-metres)  # the nearest point of a pixel is written last
inside = order[(metres[order] > sensor["min_range"]) & (metres[order] < sensor["max_range"])]
if not len(inside):
    refuse(f"{source}: expected points of {sensor['min_range']:g} to {sensor['max_range']:g} m, found none")
gaps = np.abs(np.diff(elevations, prepend=np.nan, append=np.nan))  # degrees above and below each beam
beyond = np.mean((off > np.fmax(gaps[:-1], gaps[1:])[row])[inside])
if beyond > STRAY:
    refuse(f"{source}: expected a scan of {sensor['name']}, found {beyond:.0%} of the points a step off all its beams")
apart = (off / np.fmin(gaps[:-1], gaps[1:])[row])[inside]
if np.mean(apart < 0.1) - np.mean(apart > 0.4) < CHANCE:  # or the carrier's motion was taken out
    told = f"{source}: points lie on and between the beams of {sensor['name']} alike"
    print(f"{told}: if another sensor took them, the new points are wrong", file=sys.stderr)
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
try:
    np.save(target, np.vstack([old, np.column_stack([new, shade[rows, columns], chance])]).astype(np.float32))
except OSError as error:
    refuse(f"{target}: expected a file that can be written, found: {error.strerror}")
print(f"wrote {target}: {len(xyz)} points and {len(new)} new ones")
