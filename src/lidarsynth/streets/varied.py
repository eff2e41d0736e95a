"""Streets of many kinds, seen by virtual sensors: greener, smoother, fuller, with kerbs of any height.

`VirtualStreets` varies the sensor alone: every world has as much of everything, kerbs of 12 cm and leaves as rough as
those that the streets of one recording were fitted with. Real streets have smoother greenery, and more of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.areas import Density
from lidarsynth.streets.hdl64e import NAME
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.recordings import draw_density, draw_recording
from lidarsynth.streets.virtual import SHARING, WIDEST, VirtualSensor, VirtualStreets, draw_sensor
from lidarsynth.streets.world import POSES

USUAL = 0.25  # share of worlds and of sensors that are as `VirtualStreets` has them


class VariedStreets(VirtualStreets):
    """As `VirtualStreets`, but three in four worlds differ in density and kerbs, three in four sensors see surfaces
    less rough, some of them farther, and KITTI's own is that of another day (`draw_recording`)."""

    def __init__(self, seed: int = 0, length: int = 1000):
        super().__init__(seed, length)
        self._world: tuple[int, Worlds] | None = None

    def sensor(self, index: int) -> VirtualSensor:
        """The sensor of scan `index`, as it is."""
        rng = np.random.default_rng((self.seed, index // SHARING, 2))
        seen = draw_sensor(rng)
        if rng.random() < USUAL:
            return seen
        if seen.sensor == SENSORS[NAME]:
            return draw_recording(rng)
        strength = float(rng.uniform(0.0, 0.3)) if rng.random() < 0.4 else seen.optics.strength
        return replace(seen, optics=replace(seen.optics, rough=float(rng.uniform(0.15, 0.9)), strength=strength))

    def pair(self, index: int) -> tuple[RangeImage, RangeImage]:
        """`(perfect, seen)` of scan `index`, as `SyntheticStreets.pair`; of KITTI's sensor on whatever day, as its own
        rays, which is all that users can say of theirs."""
        perfect, seen = super().pair(index)
        if seen.sensor.name != NAME:
            return perfect, seen
        return replace(perfect, sensor=SENSORS[NAME]), replace(seen, sensor=SENSORS[NAME])

    def density(self, number: int) -> Density:
        """How much there is of all in the world of that number."""
        rng = np.random.default_rng((self.seed, number, 4))
        return Density() if rng.random() < USUAL else replace(draw_density(rng), parking=float(rng.uniform(0.3, 1.5)))

    def _of(self, index: int) -> SyntheticStreets:
        number = index // POSES
        if self._world is None or self._world[0] != number:
            self._world = (number, Worlds(self.seed, WIDEST, density=self.density(number)))
            self._streets = None
        self._worlds = self._world[1]
        return super()._of(index)
