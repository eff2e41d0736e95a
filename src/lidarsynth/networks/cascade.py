"""Coarse first, then fill: networks that generate and complete the scans of any sensor."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from lidarsynth.networks.between_beams import BetweenBeams
from lidarsynth.networks.between_columns import BetweenColumns
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.grid_judge import GridJudge

# How much further from the guide's velocity, and between which log-SNR: at more noise it would make streets alike, at
# less it would sharpen nothing (Kynkäänniemi et al. 2024).
GUIDANCE, GUIDED = 1.5, (-3.0, 3.0)
REST = 0.05  # of noise that samplers leave: chosen by street-2 (docs/generation.md)


class Cascade(nn.Module):
    """Holds `coarse` (noise -> a grid of 16 beams x 128 columns) and `fill` (known pixels -> all pixels).

    guide  a smaller and worse network of the same task as `coarse`: where both err alike, it errs more, and away from
           it is where grids are likelier (autoguidance, Karras et al. 2024)
    columns  draws such a grid column by column, for generation; `coarse` alone can go around what is known
    between  draws the columns between those, twice over
    beams    draws the beams between those, then, twice over
    likeliest  a fill that has learned the image of least error alone, which completion gives; `fill` draws samples
    observer   a fill that has learned what a sensor reports of surfaces alone, which `realise` gives
    classes    says of each return what it is of
    inside     the same of scans that were taken inside a building
    indoors    says which scans are; `inside` does, where there is none
    drawn      the same of scans in the making, whose surfaces are smoother than any recorded one's
    judge      says of drawn grids what the odds are that they are a street's
    """

    def __init__(
        self,
        coarse: CoarseUNet,
        fill: FillUNet,
        guide: CoarseUNet | None = None,
        columns: ColumnTransformer | None = None,
        between: BetweenColumns | None = None,
        beams: BetweenBeams | None = None,
        likeliest: FillUNet | None = None,
        observer: FillUNet | None = None,
        classes: ClassUNet | None = None,
        judge: GridJudge | None = None,
        inside: ClassUNet | None = None,
        drawn: ClassUNet | None = None,
        indoors: ClassUNet | None = None,
    ):
        super().__init__()
        self.coarse, self.fill, self.guide, self.columns, self.between = coarse, fill, guide, columns, between
        self.beams, self.likeliest, self.observer, self.classes = beams, likeliest, observer, classes
        self.judge, self.inside, self.drawn, self.indoors = judge, inside, drawn, indoors

    @property
    def surest(self) -> FillUNet:
        """The fill for the image of least error: `likeliest` where there is one."""
        return self.fill if self.likeliest is None else self.likeliest

    def velocity(self, x_t: Tensor, log_snr: Tensor, rays: Tensor) -> Tensor:
        """What `coarse` answers, led away from the guide's answer."""
        velocity = self.coarse(x_t, log_snr, rays)
        within = (GUIDED[0] < log_snr) & (log_snr < GUIDED[1])
        if self.guide is None or not within.any():
            return velocity
        further = GUIDANCE * within[:, None, None, None].to(velocity)
        return velocity + further * (velocity - self.guide(x_t, log_snr, rays))

    @torch.no_grad()
    def settled(self, x_0: Tensor, rays: Tensor) -> Tensor:
        """Samples without the rest of their noise, in which neighbouring pixels disagree: waves on flat ground.

        As if x_0 were scaled to x_t of t = REST, of which `coarse` says the rest.
        """
        x_t = (1 - REST) * x_0
        log_snr = torch.full((len(x_0),), 2 * math.log((1 - REST) / REST), device=x_0.device)
        return x_t - REST * self.coarse(x_t, log_snr, rays)
