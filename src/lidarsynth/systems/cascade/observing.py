"""How an observer learns what one sensor reports of surfaces: from its real scans, whose holes are closed first."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.fill_unet import NOISES, Filled, FillUNet, Known
from lidarsynth.networks.rays import Rays, decode_range, padded
from lidarsynth.networks.things import draw_on_things, things
from lidarsynth.systems.cascade.examples import FARTHEST, CascadeBatch, Seen
from lidarsynth.systems.cascade.known import known_of, rays_told
from lidarsynth.systems.cascade.lessons import AS_FAR
from lidarsynth.systems.cascade.scores import energy_score, joined, mean_of, truth
from lidarsynth.training.randomness import sample_rng

REACH = math.radians(2.8)  # to either side: of streets' holes, 92 % of those with a surface, and 4 % sky


class ObserverObjective(nn.Module):
    """`objective(batch)` -> `observed` (n,): energy scores of two draws, with the cross-entropy of returning and the
    error of the mean reflectance.

    Surfaces are those of streets cast perfectly, where a crop has them. Of all other crops the holes are closed by
    `closing`, which does not learn here.

    shining  whether streets teach how bright surfaces are, and not only which rays return
    """

    def __init__(self, network: FillUNet, closing: FillUNet, shining: bool):
        super().__init__()
        self.network, self._close, self._shining = network, closing.forward, shining

    def forward(self, batch: CascadeBatch) -> dict[str, Tensor]:
        seen, count, seeds = batch.seen, len(batch.crops.seeds), batch.crops.seeds
        assert seen is not None
        known, lit = self._surfaces(seen)
        each = list(zip(things(known.metres, seen.rays), seeds, strict=True))
        noise = torch.cat([draw_on_things(of, sample_rng(seed, 3, k)) for k in (0, 1) for of, seed in each])
        twice = (type(part)(*(torch.cat([t, t]) for t in part)) for part in (known, seen.rays))
        filled = self.network(*twice, noise.to(seen.metres))
        judged = torch.cat([torch.ones_like(lit), torch.ones_like(lit), lit], 1)
        first, second = (
            judged * joined(Filled(*(p[h] for p in filled[:3])), known, seen.rays)
            for h in (slice(None, count), slice(count, None))
        )
        returned = on_surface(seen.metres, known.metres)
        metres, reflectance = known.metres * returned, seen.reflectance * returned
        score = energy_score(first, second, judged * truth(metres, reflectance, seen.rays))
        chance = F.binary_cross_entropy_with_logits(filled.logit[:count], returned.float(), reduction="none")
        middle = (filled.reflectance[:count] + filled.reflectance[count:]) / 2
        error = mean_of((middle - reflectance).abs(), returned & (lit > 0))
        return {"observed": score + 0.5 * mean_of(chance, known.returned) + error}

    @torch.no_grad()
    def _surfaces(self, seen: Seen) -> tuple[Known, Tensor]:
        """What rays meet, and nothing else; and 1 where it is told how bright that is, 0 elsewhere, (b, 1, 1, 1)."""
        returned, nothing = seen.metres > 0, torch.zeros_like(seen.metres, dtype=torch.bool)
        told = returned | (seen.rays.blocked > 0)
        closed = _closed(self._close, Known(seen.metres, seen.reflectance, told, returned, returned), seen.rays)
        cast = (seen.surface > 0).flatten(1).any(1)[:, None, None, None]
        metres = torch.where(cast, seen.surface, closed)
        metres = metres * (metres < FARTHEST)
        return Known(metres, torch.zeros_like(metres), nothing, metres > 0, nothing), (~cast | self._shining).float()


@torch.inference_mode()
def closed(fill: FillUNet, image: RangeImage) -> RangeImage:
    """What the rays of a recorded image meet, as a simulator would cast it: in holes that `before_something` finds as
    far as the fill says, on other rays where they returned from. Without reflectance."""
    height, width = image.shape
    rays, size, device = rays_told(image.sensor), padded(image.sensor), next(fill.parameters()).device
    told = image.mask | (rays.blocked[0, 0, :height, :width] > 0).numpy()
    known = known_of(image.range[None], image.reflectance[None], told[None], True, size)
    rays = Rays(*(part.to(device) for part in rays))
    metres = _closed(fill, Known(*(part.to(device) for part in known)), rays, turn=width)
    metres = np.where(image.mask, image.range, metres[0, 0, :height, :width].cpu().numpy())
    return RangeImage(metres, np.zeros_like(metres), metres > 0, image.sensor)


def _closed(fill: Callable[..., Filled], known: Known, rays: Rays, turn: int = 0) -> Tensor:
    """(B, 1, H, W) metres of what rays meet; 0 for those that meet nothing."""
    noise = known.metres.new_zeros(len(known.told), NOISES, *known.told.shape[2:])
    metres = decode_range(fill(known, rays, noise).code)
    hole = before_something(known.returned, rays.across, turn) & ~known.told
    return torch.where(known.returned, known.metres, torch.where(hole, metres, 0.0))


def before_something(returned: Tensor, across: Tensor, turn: int = 0) -> Tensor:
    """Rays (B, 1, H, W) that must meet something: one above them returned, or one on either side within `REACH`.

    across  azimuth step, radians (B, 1, 1, 1)
    turn    columns of a whole turn, of which the image is one, and the rest the same again; 0 = a part of one
    """
    above = returned.cumsum(2) > 0
    whole = torch.cat([returned[..., :turn]] * 3, -1) if turn else returned
    columns = torch.arange(whole.shape[-1], device=whole.device)
    left = torch.where(whole, columns, -(10**6)).cummax(-1).values
    right = torch.where(whole, columns, 10**6).flip(-1).cummin(-1).values.flip(-1)
    beside = torch.maximum(columns - left, right - columns) <= (REACH / across).round()
    if turn:
        beside = beside[..., turn + torch.arange(returned.shape[-1]) % turn]
    return above | beside


def on_surface(measured: Tensor, surface: Tensor) -> Tensor:
    """Where what was measured, metres, is of the surface that the ray meets, and not of something behind a pane."""
    near, share = AS_FAR
    return (measured > 0) & (surface > 0) & ((measured - surface).abs() < near + share * surface)
