"""Streets as recorded on many days: KITTI's sensor on a car that sags, with lasers and a response of that day.

`SyntheticStreets` has one sensor, fitted to one day (2011_09_26): it stands at 1.73 m to the millimetre, and answers
alike for ever. A network that learned from it alone reads a road of another day, or 10 cm lower, as something else.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.areas import Density
from lidarsynth.streets.hdl64e import NAME, RING_DIP, RING_LOSS, RING_SHIFT
from lidarsynth.streets.materials import TABLE
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.sensor_model import Optics
from lidarsynth.streets.virtual import SHARING, VirtualSensor
from lidarsynth.streets.world import POSES

KITTI = SENSORS[NAME]
HIGHEST = replace(KITTI, mount=2.1, elevations=(5.0, *KITTI.elevations[1:]))  # what any of them may see


class RecordedStreets:
    """A reader of images: `len`, `recording(i) -> VirtualSensor`, `image(i) -> RangeImage` of that sensor.

    Four scans in a row share a recording, sixteen a world. Scan i of a seed depends on nothing else. Raises as
    `SyntheticStreets`.
    """

    def __init__(self, seed: int = 0, length: int = 1000):
        self.seed, self.length = seed, length
        self._worlds: tuple[int, Worlds] | None = None

    def __len__(self) -> int:
        return self.length

    def recording(self, index: int) -> VirtualSensor:
        """The sensor of scan `index` and how well it sees."""
        return draw_recording(np.random.default_rng((self.seed, index // SHARING, 3)))

    def image(self, index: int) -> RangeImage:
        """(64, 1024) image of scan `index`, in the sensor of its recording."""
        seen, number = self.recording(index), index // POSES
        if self._worlds is None or self._worlds[0] != number:
            density = draw_density(np.random.default_rng((self.seed, number, 4)))
            self._worlds = (number, Worlds(self.seed, HIGHEST, density=density))
        return SyntheticStreets(self.seed, self.length, seen.sensor, optics=seen.optics, worlds=self._worlds[1]).image(
            index
        )


def draw_recording(rng: np.random.Generator) -> VirtualSensor:
    """KITTI's sensor, a few centimetres and half a degree off, each laser's loss, and its response, those of a day."""
    tilt = (float(rng.normal(0, 0.6)), float(rng.normal(0, 0.5)))
    elevations = np.array(KITTI.elevations) * rng.uniform(0.99, 1.025) + rng.normal(0, 0.05)
    mount = float(np.clip(rng.normal(1.75, 0.08), 1.5, 2.0))
    surfaces = TABLE[:, :3] * np.exp(rng.normal(0, (0.12, 0.2, 0.2), (len(TABLE), 3)))
    surfaces[:, 0] += rng.normal(0, 0.02, len(TABLE))
    own = rng.normal(0, 1, len(RING_LOSS)) * rng.uniform(0, 0.03)
    optics = Optics(
        loss=tuple((np.array(RING_LOSS) * rng.uniform(0.2, 1.3) + own).tolist()),
        dip=tuple((np.array(RING_DIP) * rng.uniform(0, 1.1)).tolist()),
        shift=tuple((np.array(RING_SHIFT) * rng.uniform(0, 1.3)).tolist()),
        strength=float(rng.uniform(-0.02, 0.06)),
        gamma=float(rng.uniform(0.65, 1.25)),
        scale=float(rng.uniform(0.8, 1.25)),
        fade=float(rng.uniform(0.5, 1.2)),
        rough=float(rng.uniform(0.15, 0.9)),
        surfaces=tuple(map(tuple, surfaces.tolist())),
    )
    return VirtualSensor(replace(KITTI, mount=mount, tilt=tilt, elevations=tuple(elevations.tolist())), optics)


def draw_density(rng: np.random.Generator) -> Density:
    """More green, people, riders and works than usual, and kerbs of 2 to 14 cm; since 2026-11-25 also heavy vehicles,
    fences of more kinds, crash barriers, panels and garages, and riders, people and bicycles of more shapes, in the
    same worlds."""
    later, last = rng.spawn(1)[0], rng.spawn(1)[0]
    return Density(
        traffic=float(rng.choice([1, 1.5, 2])),
        pedestrians=float(rng.choice([1, 2, 4])),
        vegetation=float(rng.choice([1, 2, 2, 3])),
        groups=float(rng.choice([0, 0.5, 1])),
        motorcycles=float(rng.choice([0, 1])),
        works=float(rng.choice([0, 0, 0.7])),
        kerbs=float(rng.uniform(0.15, 1.2)),
        heavy=float(later.choice([0, 0.5, 1.5])),
        walls=float(later.choice([0, 1, 2, 3])),
        barriers=float(later.choice([0, 0, 0.5, 1.5])),
        panels=float(later.choice([0, 0.7, 2])),
        garages=float(later.choice([0, 0, 1])),
        cyclists=float(last.choice([0, 0, 1])),
        riders=float(last.choice([0, 1, 3])),
        walkers=float(last.choice([0, 2, 5])),
        racks=float(last.choice([0, 0.7, 1.5])),
    )
