"""From the named columns of any point file to a `Scan`: field names, intensity scales, ring order, lost points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lidarsynth.files.whole_numbers import EXACT, stray
from lidarsynth.lidar.plural import plural, was
from lidarsynth.lidar.scan import Scan, no_metres
from lidarsynth.lidar.sensor import MOST, SENSORS

Fields = dict[str, np.ndarray]  # what a format's reader returns: one (N,) array per field, under the file's own names

MAX_POINTS = 10_000_000  # one turn of the largest sensor is under a million points; more is a map or a lying header
MAX_BYTES = 1 << 28  # of one file, and of one array packed in a file
# No LiDAR sees farther; beyond it the bytes are not coordinates, or coordinates of a map. Up to here float32, which a
# scan's are, is half a millimetre off at most.
MAX_METRES = 10_000.0
EARTH = 2e7  # metres; no coordinate of a map is greater
MAX_RINGS = MOST  # as many as an image may have beams: its rings come back
SHORTS = 1 << 16  # whole numbers that the labels of a table have
SHORTEST, LONGEST = 1e-3, 10.0  # seconds that a turn may last
SCALED = "reflectance by the format"  # a further field: intensities as 0-1, of formats that fix their scale; for "auto"
PLACE = "place in the file"  # a further field: where each point stood in its file or message, from 1; 0 of a new one

NAMES: dict[str, tuple[str, ...]] = {  # ours -> the usual ones, also behind SCALAR; the first found wins, in any case
    "x": ("x", "points:0", "points_m_xyz:0", "//x"),
    "y": ("y", "points:1", "points_m_xyz:1"),
    "z": ("z", "points:2", "points_m_xyz:2"),
    "reflectance": ("reflectance", "reflectivity", "intensity", "remission", "intensities", "i"),
    "ring": ("ring", "channel", "line", "laser", "laser_number", "laser_id"),
    "time": ("time", "timestamp", "t", "offset_time", "offset_ns", "time_offset", "gps_time", "timestamps",
             "time_stamp", "gpstime"),  # as of Autoware, of PDAL
    "label": ("label", "class"),
}  # fmt: skip
SCALAR = "scalar_"  # before the names of fields, as CloudCompare writes them

SCALES: dict[str, float] = {"unit": 1.0, "byte": 255.0, "uint16": 65535.0}  # intensity -> the value of reflectance 1
INTENSITIES = ("auto", *SCALES, "none")
WITHOUT = "--intensity none takes it for 0"  # ends what is said of a scan that could be read so


class FileError(ValueError):
    """A file that cannot be read or written; the message is one line: `path: expected ..., found ...`."""


def find(fields: Fields, name: str) -> str | None:
    """The file's own name of our field `name` (a key of NAMES), or None."""
    lower = {key.lower(): key for key in reversed(list(fields))}
    return next((lower[word] for start in ("", SCALAR) for own in NAMES[name] if (word := start + own) in lower), None)


def check_names(names: Sequence[str]) -> None:
    """Raises FileError where two fields of a file have one name: nobody knows which of them is meant."""
    if twice := [name for name in names if names.count(name) > 1]:
        raise FileError(f"expected fields of different names, found {names.count(twice[0])} named {twice[0][:40]}")


def scan_from_fields(fields: Fields, intensity: str = "auto", rings: tuple[int, int] | None = None) -> tuple[Scan, int]:
    """The scan of N columns, and how many points it lost.

    Points with a non-finite coordinate, or where nothing returned (see `_returned`), are dropped and counted; an
    intensity that is not finite is 0. Columns of no point at all give a scan of none; of points that are all dropped
    there is no scan.
    `intensity`: see `reflectance_from`; "auto" takes the field SCALED where there is one. `rings`: see `on_rings`.
    Ring numbers that do not count from the top, and times that are no seconds, stay among the further fields as the
    file has them. Raises FileError (without the path) for anything that is not one LiDAR turn.
    """
    x, y, z = _coordinates(fields)
    if rings is not None:
        fields = on_rings(fields, *rings)
        x, y, z = _coordinates(fields)
    name = SCALED if intensity == "auto" and SCALED in fields else find(fields, "reflectance")
    if intensity == "none":
        values = np.zeros(len(x), np.float32)
    elif name is None:
        raise FileError(f"expected an intensity field ({', '.join(NAMES['reflectance'][:4])}), "
                        f"found {_listed(fields)}; {WITHOUT}")  # fmt: skip
    else:
        values = _numbers(fields[name], name)
    keep = _returned(x, y, z)
    values = values if np.isfinite(values[keep]).all() else np.where(np.isfinite(values), values, 0)
    if len(keep) and not keep.any():
        raise FileError(f"expected at least one finite point away from the origin, found none in {len(x)}")
    dropped = int(len(keep) - keep.sum())
    kept = keep if dropped else slice(None)
    xyz = np.stack([x[kept], y[kept], z[kept]], axis=1)
    if (far := max(float(xyz.max(initial=0)), -float(xyz.min(initial=0)))) > MAX_METRES:
        raise FileError(f"expected metres from the sensor, at most {MAX_METRES:.0f}, found a coordinate of {far:.4g}"
                        f"{_why_far(xyz, far)}")  # fmt: skip
    xyz = xyz.astype(np.float32, copy=False)
    if text := no_metres(np.abs(xyz[::16]).max(axis=1)):
        raise FileError(text)
    values = reflectance_from(values[kept], "unit" if intensity == "none" else intensity)
    ring, time, label = (fields[key][kept] if (key := find(fields, n)) else None for n in ("ring", "time", "label"))
    classes = None if label is None else _training_classes(label)
    from_top = None if ring is None else rings_from_top(ring, xyz)
    seconds = None if time is None else seconds_from(time, _of_nanoseconds(time, find(fields, "time")))
    pairs = (("ring", ring, from_top), ("time", time, seconds))
    told = [(name, given, ours) for name, given, ours in pairs if given is not None and ours is not None]
    changed = [find(fields, name) for name, given, ours in told if not np.array_equal(given, ours, equal_nan=True)]
    kept_too = {key for key in changed if f"file_{key}" not in fields}
    taken = {find(fields, name) for name in NAMES if name != "label" or classes is not None} - kept_too | {SCALED}
    return Scan(
        xyz,
        values,
        ring=from_top,
        time=seconds,
        label=classes,
        extra={key: column[kept] for key, column in fields.items() if key not in taken and column.dtype.kind in "biuf"},
    ), dropped


def _why_far(xyz: np.ndarray, far: float) -> str:
    """What coordinates (N, 3) up to `far` may be instead of metres from a sensor, or nothing."""
    away, wide = np.abs(xyz).min(axis=0), xyz.max(axis=0).astype(np.float64) - xyz.min(axis=0)
    if far < EARTH and (away > np.maximum(wide, MAX_METRES)).any():
        return ", as of a map: subtract where the sensor stood first"
    return ": are they centimetres or millimetres?" if far < 1000 * MAX_METRES else ""


def dropped_points(count: int) -> str:
    """What is said of points that `scan_from_fields` lost."""
    return f"{plural(count, 'point')} without a return or not finite {was(count)} dropped"


def _returned(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(N,) bool: finite points that are not where a file puts rays without a return: the origin, or, of several such,
    (-1, -1, -1), as of the images that RangeNet++ makes of SemanticKITTI."""
    there = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0) | (y != 0) | (z != 0))
    empty = (x == -1) & (y == -1) & (z == -1)
    return there & ~empty if np.count_nonzero(empty) > 1 else there


def on_rings(fields: Fields, first: int, last: int) -> Fields:
    """The columns of the points on rings `first` to `last`, numbered from 0 then: one sensor's of a file of several.

    Raises FileError where the file has none of them.
    """
    name = find(fields, "ring")
    if name is None:
        raise FileError(f"expected rings {first}-{last}, found points without a ring field: {_listed(fields)}")
    ring = _numbers(fields[name], name)
    kept = (ring >= first) & (ring <= last)
    if not kept.any():
        found = f"rings {ring.min():.6g}-{ring.max():.6g}" if len(ring) else "no points"
        raise FileError(f"expected rings {first}-{last}, found {found}")
    chosen = {key: column[kept] for key, column in fields.items()}
    return chosen | {name: ring[kept] - first} | ({f"file_{name}": ring[kept]} if first else {})


def _coordinates(fields: Fields) -> list[np.ndarray]:
    """x, y, z, each (N,), after checking that N is the same for every field, and not too many for one turn."""
    names = [find(fields, axis) for axis in "xyz"]
    if missing := [axis for axis, name in zip("xyz", names, strict=True) if name is None]:
        raise FileError(f"expected the fields x, y, z, found no {', '.join(missing)} in {_listed(fields)}")
    if len({v.shape for v in fields.values()}) > 1:
        shapes = ", ".join(f"{key} {value.shape}" for key, value in list(fields.items())[:8])
        raise FileError(f"expected fields of one length, found {shapes}")
    columns = [_numbers(fields[name], name) for name in names if name is not None]
    if columns[0].ndim != 1 or len(columns[0]) > MAX_POINTS:
        found = len(columns[0]) if columns[0].ndim == 1 else f"an array {columns[0].shape}"
        raise FileError(f"expected at most {MAX_POINTS} points of one turn, found {found}")
    return columns


def _numbers(values: np.ndarray, name: str) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise FileError(f"expected real numbers in the field {name}, found the type {values.dtype}")
    return values


def _listed(fields: Fields) -> str:
    names = ", ".join([name for name in fields if name not in (PLACE, SCALED)][:12])
    return f"only {names}" if names else "no field at all"


def reflectance_from(values: np.ndarray, intensity: str = "auto") -> np.ndarray:
    """(N,) float32 in [0, 1] from finite intensities of 0-1 ("unit"), 0-255 ("byte") or 0-65535 ("uint16").

    "auto": an 8-bit type is 0-255, other integers are 0-255 up to 255 and 0-65535 above; floats are 0-1 up to 1, 0-255
    up to 255, 0-65535 above, but that one in a thousand may be brighter than its scale, and most of fractions up to 2
    are 0-1; what is above its scale is taken for the most there is. A scan of floats so dark that no point exceeds 1 of
    255 is the one case to force by hand. Raises FileError when the values do not fit the scale.
    """
    if not len(values):
        return np.zeros(0, np.float32)
    low, high = float(values.min()), float(values.max())
    if intensity == "auto":
        intensity = _scale_of(values, high)
        limit = SCALES[intensity]
        if low >= 0 and limit < high <= SCALES["uint16"]:
            values, high = np.minimum(values, limit), limit
    limit = SCALES[intensity]
    if low < 0 or high > limit:
        way = f"; {WITHOUT}" if low < 0 or high > SCALES["uint16"] else ""  # as of decibels, of raw counts
        raise FileError(f"expected an intensity of 0-{limit:.0f} ({intensity}), found {low:.6g} to {high:.6g}{way}")
    return (values if limit == 1 else values / np.float64(limit)).astype(np.float32)


def full_scale(fields: Fields, intensity: str = "auto", rings: tuple[int, int] | None = None) -> float:
    """What a reflectance of 1 is in the intensities of N columns, as `scan_from_fields` takes them; of those that are
    not to be read ("none") as "auto" would, and 1 where there are none. Raises FileError without coordinates."""
    if intensity in SCALES:
        return SCALES[intensity]
    fields = fields if rings is None else on_rings(fields, *rings)
    name = find(fields, "reflectance")
    if name is None:
        return 1.0
    values = _numbers(fields[name], name)
    values = np.where(np.isfinite(values), values, 0)[_returned(*_coordinates(fields))]
    return SCALES[_scale_of(values, float(values.max(initial=0)))]


def _scale_of(values: np.ndarray, high: float) -> str:
    """The scale of intensities of which `high` is the greatest; see `reflectance_from`."""
    if values.dtype.kind != "f":
        return "byte" if high <= 255 else "uint16"
    if high <= 1:
        return "unit"
    usual = float(np.partition(values, int(0.999 * (len(values) - 1)))[int(0.999 * (len(values) - 1))])
    fractions = float(np.mean(values[::16] % 1 > 0)) > 0.5
    if fractions and usual <= 2:
        return "unit"
    return "byte" if high <= 255 or (usual <= 255 and len(values) >= 1000) else "uint16"


def rings_from_top(ring: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """(N,) int32 beam numbers that count from the highest beam, whatever the file's own order.

    The mean elevation of each ring decides: falling numbers stay, rising ones (nuScenes, Velodyne drivers) are turned
    round, any other order (laser ids in firing order) becomes the rank by elevation. When turned, a count that just
    misses that of a known sensor (30 rings of 32) is taken as that sensor's, its top beams being empty.
    """
    if not len(ring):
        return np.zeros(0, np.int32)
    if not (np.isfinite(_numbers(ring, "ring")).all() and ring.min() >= 0 and ring.max() < MAX_RINGS):
        raise FileError(f"expected ring numbers of 0-{MAX_RINGS - 1}, found {ring.min():.4g} to {ring.max():.4g}")
    whole = ring.astype(np.int32)
    if np.any(whole != ring):
        raise FileError(f"expected whole ring numbers, found {ring[whole != ring][0]:.4g}")
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    count = np.bincount(whole)
    used = np.flatnonzero(count)
    mean = (np.bincount(whole, elevation) / np.maximum(count, 1))[used]
    rising = np.mean(np.diff(mean) > 0) if len(used) > 1 else 0.0
    if rising <= 0.1:
        return whole
    if rising >= 0.9:
        return _beams(len(count)) - 1 - whole
    rank = np.zeros(len(count), np.int32)
    rank[used[np.argsort(-mean)]] = np.arange(len(used))
    return rank[whole]


def _beams(found: int) -> int:
    known = sorted({sensor.height for sensor in SENSORS.values()})
    return next((height for height in known if 0.9 * height <= found <= height), found)


def seconds_from(time: np.ndarray, nanoseconds: bool = False) -> np.ndarray:
    """(N,) float64 seconds. Integers are the unit of 1, 1e-3, 1e-6 or 1e-9 s that brings the span nearest to 0.1 s
    (`nanoseconds`: 1e-9), and so are floats that span more than a turn can last or are beyond 1e15, as of Livox; other
    floats are seconds already. All but seconds are counted from the first instant so that no digit is lost.
    """
    if _numbers(time, "time").dtype.kind == "f":
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            exact = time.astype(np.float64)
            known = exact[np.isfinite(exact)]
            first, last = (known.min(), known.max()) if len(known) else (0.0, 0.0)
            if nanoseconds or (last <= 1e15 and last - first <= LONGEST):
                return exact * (1e-9 if nanoseconds else 1.0)
            return (exact - first) / 10.0 ** _power(max(float(last - first), 1.0))
    if not len(time):
        return np.zeros(0)
    first = time.min()
    span = max(int(time.max()) - int(first), 1)
    return (time - first).astype(np.float64) / 10.0 ** (9 if nanoseconds else _power(span))


def _of_nanoseconds(time: np.ndarray, name: str | None) -> bool:
    """Whether times (N,) are nanoseconds by the name of their field; `offset_time`, as of Livox, where a turn may last
    as long."""
    if name != "offset_time":
        return name == "offset_ns"
    known = (exact := _numbers(time, "time").astype(np.float64))[np.isfinite(exact)]
    return len(known) > 0 and SHORTEST <= float(known.max() - known.min()) / 1e9 <= LONGEST


def _power(span: float) -> int:
    """Of ten, units of a second that bring a turn's span nearest to 0.1 s."""
    return min((0, 3, 6, 9), key=lambda p: abs(np.log10(span) - p + 1))


def rings_of_grid(fields: Fields, shape: tuple[int, int]) -> np.ndarray | None:
    """(N,) int row (or column) of each point of an organised cloud (H, W), if those are the beams of a spinning LiDAR.

    They are when there are 8 to 256 of them and a point's elevation varies far less along one than over the cloud.
    """
    names = [find(fields, axis) for axis in "xyz"]
    if None in names or find(fields, "ring") or fields[str(names[0])].size != shape[0] * shape[1]:
        return None
    x, y, z = (fields[str(name)].astype(np.float32) for name in names)
    with np.errstate(all="ignore"):  # organised clouds are full of NaN
        elevation = np.arctan2(z, np.hypot(x, y))
    good = _returned(x, y, z) & (elevation != 0)
    index = np.arange(len(x))
    for count, ring in ((shape[0], index // shape[1]), (shape[1], index % shape[1])):
        if not 8 <= count <= 256 or good.sum() < 2 * count:
            continue
        number = np.maximum(np.bincount(ring[good], minlength=count), 1)
        mean = np.bincount(ring[good], elevation[good], count) / number
        if np.std(elevation[good] - mean[ring[good]]) < 0.25 * np.std(elevation[good]):
            return ring
    return None


def _training_classes(label: np.ndarray) -> np.ndarray | None:
    """Labels are kept where they are SemanticKITTI training classes 0-19; other numbers would mean something else."""
    if label.dtype.kind not in "fiu" or not np.isin(label, np.arange(20)).all():
        return None
    return label.astype(np.int32)


def _storable(column: np.ndarray) -> np.ndarray:
    """The column in a little-endian type that point files have: no bool, no float16."""
    kind: str = column.dtype.str[1:]
    plain: dict[str, str] = {"b1": "u1", "f2": "f4"}
    return column.astype(f"<{plain.get(kind, kind)}")


def written_names(names: Iterable[str], taken: Iterable[str]) -> list[str]:
    """Names that any file can hold, one for each: a word of printable ASCII, no two alike.

    One of `taken` gets `file_` before it, and the second of a kind a number behind.
    """
    own, used, written = set(taken), set(taken), []
    for name in names:
        plain = "".join(c if c.isascii() and c.isprintable() and c not in " #/" else "_" for c in name) or "field"
        word = plain = f"file_{plain}" if plain in own else plain
        number = 1
        while word in used:
            number += 1
            word = f"{plain}_{number}"
        used.add(word)
        written.append(word)
    return written


def check_table(scan: Scan, suffix: str) -> None:
    """Raises FileError for what would not come back from a file with named fields: ring numbers that no reader takes,
    and, but for `.npz` (`suffix`), labels and times in other types than a table's; further fields that are no numbers,
    or not one a point."""
    own_types = suffix == ".npz"
    label, time = (None, None) if own_types else (scan.label, scan.time)
    for name, values, limit in (("ring", scan.ring, MAX_RINGS), ("label", label, SHORTS)):
        if values is not None and (found := stray(values, limit - 1)) is not None:
            raise FileError(f"expected {name} numbers of 0-{limit - 1} in {suffix}, found {found}")
    if time is not None and time.dtype.kind in "iu":
        found = max(int(time.max(initial=0)), int(time.min(initial=0)), key=abs)
        if abs(found) > EXACT:
            raise FileError(f"expected times in seconds in {suffix}, found {found}, of which float64 loses digits")
    for name, column in scan.extra.items():
        if column.dtype.kind not in "biuf" or (column.dtype.itemsize > 8 and not own_types):
            raise FileError(f"expected fields of numbers in {suffix}, found {name} of {column.dtype}")
        check_length(name, column, len(scan))


def check_length(name: str, column: np.ndarray, count: int) -> None:
    """Raises FileError for a column that is not (count,), as a scan's `extra` may have it that was changed later."""
    if np.shape(column) != (count,):
        raise FileError(f"expected one number a point, ({count},), found {name} of {np.shape(column)}")


def scan_table(scan: Scan) -> np.ndarray:
    """Packed structured array (N,): x y z intensity float32; ring uint16, timestamp float64, label uint16 if known.

    Further fields follow in their own types, under `written_names`. Numbers are expected as `check_table` has them.
    """
    columns = {axis: scan.xyz[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    columns["intensity"] = scan.reflectance.astype("<f4")
    for name, value, kind in (
        ("ring", scan.ring, "<u2"),
        ("timestamp", scan.time, "<f8"),
        ("label", scan.label, "<u2"),
    ):
        if value is not None:
            columns[name] = value.astype(kind)
    for name, value in zip(written_names(scan.extra, columns), scan.extra.values(), strict=True):
        columns[name] = _storable(value)
    table = np.empty(len(scan), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table
