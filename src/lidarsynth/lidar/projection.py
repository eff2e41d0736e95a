"""Scan -> RangeImage: `spherical` (row from the elevation) and `unfolding` (row from the point order or ring field)."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.marks import confidences, marks_of
from lidarsynth.lidar.recognition import first_row
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import WORDS, Sensor, get_sensor

PROJECTIONS = ("auto", "spherical", "unfolding")
RESIZINGS = ("nearest-exact", "nearest")
# Rows by the order of points are wrong where more than this share of at most so many points lies on other beams, and
# points lie on beams, within this share of the usual spacing; those of scans put straight for motion do not.
OTHERS, SOME, ON_BEAM = 0.1, 10_000, 0.08
AGAINST = -0.5  # correlation of rows and elevations below which the order is from the lowest ring upwards
ONE_FIRING, MANY, SOON = 0.4, 0.2, 16  # columns between points of one firing at most; share of the points; firings


Pixels = tuple[np.ndarray, np.ndarray]  # row and column of each point, as `pixel_of_points` gives them


def project(
    scan: Scan, sensor: Sensor | str, method: str = "auto", width: int | None = None, pixels: Pixels | None = None
) -> RangeImage:
    """Draw a scan into the sensor's image; the nearest point of a pixel wins (R2DM, section III-A).

    method  `spherical`: row by elevation; `unfolding`: row by ring (Triess et al. 2020), from `scan.ring` or from the
            point order; `auto`: unfolding where the scan has as many rings as the sensor has beams, or rings that lie
            on its beams, wherever their numbers begin (`first_row`), else spherical; also on an even grid, whose rows
            are no beam's, and where points lie on the beams, but not of their rings
    width   columns of the image, if other than the sensor's
    pixels  of the points, where they are known already

    Points outside the range limits leave their pixel empty, also where they hide a farther point, as in the published
    program. Raises ValueError for an unknown method, and for unfolding when the points do not come ring by ring.
    """
    if not isinstance(scan, Scan):
        raise ValueError(f"expected a Scan, found a {type(scan).__name__}")
    sensor = get_sensor(sensor)
    sensor = sensor if width is None else sensor.resized(width=width)
    if method not in PROJECTIONS:
        raise ValueError(f"expected a projection of {', '.join(PROJECTIONS)}, found {method!r}")
    depth = _length(*scan.xyz.T)
    if not (depth > 0).all():
        scan, depth, pixels = scan[depth > 0], depth[depth > 0], None
    row, column = pixel_of_points(scan, sensor, method) if pixels is None else pixels
    pixel = row * sensor.width + column
    return _draw(scan, sensor, depth, pixel, row >= 0)


def columns_of(method: str, width: int, own: int) -> int:
    """Columns to draw at before thinning to `width`: R2DM's 2048 for unfolding and 1024 else, where `width` is below
    1024 and below the sensor's `own`; so a narrow image keeps the ray-drop of a turn instead of the nearest point of
    many, and one of a sensor that has no more columns all its points."""
    return width if width >= min(own, 1024) else 2048 if method == "unfolding" else 1024


def project_thinned(
    scan: Scan,
    sensor: Sensor,
    method: str = "auto",
    columns: int | None = None,
    resizing: str = "nearest-exact",
    pixels: Pixels | None = None,
) -> RangeImage:
    """`project` as the published programs make their data sets: drawn at `columns`, of which the sensor's are kept.

    columns   None = `columns_of`, for a scan of more points than the sensor has pixels; others are images already, or
              of a sensor of so few columns
    resizing  which are kept, as in `thin`
    pixels    of the points in the sensor's own columns, where they are known already
    Raises ValueError as `project` does.
    """
    own = WORDS.get(sensor.name, sensor).width if len(scan) > sensor.height * sensor.width else sensor.width
    wide = columns_of(method, sensor.width, own) if columns is None else columns
    if wide == sensor.width:
        return project(scan, sensor, method, pixels=pixels)
    return thin(project(scan, sensor, method, wide), width=sensor.width, resizing=resizing)


def occupied(scan: Scan, sensor: Sensor, pixels: Pixels) -> np.ndarray:
    """(H, W) bool: pixels that any point falls into, at whatever range, before which nothing is to be put; `pixels` are
    those of the points."""
    row, column = pixels
    x, y, z = scan.xyz.T
    inside = (row >= 0) & ((x != 0) | (y != 0) | (z != 0))
    hit = np.zeros((sensor.height, sensor.width), bool)
    pixel = row * sensor.width + column
    hit.reshape(-1)[pixel if inside.all() else pixel[inside]] = True
    return hit


def thin(
    image: RangeImage, height: int | None = None, width: int | None = None, resizing: str = "nearest-exact"
) -> RangeImage:
    """The image at fewer columns and rows, every pixel one of the old ones: ray-drop stays ray-drop, nothing is mixed.

    resizing  a word of torch: `nearest-exact` keeps columns 4k + 2 from 2048 to 512 (R2DM's KITTI-Raw), `nearest` 4k
              (DUSty's). So are the rows of a grid of pixel edges (`sensor.edges`); of real beams they are the ones that
              `Sensor.resized` keeps, each with its angle
    Raises ValueError for another word.
    """
    height, width = height or image.shape[0], width or image.shape[1]
    sensor = image.sensor.resized(height, width)
    rows = _kept(image.shape[0], height, resizing)
    if not image.sensor.edges:
        rows = np.arange(0, image.shape[0], image.shape[0] // height)
    grid = np.ix_(rows, _kept(image.shape[1], width, resizing))
    label = None if image.label is None else image.label[grid]
    xyz = None if image.xyz is None else image.xyz[grid]
    sure, new = (None if part is None else part[grid] for part in (image.confidence, image.new))
    kept = image.range[grid], image.reflectance[grid], image.mask[grid]
    return RangeImage(*kept, sensor, label, xyz, confidence=sure, new=new)


def _kept(size: int, smaller: int, resizing: str) -> np.ndarray:
    """(smaller,) which of `size` pixels stay: floor((i + 1/2) size / smaller), under the centre of each new pixel, for
    `nearest-exact`; floor(i size / smaller), under its edge, for `nearest`."""
    if resizing not in RESIZINGS:
        raise ValueError(f"expected a resizing of {', '.join(RESIZINGS)}, found {resizing!r}")
    return (2 * np.arange(smaller) + (resizing == "nearest-exact")) * size // (2 * smaller)


def _length(*axes: np.ndarray) -> np.ndarray:
    """(N,) Euclidean length from its coordinates, added in order; several times faster than a norm over rows of 3."""
    total = np.square(axes[0])
    for values in axes[1:]:
        total += np.square(values)
    return np.sqrt(total, out=total)


def row_of_points(scan: Scan, sensor: Sensor, method: str = "auto") -> np.ndarray:
    """(N,) int64 row of each point in the sensor's image, methods as in `project`; -1 outside the field of view."""
    if method == "spherical":
        return _rows_by_elevation(scan.xyz, sensor)
    if method == "auto" and is_even_grid(sensor):
        return _rows_by_elevation(scan.xyz, sensor)
    ring, count = ring_of_points(scan)
    if scan.ring is not None:
        check_from_top(ring, scan.xyz)
        first = first_row(ring, scan.xyz, sensor) if method == "auto" else None
        ring, count = (ring, count) if first is None else (ring + first, sensor.height)
    if method == "auto" and count != sensor.height:
        return _rows_by_elevation(scan.xyz, sensor)
    if count < sensor.height // 2 or count > 2 * sensor.height:
        raise ValueError(
            f"unfolding expects about {sensor.height} rings, one after the other, found {count}; "
            "use the spherical projection"
        )
    if scan.ring is not None:
        return np.where((ring >= 0) & (ring < sensor.height), ring, -1)
    # Rings are counted from the last one upwards: a scan that lacks its top rings keeps the bottom rows. One ring too
    # many goes into the last row, and those before it into the first, as in the published program.
    row = np.where(ring < 0, 0, ring + (sensor.height - count))
    row = np.where(row == -1, sensor.height - 1, np.maximum(row, 0))
    if method != "auto":
        return row
    part = slice(None, None, max(1, len(row) // SOME))
    beam = _rows_by_elevation(scan.xyz[part], sensor)
    row = sensor.height - 1 - row if _from_below(row[part], beam) else row
    return _rows_by_elevation(scan.xyz, sensor) if _elsewhere(scan.xyz[part], row[part], beam, sensor) else row


def _from_below(row: np.ndarray, beam: np.ndarray) -> bool:
    """Whether rows (N,), counted by the order of the file, run against the beams (N,) on which its points lie, -1 on
    none: its lowest ring comes first."""
    if not (seen := beam >= 0).any():
        return False
    a, b = (rows[seen] - rows[seen].mean() for rows in (beam, row))
    return bool((a * b).sum() < AGAINST * np.sqrt((a * a).sum() * (b * b).sum()))


def _elsewhere(xyz: np.ndarray, row: np.ndarray, beam: np.ndarray, sensor: Sensor) -> bool:
    """Whether points (N, 3) lie on the sensor's beams (N,), -1 on none, but many not on that of their row (N,), counted
    by the order of the file: it began elsewhere in the turn than KITTI's, or its last point is already of the next."""
    x, y, z = np.ascontiguousarray(xyz.T)
    seen = beam >= 0
    if sensor.height < 2 or not seen.any():
        return False
    elevations, lift = np.array(sensor.elevations), np.asarray(sensor.offsets or [0.0] * sensor.height)
    off = np.abs(np.degrees(np.arctan2(z - lift[beam], _length(x, y))) - elevations[beam])[seen]
    spacing = np.median(np.abs(np.diff(elevations)))
    return bool(np.mean((beam != row)[seen]) > OTHERS and np.median(off) < ON_BEAM * spacing)


def check_from_top(ring: np.ndarray, xyz: np.ndarray) -> None:
    """Raises ValueError for rings (N,) of points (N, 3) that do not count from the highest beam, as their elevations
    tell; a tilted sensor and single points among the others do not."""
    part = slice(None, None, max(1, len(ring) // 20_000))
    ring, (x, y, z) = ring[part], xyz[part].T
    if len(ring) and ring.min() < 0:
        raise ValueError(f"expected rings counted from 0, found {ring.min()}")
    count = np.bincount(ring)
    used = np.flatnonzero(count >= 5)
    if len(used) < 8:
        return
    mean = np.bincount(ring, np.arctan2(z, _length(x, y)))[used] / count[used]
    order = np.corrcoef(np.arange(len(used)), np.argsort(np.argsort(mean)))[0, 1]
    if order > -0.5:
        found = "them counted from the bottom" if order > 0.9 else "another order (of two sensors?)"
        raise ValueError(f"expected rings counted from the top, 0 the highest beam, found {found}; give the scan such "
                         "rings, or none")  # fmt: skip


def pixel_of_points(scan: Scan, sensor: Sensor, method: str = "auto") -> Pixels:
    """Row, as `row_of_points`, and column of each point in the sensor's image, (N,) int64 each.

    In columns of a sensor of the user's own, as many as it fires in a turn, points of two firings are in two columns,
    also where azimuths that are read coarsely would leave another empty.
    """
    row = row_of_points(scan, sensor, method)
    if sensor.name in WORDS:
        return row, _columns(_turns(scan.xyz), sensor.width)
    return row, columns_one_by_one(scan.xyz, row, sensor.width)


def is_even_grid(sensor: Sensor) -> bool:
    """Whether the rows are edges of evenly spaced pixels, as R2DM's `hdl-64e` has them, and not the beams of a unit."""
    return sensor.edges and (sensor.height < 3 or bool(np.ptp(np.diff(sensor.elevations)) < 1e-3))


def ring_of_points(scan: Scan) -> tuple[np.ndarray, int]:
    """(N,) int64 ring of each point counted from the top, and the number of rings.

    From `scan.ring` if present; else from the order of the points: a ring starts where the azimuth passes from the
    fourth quadrant (x >= 0, y < 0) to the first (x >= 0, y >= 0). Points before the first start are of ring -1, which
    is drawn into the top row, as published.
    """
    if scan.ring is not None:
        ring = scan.ring.astype(np.int64)
        return ring, int(ring.max(initial=-1)) + 1
    x, y = scan.xyz[:, 0], scan.xyz[:, 1]
    fourth, first = (x >= 0) & (y < 0), (x >= 0) & (y >= 0)
    starts = np.roll(fourth, 1) & first
    return np.cumsum(starts) - 1, int(starts.sum())


def _rows_by_elevation(xyz: np.ndarray, sensor: Sensor) -> np.ndarray:
    if sensor.edges:
        return _rows_of_even_grid(xyz, sensor)
    x, y, z = np.ascontiguousarray(xyz.T)
    flat = _length(x, y)
    slope = np.tan(np.radians(np.asarray(sensor.elevations)))
    lift = np.asarray(sensor.offsets or [0.0] * sensor.height)
    # A border lies midway between two beams; the outermost ones as far outside as the next lies inside.
    slope, lift = _borders(slope).astype(np.float32), _borders(lift).astype(np.float32)
    below = _count_above(z, flat, slope, lift)
    return np.where(below > sensor.height, 0, below) - 1


def _count_above(z: np.ndarray, flat: np.ndarray, slope: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """(N,) how many of the falling lines slope * flat + lift run above each point (flat, z): a binary search."""
    size = 1 << len(slope).bit_length()  # the count is below it: padded with lines that are above no point
    slope = np.concatenate([slope, np.zeros(size - len(slope), slope.dtype)])
    lift = np.concatenate([lift, np.full(size - len(lift), -np.inf, lift.dtype)])
    count = np.zeros(len(z), np.intp)
    while size > 1:
        size //= 2
        line = count + (size - 1)
        height = slope.take(line) * flat
        height += lift.take(line)
        count += (z < height) * size
    return count


def _borders(values: np.ndarray) -> np.ndarray:
    """(H,) values at beams -> (H + 1,) values at the borders between them."""
    if len(values) == 1:
        return np.array([values[0] + 0.05, values[0] - 0.05])
    middle = (values[1:] + values[:-1]) / 2
    return np.concatenate([[2 * values[0] - middle[0]], middle, [2 * values[-1] - middle[-1]]])


def _rows_of_even_grid(xyz: np.ndarray, sensor: Sensor) -> np.ndarray:
    """R2DM's grid: floor, and points out of view pile up on the border rows. All in float32, as published."""
    height, top = sensor.height, np.radians(sensor.elevations[0])
    view = np.radians(sensor.elevations[0] - sensor.elevations[1]) * height if height > 1 else 1.0
    x, y, z = np.ascontiguousarray(xyz.T)
    elevation = np.arcsin(np.clip(z / _length(x, y, z), -1, 1))
    row = (1 - (elevation - np.float32(top - view)) / np.float32(view)) * height
    return np.clip(np.floor(row), 0, height - 1).astype(np.intp)


def _columns(turn: np.ndarray, width: int) -> np.ndarray:
    return np.minimum((turn * width).astype(np.intp), width - 1)


def _turns(xyz: np.ndarray) -> np.ndarray:
    """(N,) how far around the image points are, 0 to below 1."""
    azimuth = -np.arctan2(xyz[:, 1], xyz[:, 0])
    turn = (azimuth / np.float32(np.pi) + 1) / 2
    turn[turn >= 1] = 0  # straight behind, from the left or from the right, is column 0
    return turn


def columns_one_by_one(xyz: np.ndarray, row: np.ndarray, width: int) -> np.ndarray:
    """(N,) int64 columns of points (N, 3) of rows (N,), where of two firings in one column the second is in the next,
    and so are those after it up to a column that is free, if SOON at most; but for points of more firings than columns,
    of which many share one.

    KITTI's sensor fires every 0.168 degrees and reads its azimuth in 0.09: of its 2,149 columns 6 % would be empty for
    that, and as many points hidden by others.
    """
    turn = _turns(xyz)
    column = _columns(turn, width)
    order = np.argsort(row + turn.astype(np.float64))
    row, place, first = row[order], turn[order] * width, column[order]
    begins, step = np.diff(row, prepend=-2) != 0, np.diff(first, prepend=-1)
    fires = np.diff(place, prepend=-width) > ONE_FIRING
    shares = fires & ~begins & (step == 0)
    if not shares.any() or shares.mean() > MANY:
        return column
    # Stretches in which each firing has the next column, from one that shares its own; after it comes a column that is
    # free, or another that is shared, for which nobody is to move: the last of them alone is as good.
    start = np.flatnonzero(shares | begins | (step > fires))
    end = np.append(start[1:], len(first)) - 1
    free = np.append(~shares[start[1:]], True) & (first[end] + 1 < width)
    fired = np.cumsum(fires)
    moves = shares[start] & free & (fired[end] - fired[start] < SOON)
    column[order] = first + np.repeat(moves, end + 1 - start)
    return column


def _draw(scan: Scan, sensor: Sensor, depth: np.ndarray, pixel: np.ndarray, inside: np.ndarray) -> RangeImage:
    """Nearest point per pixel, by the minimum of (depth bits, index) packed into one integer."""
    shape = (sensor.height, sensor.width)
    order = depth.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    order |= np.arange(len(depth), dtype=np.uint64)
    best = np.full(shape[0] * shape[1], np.iinfo(np.uint64).max, np.uint64)
    if inside.all():
        np.minimum.at(best, pixel, order)
    else:
        np.minimum.at(best, pixel[inside], order[inside])
    hit = np.flatnonzero(best != np.iinfo(np.uint64).max)
    point = (best[hit] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    valid = (depth[point] >= sensor.min_range) & (depth[point] <= sensor.max_range)
    hit, point = hit[valid], point[valid]

    filled = np.zeros(shape[0] * shape[1], bool)
    filled[hit] = True

    def image(values: np.ndarray, dtype: type) -> np.ndarray:
        canvas = np.zeros((shape[0] * shape[1], *values.shape[1:]), dtype)
        canvas[hit] = values.take(point, axis=0)
        return canvas.reshape(*shape, *values.shape[1:])

    marks = marks_of(scan)
    return RangeImage(
        range=image(depth, np.float32),
        reflectance=image(scan.reflectance, np.float32),
        mask=filled.reshape(shape),
        sensor=sensor,
        label=None if scan.label is None else image(scan.label, np.int64),
        xyz=image(scan.xyz, np.float32),
        confidence=image(confidences(scan), np.float32) if "confidence" in marks else None,
        new=image(marks["new"], np.bool_) if marks else None,
    )
