"""The fill of a cascade as one module of plain images, for one sensor: what is exported."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.fill_unet import NOISES, Known
from lidarsynth.networks.rays import COLUMNS, Rays, decode_range, padded, rays_of
from lidarsynth.streets.hdl64e import dimness, hidden
from lidarsynth.streets.kittis_car import Outline, outlined
from lidarsynth.systems.cascade.beneath import certain
from lidarsynth.systems.cascade.confidence import confidence
from lidarsynth.systems.cascade.floating import onto_surfaces
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.response import AS_STREETS, USUAL
from lidarsynth.systems.cascade.speckle import calmed
from lidarsynth.systems.graph import Graph

SAYS = {
    "range": "metres, 0 where nothing returned or nothing is known",
    "reflectance": "0 to 1, 0 where nothing is known; 0 everywhere where there is none, and then filled in too",
    "known": "1 where the pixel is known, also to be empty; else 0",
    "confidence": "chance that the pixel's ray returns within 0.3 m + 2 %; 1 where known",
}


class FillGraph(nn.Module):
    """(range, reflectance, known), (1, 1, H, W) each -> the same two filled, and confidence where the model has it.

    Rays are constants; with open columns those of a sensor that looks alike in all directions.
    """

    def __init__(self, model: CascadeModel, open_columns: bool):
        super().__init__()
        self.model, self.open_columns, sensor = model, open_columns, model.sensor
        self.fill = model.network.surest
        blocked = outlined(sensor, Outline())  # KITTI's car as scans that are not moved show it
        rays = rays_of(sensor, blocked, dimness=dimness(sensor))
        if open_columns:
            rays = Rays(*(part[..., :1] for part in rays))
        for name, part in zip(Rays._fields, rays, strict=True):
            self.register_buffer(name, part.contiguous())
        closed = torch.from_numpy(blocked[None, None, :, : 1 if open_columns else None].copy())
        self.register_buffer("closed", closed)
        self.register_buffer("around", torch.from_numpy(np.arange(padded(sensor)[1]) % sensor.width))

    def forward(self, range: Tensor, reflectance: Tensor, known: Tensor) -> tuple[Tensor, ...]:
        sensor = self.model.sensor
        returned = (known > 0.5) & (range > 0)  # and no other, though a range may stand where a blocked ray is
        closed = self._buffer("closed").expand_as(range)
        told = (known > 0.5) | closed
        metres = self._padded(torch.where(returned, range, 0.0), 0)
        lit = (returned & (reflectance > 0)).flatten(1).any(1)[:, None, None, None]  # else nobody has measured it
        light = self._padded(calmed(reflectance, range, returned & lit), 0)
        answered = metres > 0
        seen = Known(metres, light, self._padded(told.float(), 1) > 0.5, answered, answered & lit)
        rays = self._rays(seen.metres)
        noise = torch.zeros_like(seen.metres).expand(-1, NOISES, -1, -1)
        weights = self.model.experiment.confidence
        filled = certain(self.fill(seen, rays, noise, doubt=weights is not None), seen, closed)
        metres = decode_range(filled.code)[:, :, : sensor.height, : range.shape[3]]
        answers = filled.logit[:, :, : sensor.height, : range.shape[3]] > 0
        answers = answers & (metres <= sensor.max_range) & (metres >= sensor.min_range) & ~closed
        shade = AS_STREETS._replace(plain=0.0 if self.model.tuned else USUAL).mixed(filled)
        shade = torch.where(lit, shade, filled.reflectance)[:, :, : sensor.height, : range.shape[3]].clamp(0.0, 1.0)
        answers = returned | (answers & ~told)
        full = onto_surfaces(torch.where(answers, torch.where(returned, range, metres), 0.0), told)
        light = torch.where(answers, torch.where(returned & lit, reflectance, shade), 0.0)
        if weights is None:
            return full, light
        sure = confidence(filled, rays, weights)[:, :, : sensor.height, : range.shape[3]]
        return full, light, torch.where(told, 1.0, sure)

    def _padded(self, part: Tensor, below: float) -> Tensor:
        extra = padded(self.model.sensor)[0] - self.model.sensor.height
        part = F.pad(part, (0, 0, 0, extra), value=below) if extra else part
        return part if self.open_columns or part.shape[3] % COLUMNS == 0 else part[..., self._buffer("around")]

    def _rays(self, like: Tensor) -> Rays:
        """The constants, as large as the image where the network's own are."""
        rays = Rays(*(self._buffer(name) for name in Rays._fields))
        if not self.open_columns:
            return rays
        wide = {name: getattr(rays, name).expand_as(like) for name in ("elevation", "azimuth", "ground", "blocked")}
        across = 2 * torch.pi / torch.ones_like(like[:, :, :1]).sum(3, keepdim=True)
        return rays._replace(**wide, inside=rays.inside.expand_as(like), across=across)

    def _buffer(self, name: str) -> Tensor:
        return self.get_buffer(name)


def fill_graph(model: CascadeModel, open_columns: bool) -> Graph:
    """Completion in one step by the model, in its sensor. Raises ValueError where columns must be open and differ."""
    sensor = model.sensor
    if open_columns and (hidden(sensor).any() or any(sensor.tilt)):
        raise ValueError(f"{sensor.name}: expected a sensor without tilt and blocked rays for any number of columns, "
                         "found one whose columns differ; leave --any-columns out")  # fmt: skip
    example = {name: torch.zeros(1, 1, sensor.height, sensor.width) for name in ("range", "reflectance", "known")}
    example["known"][:, :, ::4] = 1
    example["range"][:, :, ::4] = 10
    outputs = ("filled_range", "filled_reflectance", "confidence")
    module = FillGraph(model, open_columns).eval()
    outputs = outputs if model.experiment.confidence is not None else outputs[:2]
    return Graph("completion in one step", module, example, outputs, SAYS, open_columns, COLUMNS)
