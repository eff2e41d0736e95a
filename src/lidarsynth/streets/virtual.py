"""Virtual sensors, drawn from a seed: what a network must have seen to work with any sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets.materials import TABLE
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.sensor_model import Optics

# The even grid has nobody's true beams; KITTI's sensor is the one that most published numbers are about.
KNOWN = (*(name for name in SENSORS if name != "hdl-64e"), *("hdl-64e-kitti",) * 3)
BEAMS = (16, 20, 24, 32, 32, 40, 48, 64, 64, 64, 80, 128)
SHARING = 4  # scans in a row of one sensor
WIDEST = Sensor("widest", (28.0, -35.0), max_range=200.0, mount=2.5)  # what any of them may see
COLUMNS = (512, 1024, 1024, 1024, 1800, 2048)


@dataclass(frozen=True)
class VirtualSensor:
    """A sensor on a carrier, and how well it sees."""

    sensor: Sensor
    optics: Optics = field(default_factory=Optics)


class VirtualStreets:
    """Streets seen by virtual sensors: `len`, `sensor(i) -> VirtualSensor`, `image(i) -> RangeImage` of that sensor,
    and `pair(i)` of it and what a perfect sensor would give.

    worlds  of this seed, if other than streets
    drawn   a sensor of a generator, `draw_sensor` if not given

    Four scans in a row share a sensor, sixteen a world. Scan i of a seed depends on nothing else. Raises as
    `SyntheticStreets`.
    """

    def __init__(
        self,
        seed: int = 0,
        length: int = 1000,
        worlds: Worlds | None = None,
        drawn: Callable[[np.random.Generator], VirtualSensor] | None = None,
    ):
        self.seed, self.length = seed, length
        self._worlds = worlds or Worlds(seed, WIDEST)
        self._drawn = drawn or draw_sensor
        self._streets: tuple[int, SyntheticStreets] | None = None

    def __len__(self) -> int:
        return self.length

    def sensor(self, index: int) -> VirtualSensor:
        """The sensor of scan `index`."""
        return self._drawn(np.random.default_rng((self.seed, index // SHARING, 2)))

    def image(self, index: int) -> RangeImage:
        """(H, W) image of scan `index`, in the sensor of it, with the surfaces that its rays meet."""
        perfect, seen = self.pair(index)
        return replace(seen, surface=perfect.range)

    def pair(self, index: int) -> tuple[RangeImage, RangeImage]:
        """`(perfect, seen)` of scan `index`, as `SyntheticStreets.pair`."""
        return self._of(index).pair(index)

    def _of(self, index: int) -> SyntheticStreets:
        """The streets as the sensor of scan `index` sees them."""
        group = index // SHARING
        if self._streets is None or self._streets[0] != group:
            seen = self.sensor(index)
            streets = SyntheticStreets(self.seed, self.length, seen.sensor, optics=seen.optics, worlds=self._worlds)
            self._streets = (group, streets)
        return self._streets[1]


def draw_sensor(rng: np.random.Generator, known_share: float = 0.5) -> VirtualSensor:
    """A known sensor, mounted anyhow, or with chance 1 - `known_share` one that nobody has built.

    16 to 128 beams, fields of view from +2..+25 to -15..-30 degrees, even, uneven or dense in the middle; 512 to 2048
    columns; 1.2 to 2.5 m above the road, half of them tilted by a few degrees; limits of 30 to 200 m; losses, noise and
    response of their own; half of them with a carrier that blocks a part of the lower rays.
    """
    mount = float(rng.uniform(1.2, 2.5))
    pitch, roll = rng.normal(0, 1.2, 2) * (rng.random() < 0.5)
    tilt = (float(pitch), float(roll))
    limit = float(np.exp(rng.uniform(np.log(30), np.log(200)))) if rng.random() < 0.5 else float(rng.uniform(80, 200))
    if rng.random() < known_share:
        known = SENSORS[KNOWN[rng.integers(len(KNOWN))]]
        if known.name == "hdl-64e-kitti" and rng.random() < 0.7:  # as on its car, whose shadow is its own
            return VirtualSensor(known)
        sensor = replace(known, mount=mount, tilt=tilt, max_range=max(limit, 80.0), name=f"virtual {known.name}")
    else:
        nearest = float(rng.uniform(0.3, 1.6))
        width = int(COLUMNS[rng.integers(len(COLUMNS))])
        sensor = Sensor("virtual", _elevations(rng), width, nearest, limit, mount=mount, tilt=tilt)
    if rng.random() < 0.5:
        sensor = replace(sensor, blocked=_carrier(rng, sensor))
    optics = _optics(rng, sensor)
    return VirtualSensor(replace(sensor, dimness=optics.loss), optics)


def _elevations(rng: np.random.Generator) -> tuple[float, ...]:
    """Falling degrees: even, uneven, or dense in the middle."""
    beams = int(BEAMS[rng.integers(len(BEAMS))])
    top, bottom = rng.uniform(2, 25), rng.uniform(-30, -15)
    kind = rng.random()
    place = np.linspace(0, 1, beams)
    if kind < 0.35:  # spacing like a bell turned over: the middle is `power` times denser than the ends
        middle, width, power = rng.uniform(0.25, 0.75), rng.uniform(0.08, 0.3), rng.uniform(2, 8)
        density = 1 + (power - 1) * np.exp(-0.5 * ((place - middle) / width) ** 2)
        steps = 1 / density[:-1]
        place = np.concatenate([[0], np.cumsum(steps)]) / steps.sum()
    elif kind < 0.6:  # two blocks or slightly uneven
        steps = np.where(place[:-1] < rng.uniform(0.3, 0.7), 1.0, rng.uniform(0.6, 1.7)) * rng.uniform(
            0.85, 1.15, beams - 1
        )
        place = np.concatenate([[0], np.cumsum(steps)]) / steps.sum()
    return tuple((top + (bottom - top) * place).tolist())


def _carrier(rng: np.random.Generator, sensor: Sensor) -> tuple[tuple[int, int, int], ...]:
    """Blocked runs of one to three humps that rise from the lowest rows: a roof, a rack, a person behind."""
    runs = []
    for _ in range(int(rng.integers(1, 4))):
        centre, half = rng.uniform(0, sensor.width), rng.uniform(0.01, 0.16) * sensor.width
        tall, power = int(rng.integers(1, max(2, int(0.35 * sensor.height)) + 1)), rng.uniform(0.5, 3)
        for rise in range(tall):
            reach = half * (1 - (rise / tall) ** power)
            first, last = int(centre - reach), int(centre + reach)
            runs.append((sensor.height - 1 - rise, first % sensor.width, last % sensor.width))
    return tuple(runs)


def _optics(rng: np.random.Generator, sensor: Sensor) -> Optics:
    uneven = rng.uniform(0, 0.06)
    beams = sensor.height
    return Optics(
        loss=tuple(np.clip(rng.normal(0.03, 1, beams) * uneven, -0.05, 0.2).tolist()),
        dip=tuple((rng.uniform(0, 0.25, beams) * (rng.random() < 0.3)).tolist()),
        shift=tuple((rng.normal(0, 1, beams) * rng.uniform(0, 0.02)).tolist()),
        noise=float(np.exp(rng.uniform(np.log(0.3), np.log(2.5)))),
        strength=float(rng.uniform(-0.03, 0.12)),
        gamma=float(np.exp(rng.normal(0, 0.35))),
        scale=float(rng.uniform(0.35, 1.2)),
        **_colour(rng),
    )


def _colour(rng: np.random.Generator) -> dict[str, Any]:
    """How materials look to a laser of another colour and a receiver of another make: eight of ten sensors differ."""
    if rng.random() < 0.2:
        return {}
    factor = np.exp(rng.normal(0, (0.3, 0.3, 0.3), (len(TABLE), 3)) + rng.normal(0, (0.0, 0.2, 0.4), 3))
    surfaces = TABLE[:, :3] * factor
    surfaces[:, 0] += rng.normal(0, 0.04, len(TABLE))
    return {"fade": float(rng.uniform(0.2, 1.2)), "surfaces": tuple(map(tuple, surfaces.tolist()))}
