"""`UpsamplingModel`: LiDAR-SR, ILN and LIIF put beams between the known ones of a scan; ranges only.

Images of these networks begin with the lowest beam, ours with the highest; both turn clockwise from straight behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.samplers import generators
from lidarsynth.experiment.record import Experiment, Upsampling
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.lidar_sr import LidarSR, mc_dropout, remove_uncertain
from lidarsynth.systems.any_sensor import imaged_by
from lidarsynth.systems.description import Description
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.scan_model import OnStep, ScanModel
from lidarsynth.systems.upsampling.description import DESCRIPTION

HARDLY = 0.02  # share of a row's pixels; of a beam with fewer known ones nothing is known
PIECE = 16_384  # queries at once: what bounds the memory of ILN


@dataclass(frozen=True, repr=False)
class UpsamplingModel(ScanModel):
    """A trained network with the sensor of its images.

    LiDAR-SR fills a grid, ILN and LIIF answer any direction. The experiment's group `upsampling` tells which beams are
    known.
    """

    network: LidarSR | ILN | LIIF
    sensor: Sensor
    experiment: Experiment
    description: ClassVar[Description] = DESCRIPTION
    any_sensor: ClassVar[bool] = True

    def into(self, sensor: Sensor | str) -> UpsamplingModel:
        """The same network with images of another sensor. Raises ValueError where LiDAR-SR cannot have that size."""
        sensor = get_sensor(sensor) if isinstance(sensor, str) else sensor
        if isinstance(self.network, LidarSR) and (sensor.height % 16 or sensor.width % 16):
            raise ValueError(f"{self.experiment.name}: expected a sensor whose beams and columns are divisible by 16, "
                             f"found {sensor.height} x {sensor.width}")  # fmt: skip
        return replace(self, sensor=sensor, experiment=imaged_by(self.experiment, sensor))

    def resolved(self, how: Filling) -> Filling:
        """The request with this model's own choices.

        method  `network`: one pass; `monte-carlo`, LiDAR-SR only: the mean of `steps` passes under dropout, by default
                the experiment's, empty where they disagree; `auto`: monte-carlo where the network can

        Raises ValueError for other words, and for what the method would ignore.
        """
        name, samples = self.experiment.name, isinstance(self.network, LidarSR)
        words = ("auto", "monte-carlo", "network") if samples else ("auto", "network")
        if how.method not in words:
            raise ValueError(f"{name}: expected a method of {', '.join(words)}, found {how.method!r}")
        if how.sampler is not None:
            raise ValueError(f"{name}: expected no sampler, for nothing is sampled, found {how.sampler!r}")
        how.at_least_one().without("resamples", reason="which only repaint has")
        if samples and how.method != "network":
            return replace(how, method="monte-carlo", steps=self._group.passes if how.steps is None else how.steps)
        if how.steps not in (None, 1):
            raise ValueError(f"{name}: expected 1 step, the one pass of method network, found {how.steps}")
        return replace(how, method="network", steps=1)

    def calls(self, how: Filling) -> int:
        """How many passes of the network a resolved request takes."""
        assert how.steps is not None
        return how.steps

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The beams between the known ones; known pixels come back exactly, new ones without reflectance.

        LiDAR-SR needs the beams it was trained with, such as every fourth from row 0; ILN and LIIF any beams, two at
        least, and leave rows empty that are a spacing or more beyond the outermost. Raises ValueError when other pixels
        than whole beams are missing.
        """
        rows = self._beams(known)
        columns = self._group.factor[1]
        low = image.keep(known).range[rows, ::columns]
        if isinstance(self.network, LidarSR):
            place = (np.arange(self.sensor.height) - self._group.first) / self._group.factor[0]
            filled = self._grid(low, how, on_step)[self._made(place, len(low))]
        else:
            row = places(self.sensor.elevations, np.asarray(self.sensor.elevations)[rows])
            filled = self._asked(low, row, np.arange(self.sensor.width) / columns, on_step)
        return with_known(self._image(filled), image, known, keep_reflectance=True)

    def fill_beams(
        self,
        scan: Scan,
        sensor_in: Sensor,
        sparse: RangeImage,
        known: np.ndarray,
        how: Filling,
        on_step: OnStep = None,
    ) -> RangeImage:
        """A scan of any sensor, asked from all beams of `sensor_in` as they are.

        Rows farther than one spacing beyond these beams stay empty. LiDAR-SR makes `factor` times as many beams, of
        which each row of the image takes the one next to it. Raises ValueError for a sensor of one beam.
        """
        if sensor_in.height < 2:
            raise ValueError(f"{self.experiment.name}: expected a sensor with at least 2 beams, found {sensor_in.name}")
        seen = replace(sensor_in, min_range=0.0) if self._group.min_range else sensor_in  # near returns are no gaps
        low = project(scan, seen, "auto", width=self._columns(sensor_in)).range
        row = places(self.sensor.elevations, sensor_in.elevations)
        column = (np.arange(self.sensor.width) + 0.5) / self.sensor.width * low.shape[1] - 0.5
        if isinstance(self.network, LidarSR):
            dense = self._grid(low, how, on_step)
            made = np.rint((column + 0.5) * self._group.factor[1] - 0.5).astype(int).clip(0, dense.shape[1] - 1)
            filled = dense[np.ix_(self._made(row, len(low)), made)] * in_view(row, len(low))[:, None]
        else:
            filled = self._asked(low, row, column, on_step)
        return with_known(self._image(filled), sparse, known, keep_reflectance=True)

    @property
    def _group(self) -> Upsampling:
        return self.experiment.upsampling or Upsampling()

    def _beams(self, known: np.ndarray) -> np.ndarray:
        """(h,) the rows that are known. Raises ValueError where these are not what the network needs."""
        rows = np.flatnonzero(known.mean(axis=1) > HARDLY)
        name, height = self.experiment.name, len(known)
        found = f"known pixels in {len(rows)} of {height} rows, {', '.join(map(str, rows[:4]))}, ..."
        if len(rows) == height or len(rows) < 2:
            raise ValueError(f"{name}: expected whole beams to be missing between known ones, such as beams:4 leaves, "
                             f"found {found}")  # fmt: skip
        if not isinstance(self.network, LidarSR):
            return rows
        factor, first = self._group.factor[0], self._group.first
        expected = np.arange(first, height, factor)
        if not set(rows) <= set(expected) or len(rows) < 0.75 * len(expected):  # some beams may see only sky
            raise ValueError(f"{name}: expected the known beams that it was trained with (beams:{factor}:{first}), "
                             f"found {found}")  # fmt: skip
        return expected

    def _columns(self, sensor_in: Sensor) -> int:
        """How many columns the known rows of another sensor get: no more than it has, for these would be gaps."""
        width = min(self.sensor.width // self._group.factor[1], sensor_in.width)
        return width // 16 * 16 if isinstance(self.network, LidarSR) else width

    def _made(self, place: np.ndarray, count: int) -> np.ndarray:
        """(H,) which of the rows that LiDAR-SR makes of `count` is next to fractional places (H,) among these."""
        group, made = self._group, count * self._group.factor[0]
        row = place * (made - 1) / (count - 1) if group.spread else place * group.factor[0] + group.first
        return np.rint(row).astype(int).clip(0, made - 1)

    @torch.no_grad()
    def _grid(self, low: np.ndarray, how: Filling, on_step: OnStep) -> np.ndarray:
        """LiDAR-SR's ranges, metres: (h, w) -> (h, w) times the factor."""
        assert isinstance(self.network, LidarSR)
        x = self._scaled(low)[None, None]
        if how.method == "network":
            y = self.network(x)
            if on_step is not None:
                on_step()
        else:
            mean, std = mc_dropout(self.network, x, generators(how.seed, 1)[0], self.calls(how), on_step)
            y = remove_uncertain(mean, std, self._group.threshold)
        return (y[0, 0].flip(0) * self._group.norm).cpu().numpy()

    @torch.no_grad()
    def _asked(self, low: np.ndarray, row: np.ndarray, column: np.ndarray, on_step: OnStep) -> np.ndarray:
        """ILN's and LIIF's ranges (H, W) in metres at the places (H,), (W,) of `queries_at`, in ranges (h, w)."""
        assert not isinstance(self.network, LidarSR)
        x = (2 * self._scaled(low) - 1)[None, None]
        features = self.network.encode(x)
        queries = queries_at(row, column, low.shape).to(x.device)
        pieces = [self.network.decode(x, features, piece[None])[0] for piece in queries.split(PIECE)]
        if on_step is not None:
            on_step()
        found = ((torch.cat(pieces) + 1) / 2 * self._group.norm).view(len(row), len(column)).cpu().numpy()
        return found * in_view(row, len(low))[:, None]

    def _scaled(self, low: np.ndarray) -> Tensor:
        distance = torch.from_numpy(np.ascontiguousarray(low)).to(next(self.network.parameters()).device)
        return scaled(distance, self._group).flip(0)

    def _image(self, distance: np.ndarray) -> RangeImage:
        """Ranges (H, W) in metres as an image, empty beyond the limits."""
        near, far = max(self.sensor.min_range, self._group.min_range), min(self.sensor.max_range, self._group.max_range)
        mask = (distance > near) & (distance < far)
        return RangeImage((distance * mask).astype(np.float32), np.zeros(mask.shape, np.float32), mask, self.sensor)


def scaled(distance: Tensor, group: Upsampling) -> Tensor:
    """Ranges in metres, 0 where nothing returned -> what LiDAR-SR sees: over `norm`, no return as 1, or 0 (Keras).

    Returns nearer than `min_range` are 0, as in both published programs.
    """
    returned = (distance > 0) & (distance <= min(group.max_range, group.norm))
    code = torch.where(distance < group.min_range, 0.0, distance / group.norm)
    return torch.where(returned, code, 0.0 if group.keras else 1.0)


def places(elevations: Sequence[float] | np.ndarray, beams: Sequence[float] | np.ndarray) -> np.ndarray:
    """(H,) where `elevations` (H,) lie among `beams` (h,), as fractional index; both fall, in the same unit.

    Beyond the outermost beams the spacing is that of the two next to there. Raises ValueError for fewer than two.
    """
    if len(beams) < 2:
        raise ValueError(f"expected two known beams at least to put others between, found {len(beams)}")
    wanted, beams = np.asarray(elevations, np.float64), np.asarray(beams, np.float64)
    last = len(beams) - 1
    place = np.interp(-wanted, -beams, np.arange(len(beams)))
    place = np.where(wanted > beams[0], (beams[0] - wanted) / (beams[0] - beams[1]), place)
    return np.where(wanted < beams[-1], last + (beams[-1] - wanted) / (beams[-2] - beams[-1]), place)


def in_view(place: np.ndarray, count: int) -> np.ndarray:
    """Bool: whether places among `count` beams are less than one spacing beyond the outermost."""
    return (place > -1) & (place < count)


def queries_at(row: np.ndarray, column: np.ndarray, size: tuple[int, ...]) -> Tensor:
    """Queries (H W, 2) of ILN, row by row, at fractional rows (H,) from the top and columns (W,) of an image h, w."""
    vertical = (2 * (size[0] - 1 - row) + 1) / size[0] - 1
    horizontal = (2 * column + 1) / size[1] % 2 - 1  # half a pixel behind the last column is the first's edge
    grid = np.meshgrid(vertical, horizontal, indexing="ij")
    return torch.from_numpy(np.stack(grid, axis=-1).reshape(-1, 2).astype(np.float32))
