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
from lidarsynth.streets.virtual import SHARING, WIDEST, VirtualSensor, draw_sensor
from lidarsynth.streets.world import POSES

USUAL = 0.25  # share of worlds and of sensors that are as `VirtualStreets` has them


class VariedStreets:
    """As `VirtualStreets`, but three in four worlds differ in density and kerbs, three in four sensors see surfaces
    less rough, some of them farther, and KITTI's own is that of another day (`draw_recording`).

    `len`, `sensor(i)`, `density(number)` of a world, `image(i)`, `pair(i)`. Scan i of a seed depends on nothing else.
    Raises as `SyntheticStreets`.
    """

    def __init__(self, seed: int = 0, length: int = 1000):
        self.seed, self.length = seed, length
        self._worlds: tuple[int, Worlds] | None = None
        self._streets: tuple[int, SyntheticStreets] | None = None

    def __len__(self) -> int:
        return self.length

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

    def density(self, number: int) -> Density:
        """How much there is of all in the world of that number."""
        rng = np.random.default_rng((self.seed, number, 4))
        return Density() if rng.random() < USUAL else replace(draw_density(rng), parking=float(rng.uniform(0.3, 1.5)))

    def image(self, index: int) -> RangeImage:
        """(H, W) image of scan `index`, with the surfaces that its rays meet."""
        perfect, seen = self.pair(index)
        return replace(seen, surface=perfect.range)

    def pair(self, index: int) -> tuple[RangeImage, RangeImage]:
        """`(perfect, seen)` of scan `index`, as `SyntheticStreets.pair`; of KITTI's sensor on whatever day, as its own
        rays, which is all that users can say of theirs."""
        perfect, seen = self._of(index).pair(index)
        if seen.sensor.name != NAME:
            return perfect, seen
        return replace(perfect, sensor=SENSORS[NAME]), replace(seen, sensor=SENSORS[NAME])

    def _of(self, index: int) -> SyntheticStreets:
        """The streets as the sensor of scan `index` sees them."""
        number, group = index // POSES, index // SHARING
        if self._worlds is None or self._worlds[0] != number:
            self._worlds = (number, Worlds(self.seed, WIDEST, density=self.density(number)))
        if self._streets is None or self._streets[0] != group:
            seen, worlds = self.sensor(index), self._worlds[1]
            streets = SyntheticStreets(self.seed, self.length, seen.sensor, optics=seen.optics, worlds=worlds)
            self._streets = (group, streets)
        return self._streets[1]
