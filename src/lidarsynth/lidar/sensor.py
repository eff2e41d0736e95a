"""What a spinning LiDAR is: beam elevations, columns per turn, range limits. Every sensor's constants live here."""

from __future__ import annotations

import warnings
from collections import ChainMap
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral, Real
from operator import index
from pathlib import Path

import numpy as np

from lidarsynth.lidar.angles import unit_vectors
from lidarsynth.lidar.plain_fields import METRES, check_plain, evenly_spaced, list_of, numbers
from lidarsynth.lidar.sector import listed_runs, runs_outside
from lidarsynth.lidar.small_file import read_json, read_toml

MOST = 4096  # beams that an image may have
CROWDED, TURNED = 0.06, np.pi / 2  # degrees from beam to beam, and at most, of numbers that look like radians


class UnlikelySensorWarning(UserWarning):
    """Of a sensor that may be what it says, but hardly is."""


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR, one row per beam from the highest to the lowest, one column per azimuth step.

    name        the word users type
    elevations  beam angles in degrees above the horizon, strictly falling, one per row
    width       columns per turn (pixels of the range image)
    min_range   metres; nearer returns are dropped
    max_range   metres; farther returns are dropped
    offsets     height in metres of each beam's origin above the sensor's origin, or () for all zero
    edges       True: row angles are the upper edges and column angles the left edges of their pixels (the KITTI-360
                grid of R2DM); False: they are centres
    mount       height of the sensor above the road in metres, used by synthetic streets, pictures and networks
    tilt        pitch (nose up) and roll (left side up) of the sensor against the road, in degrees
    blocked     rays that end on the carrier and never return, as (row, first column, last column), columns included;
                a run whose first column is behind its last goes around the seam
    dimness     how much less signal each beam reports than others, or () where it is not known

    Raises ValueError when a value makes no sense; warns of elevations that look like radians.
    """

    name: str
    elevations: tuple[float, ...]
    width: int = 1024
    min_range: float = 1.0
    max_range: float = 100.0
    offsets: tuple[float, ...] = ()
    edges: bool = False
    mount: float = 1.73
    tilt: tuple[float, float] = (0.0, 0.0)
    blocked: tuple[tuple[int, int, int], ...] = ()
    dimness: tuple[float, ...] = ()

    def __post_init__(self):
        if not (isinstance(self.name, str) and isinstance(self.edges, bool)):
            found = f"name {self.name!r:.60} and edges {self.edges!r:.60}"
            raise ValueError(f"sensor: expected a word as name and edges that are true or false, found {found}")
        self._as_plain_numbers()
        steps = np.diff(self.elevations)
        if len(self.elevations) < 1 or not np.all(steps < 0) or not np.all(np.abs(self.elevations) <= 90):
            raise ValueError(f"sensor {self.name}: elevations must fall from top to bottom within +-90 degrees, "
                             f"got {list(self.elevations)[:4]}...")  # fmt: skip
        if self.height > 3 and max(map(abs, self.elevations)) <= TURNED and -steps.mean() < CROWDED:
            span = f"{self.elevations[0]:.3g} to {self.elevations[-1]:.3g}"  # or one that looks through a slit
            warnings.warn(f"sensor {self.name}: expected elevations in degrees, found {self.height} of {span}: are they"
                          " radians?", UnlikelySensorWarning, stacklevel=3)  # fmt: skip
        if self.width < 4:
            raise ValueError(f"sensor {self.name}: width must be at least 4 columns, got {self.width}")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(f"sensor {self.name}: expected 0 <= min_range < max_range, "
                             f"got {self.min_range} and {self.max_range}")  # fmt: skip
        if not np.isfinite([*self.offsets, *self.dimness, self.mount]).all():
            raise ValueError(f"sensor {self.name}: expected finite numbers, found NaN or infinite ones")
        if self.offsets and len(self.offsets) != len(self.elevations):
            raise ValueError(f"sensor {self.name}: offsets must have one height per beam ({len(self.elevations)}), "
                             f"got {len(self.offsets)}")  # fmt: skip
        if len(self.tilt) != 2 or not all(abs(angle) < 90 for angle in self.tilt):
            raise ValueError(f"sensor {self.name}: expected a tilt of two angles within 90 degrees, got {self.tilt}")
        if self.dimness and len(self.dimness) != len(self.elevations):
            raise ValueError(f"sensor {self.name}: dimness must have one number per beam ({len(self.elevations)}), "
                             f"got {len(self.dimness)}")  # fmt: skip
        for run in self.blocked:
            inside = len(run) == 3 and 0 <= run[0] < self.height and all(0 <= c < self.width for c in run[1:])
            if not inside:
                raise ValueError(f"sensor {self.name}: expected blocked (row, first, last) within {self.height} rows "
                                 f"and {self.width} columns, got {run}")  # fmt: skip

    def _as_plain_numbers(self) -> None:
        """Tuples of Python's own numbers, which compare, hash and are written as JSON, of lists and arrays too."""
        try:
            for name in ("elevations", "offsets", "tilt", "dimness"):
                if isinstance(value := getattr(self, name), Real):
                    raise TypeError(f"{value!r:.60} as {name}{list_of(name)}")
                object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
            for name in METRES:
                if isinstance(value := getattr(self, name), np.generic):
                    object.__setattr__(self, name, value.item())
                if not isinstance(value := getattr(self, name), Real):
                    raise TypeError(f"{value!r:.60} as {name}")
            object.__setattr__(self, "width", index(self.width))
            object.__setattr__(self, "blocked", tuple(tuple(index(v) for v in run) for run in self.blocked))
        except (TypeError, ValueError) as error:
            raise ValueError(f"sensor {self.name}: expected numbers, whole ones of columns, found: {error}") from None

    @property
    def height(self) -> int:
        """Number of beams, the rows of the image."""
        return len(self.elevations)

    def ray_angles(self) -> np.ndarray:
        """(2, H, W) float32 radians: elevation, then azimuth counter-clockwise from x, falling from +pi at column 0."""
        elevation = np.radians(np.asarray(self.elevations, np.float64))
        shift = 0.0 if self.edges else 0.5
        azimuth = np.pi - (np.arange(self.width) + shift) * 2 * np.pi / self.width
        return np.stack(np.broadcast_arrays(elevation[:, None], azimuth[None, :])).astype(np.float32)

    @lru_cache(maxsize=4)  # noqa: B019, a few small ones; every scan of a folder asks for the same
    def directions(self) -> np.ndarray:
        """(H, W, 3) float32 unit vectors along `ray_angles`: (cos e cos a, cos e sin a, sin e). Read only."""
        rays = unit_vectors(self.ray_angles())
        rays.flags.writeable = False
        return rays

    def points(self, distance: np.ndarray, chosen: np.ndarray | None = None) -> np.ndarray:
        """(H, W, 3) float32 metres: where each ray is `distance` (H, W) metres from the sensor's origin.

        A beam that leaves at height h above the origin meets that sphere at t = -h sin e + sqrt(d^2 - h^2 cos^2 e).

        chosen  (N,) places in the flattened image: of these rays only, (N, 3)
        """
        rays, height = self.directions(), np.asarray(self.offsets or [0.0] * self.height, np.float32)[:, None]
        if chosen is not None:
            rays, distance = rays.reshape(-1, 3).take(chosen, axis=0), distance.reshape(-1).take(chosen)
            height = height[:, 0].take(chosen // self.width)
        if not self.offsets:
            return rays * distance[..., None]
        sine = rays[..., 2]
        travel = -height * sine + np.sqrt(np.maximum(distance**2 - height**2 * (1 - sine**2), 0))
        points = rays * travel[..., None]
        points[..., 2] += height
        return np.where(distance[..., None] > 0, points, np.float32(0))

    def blocked_rays(self) -> np.ndarray:
        """(H, W) bool: rays that end on the carrier and never return."""
        rays = np.zeros((self.height, self.width), bool)
        columns = np.arange(self.width)
        for row, first, last in self.blocked:
            rays[row] |= np.mod(columns - first, self.width) <= np.mod(last - first, self.width)
        return rays

    def resized(self, height: int | None = None, width: int | None = None) -> Sensor:
        """The sensor with `width` columns and, by taking evenly spaced beams, `height` rows (a divisor of its own)."""
        height = self.height if height is None else height
        for name, size in (("height", height), ("width", self.width if width is None else width)):
            if not isinstance(size, Integral):
                raise ValueError(f"sensor {self.name}: expected a whole number as {name}, found {size!r:.60}")
        if height < 1 or self.height % height:
            raise ValueError(f"sensor {self.name}: height must divide its {self.height} beams, got {height}")
        return self.rows(range(0, self.height, self.height // height), width=width)

    def rows(self, rows: range | list[int], width: int | None = None) -> Sensor:
        """The sensor made of the chosen beams only."""
        name = self.name if len(rows) == self.height else f"{self.name}/{len(rows)}"
        pick = tuple(self.elevations[i] for i in rows)
        offsets = tuple(self.offsets[i] for i in rows) if self.offsets else ()
        width = self.width if width is None else width
        place, scale = {row: i for i, row in enumerate(rows)}, width / self.width
        blocked = tuple(
            (place[row], int(first * scale), (min(int((last + 1) * scale), width) - 1) % width)
            for row, first, last in self.blocked
            if row in place and (first > last or int(first * scale) < int((last + 1) * scale))
        )
        dimness = tuple(self.dimness[i] for i in rows) if self.dimness else ()
        parts = {"elevations": pick, "offsets": offsets, "blocked": blocked, "dimness": dimness}
        return replace(self, name=name, width=width, **parts)

    def denser(self, times: int) -> Sensor:
        """The sensor with `times` - 1 beams more between each two, evenly; row i becomes row `times` * i.

        Raises ValueError for `times` below 2.
        """
        if times < 2 or times != int(times):
            raise ValueError(f"expected a whole number of at least 2 times as many beams, found {times}")
        if (beams := (self.height - 1) * int(times) + 1) > MOST:
            raise ValueError(f"expected at most {MOST} beams, found {times} times {self.height}, {beams}: fewer times")
        times = int(times)
        own, place = np.arange(self.height), np.arange((self.height - 1) * times + 1) / times
        elevations = tuple(np.interp(place, own, self.elevations).tolist())
        offsets = tuple(np.interp(place, own, self.offsets).tolist()) if self.offsets else ()
        dimness = tuple(np.interp(place, own, self.dimness).tolist()) if self.dimness else ()
        blocked = tuple(
            (row, first, last)
            for beam, first, last in self.blocked
            for row in range(
                max(0, (beam - 1) * times + 1 + times // 2), min(len(place), beam * times + times // 2 + 1)
            )
        )
        name = f"{self.name}x{times}"
        return replace(self, name=name, elevations=elevations, offsets=offsets, blocked=blocked, dimness=dimness)

    def inverted(self) -> Sensor:
        """The sensor hung upside down, as `vlp-32c-inverted`, in a frame whose z is up; its mount stays."""
        end = self.width - 1  # what is to the left in one is to the right in the other
        edge = 2 * self.elevations[-1] - self.elevations[-2] if self.height > 1 else self.elevations[-1]
        lower = (*self.elevations[1:], edge) if self.edges else self.elevations
        return replace(
            self,
            name=f"{self.name}-inverted",
            elevations=tuple(-angle for angle in reversed(lower)),
            offsets=tuple(-height for height in reversed(self.offsets)),
            blocked=tuple((self.height - 1 - row, end - last, end - first) for row, first, last in self.blocked),
            dimness=self.dimness[::-1],
        )

    def to_dict(self) -> dict:
        """Plain lists and numbers, the inverse of `from_dict`."""
        lists = {key: list(v) if isinstance(v, tuple) else v for key, v in vars(self).items()}
        return lists | {"blocked": [list(run) for run in self.blocked]}


EVENLY = {"beams", "top", "bottom"}  # fields that stand for elevations


def from_dict(values: dict, source: str = "sensor", name: str | None = None) -> Sensor:
    """A sensor from a plain table; `elevations` in degrees, or `beams`, `top` and `bottom` for even spacing; `view`,
    such as [-60, 60], of one that sees a sector alone, as `sector.runs_outside` has it.

    source  begins every message
    name    of a table without one; None = `source`
    Raises ValueError that names the unknown or missing field.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected a table of a sensor's fields, found {values!r:.60}")
    values = dict(values)
    view = values.pop("view", None)
    if "elevations" in values and (both := sorted(EVENLY & values.keys())):
        raise ValueError(f"{source}: expected elevations, or beams with top and bottom, found elevations and "
                         f"{', '.join(both)}")  # fmt: skip
    if values.keys() >= EVENLY:
        beams, top, bottom = (values.pop(key) for key in ("beams", "top", "bottom"))
        values["elevations"] = evenly_spaced(beams, top, bottom, source)
    known = set(Sensor.__dataclass_fields__)
    if unknown := values.keys() - known:
        raise ValueError(f"{source}: expected the fields {sorted(known | {'view'})} or beams/top/bottom, found "
                         f"{sorted(unknown)}")  # fmt: skip
    if "elevations" not in values:
        raise ValueError(f"{source}: expected elevations, or beams with top and bottom, found {sorted(values)}")
    check_plain(values, source)
    lists = {key: numbers(values.get(key, ()), source, key) for key in ("elevations", "offsets", "dimness")}
    order = sorted(range(len(lists["elevations"])), key=lambda i: -lists["elevations"][i])
    for key, told in lists.items():  # each number goes with its beam
        values[key] = tuple(told[i] for i in order) if len(told) == len(order) else tuple(told)
    values["tilt"] = tuple(numbers(values.get("tilt", (0.0, 0.0)), source, "tilt"))
    values["blocked"] = listed_runs(values.get("blocked", ()), source)
    if view is not None and values.get("width", Sensor.width) > 0:  # else it is refused as no width
        values["blocked"] += runs_outside(view, len(order), values.get("width", Sensor.width), source)
    try:
        return Sensor(**{"name": name or source, **values})
    except TypeError as error:
        raise ValueError(f"{source}: expected numbers in the sensor's fields, found {error}") from None


OUSTER = {"beam_intrinsics", "beam_altitude_angles"}  # what its metadata have, of any age


def read_sensor(path: str | Path) -> Sensor:
    """A sensor of the user's own from a `.toml` or `.json` file. Raises ValueError for anything else."""
    path = Path(path)
    try:
        if path.suffix == ".toml":
            return from_dict(read_toml(path), str(path), path.stem)
        if path.suffix == ".json":
            told = read_json(path)
            if isinstance(told, dict) and OUSTER & told.keys():
                raise ValueError(f"{path}: expected a sensor file, found the metadata of an Ouster; lidarsynth sensor "
                                 f"{path} --out own.toml makes one of it")  # fmt: skip
            return from_dict(told, str(path), path.stem)
    except OSError as error:
        raise ValueError(f"{path}: expected a readable sensor file, found {error.strerror}") from None
    raise ValueError(f"{path}: expected a .toml or .json sensor file, found {path.suffix or 'no suffix'}")


def _even(top: float, bottom: float, beams: int) -> tuple[float, ...]:
    return tuple(np.linspace(top, bottom, beams).tolist())


# fmt: off
# Fitted (z = tan(e) rho + h per ring) to the rings of 110 KITTI scans; residual 0.001 to 0.004 degrees. Two blocks.
_KITTI_ELEVATIONS = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.311, -8.711, -9.026, -9.574, -10.062, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.485,
    -14.048, -14.598, -15.189, -15.657, -16.177, -16.554, -17.187, -17.73, -18.323, -18.797, -19.32, -19.736, -20.222,
    -20.787, -21.318, -21.935, -22.437, -22.857, -23.323, -23.97, -24.506, -25.0)
_KITTI_OFFSETS = (
    0.209, 0.209, 0.208, 0.208, 0.207, 0.207, 0.206, 0.206, 0.206, 0.205, 0.205, 0.204, 0.204, 0.204, 0.203, 0.203,
    0.203, 0.202, 0.202, 0.201, 0.201, 0.201, 0.2, 0.2, 0.2, 0.2, 0.199, 0.199, 0.199, 0.198, 0.198, 0.198, 0.126,
    0.125, 0.125, 0.125, 0.124, 0.124, 0.124, 0.123, 0.123, 0.123, 0.122, 0.122, 0.122, 0.121, 0.121, 0.121, 0.12,
    0.12, 0.12, 0.119, 0.119, 0.119, 0.119, 0.118, 0.118, 0.118, 0.117, 0.117, 0.117, 0.116, 0.116, 0.116)
_VLP_32C = (  # Velodyne VLP-32C user manual, table 9-1; both sensors of an Argoverse 2 sweep agree within 0.012 degrees
    15.0, 10.333, 7.0, 4.667, 3.333, 2.333, 1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667, -1.0, -1.333, -1.667,
    -2.0, -2.333, -2.667, -3.0, -3.333, -3.667, -4.0, -4.667, -5.333, -6.148, -7.254, -8.843, -11.31, -15.639, -25.0)
# Measured ring by ring on a real scan (spread within a ring under 0.001 degrees); its top three beams saw only sky and
# are the maker's default calibration.
_PANDAR64 = (
    14.882, 11.032, 8.059, 5.057, 3.04, 2.028, 1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337,
    0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.86, -2.028, -2.198,
    -2.365, -2.536, -2.7, -2.873, -3.04, -3.21, -3.375, -3.548, -3.712, -3.884, -4.05, -4.221, -4.385, -4.558, -4.72,
    -4.892, -5.057, -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.06, -9.885, -11.032, -12.006,
    -12.974, -13.93, -18.889, -24.897)
# Mean elevation of each ring seen from the origin, by which two published programs (R2DM, MIT licence; DUSty v2) take
# KITTI raw; points are right by some decimetres at most, for beams do not leave the origin.
_KITTI_R2DM = (
    2.90162, 2.54083, 2.27962, 1.83844, 1.55523, 1.16427, 0.88214, 0.52491, 0.18024, -0.22164, -0.51342, -0.84005,
    -1.21335, -1.54248, -1.85859, -2.21252, -2.51131, -2.88695, -3.16274, -3.52275, -3.82383, -4.15652, -4.49065,
    -4.81113, -5.18361, -5.50163, -5.80751, -6.08353, -6.46669, -6.81343, -7.04612, -7.42565, -8.14426, -8.67671,
    -9.14223, -9.54695, -10.02562, -10.62382, -11.13217, -11.57026, -12.01626, -12.45456, -12.98524, -13.49978,
    -14.09703, -14.53316, -15.02585, -15.37694, -15.99905, -16.48761, -17.08481, -17.57168, -18.11292, -18.54721,
    -18.99521, -19.5292, -20.03568, -20.62812, -21.06324, -21.53968, -21.95052, -22.55158, -23.13041, -23.65538)
_KITTI_DUSTY = (
    2.92417, 2.56362, 2.30553, 1.86052, 1.5817, 1.18698, 0.90566, 0.54685, 0.20168, -0.2026, -0.49617, -0.82739,
    -1.20354, -1.53463, -1.8548, -2.20995, -2.51212, -2.88786, -3.1652, -3.52427, -3.82604, -4.15805, -4.494,
    -4.8142, -5.18621, -5.50451, -5.81035, -6.08754, -6.471, -6.81606, -7.04945, -7.42939, -8.14602, -8.67877,
    -9.14401, -9.54978, -10.02893, -10.62573, -11.13397, -11.57268, -12.01824, -12.45659, -12.98849, -13.49946,
    -14.09428, -14.5328, -15.02323, -15.39975, -16.01936, -16.53949, -17.10779, -17.57404, -18.05543, -18.47396,
    -18.92452, -19.46386, -19.98226, -20.5682, -21.04203, -21.46202, -21.90455, -22.51957, -23.01244, -23.52954)
# fmt: on

SENSORS: dict[str, Sensor] = {
    # R2DM's grid for KITTI-360: row i at 3 - 28 i / 64 degrees, the pixel's upper edge.
    "hdl-64e": Sensor("hdl-64e", tuple(3 - 28 * i / 64 for i in range(64)), 1024, 1.45, 80.0, edges=True),
    "hdl-64e-kitti": Sensor("hdl-64e-kitti", _KITTI_ELEVATIONS, 1024, 1.45, 80.0, _KITTI_OFFSETS),
    "hdl-32e": Sensor("hdl-32e", _even(10.67, -30.67, 32), 1024, 1.0, 100.0, mount=1.84),
    "vlp-16": Sensor("vlp-16", _even(15.0, -15.0, 16), 1024, 0.5, 100.0),
    "vlp-32c": Sensor("vlp-32c", _VLP_32C, 1024, 1.0, 200.0),
    "os1-64": Sensor("os1-64", _even(16.6, -16.6, 64), 1024, 0.8, 120.0),
    "os1-128": Sensor("os1-128", _even(22.5, -22.5, 128), 1024, 0.8, 120.0),
    "pandar64": Sensor("pandar64", _PANDAR64, 1800, 0.3, 200.0),
}
# Firings of a turn at 10 turns a second, of those whose images have fewer columns.
FULL_TURNS = {"hdl-64e-kitti": 2083, "hdl-32e": 2170, "vlp-16": 1800, "vlp-32c": 1800}


# Those whose beams are others when they hang upside down, as under a drone or in a rack on a roof.
INVERTED = {sensor.name: sensor for sensor in (SENSORS[n].inverted() for n in ("hdl-32e", "vlp-32c", "pandar64"))}
# What published programs take KITTI's images for, and no scan is recognised as: mean beams, the limits of DUSty's first
# release, and R2DM's grid as LiDARGen has it: no return is dropped (an HDL-64E's are of 0.9 to 120 m), and points are
# judged from 0.5 m on.
GRIDS = {
    "hdl-64e-r2dm": Sensor("hdl-64e-r2dm", _KITTI_R2DM, 1024, 1.45, 80.0),
    "hdl-64e-dusty": Sensor("hdl-64e-dusty", _KITTI_DUSTY, 1024, 1.45, 80.0),
    "hdl-64e-iros21": replace(SENSORS["hdl-64e-kitti"], name="hdl-64e-iros21", min_range=0.9, max_range=120.0),
    "hdl-64e-lidargen": replace(SENSORS["hdl-64e"], name="hdl-64e-lidargen", min_range=0.5, max_range=130.0),
}
WORDS = ChainMap(SENSORS, INVERTED, GRIDS)  # what `get_sensor` takes, also of what is put into SENSORS from outside


def same_rays(one: Sensor, other: Sensor) -> bool:
    """Whether both have the same beams and columns, whatever their names, limits and mounting."""
    return all(getattr(one, name) == getattr(other, name) for name in ("elevations", "width", "offsets", "edges"))


def get_sensor(name: str | Sensor) -> Sensor:
    """A sensor by its word (`hdl-64e`, `vlp-32c-inverted`, ...), from the path of a `.toml` / `.json` file, or itself.

    Raises ValueError.
    """
    if isinstance(name, Sensor):
        return name
    if not isinstance(name, str | Path):
        raise ValueError(f"expected a sensor or its word, found a {type(name).__name__}")
    if (name := str(name)) in WORDS:
        return WORDS[name]
    if Path(name).suffix in (".toml", ".json"):
        return read_sensor(name)
    words = ", ".join([*SENSORS, *INVERTED, *GRIDS])
    raise ValueError(f"expected a sensor of {words} or a .toml/.json sensor file, found {name!r}")
