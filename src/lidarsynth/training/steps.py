"""One training step's loss: generation (R2DM eq. 2-3) and completion of randomly hidden pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.experiment import Experiment


def augment(x_0: Tensor, rng: torch.Generator, roll: bool, mirror: bool) -> Tensor:
    """x_0 (B, C, H, W), each sample turned by any number of columns and mirrored left-right half of the time."""
    batch, width = len(x_0), x_0.shape[-1]
    shifts = torch.randint(width, (batch,), generator=rng).tolist()
    flips = torch.rand(batch, generator=rng) < 0.5
    if roll:
        x_0 = torch.stack([torch.roll(x, shift, dims=-1) for x, shift in zip(x_0, shifts, strict=True)])
    if mirror:
        x_0 = torch.where(flips[:, None, None, None], x_0.flip(-1), x_0)
    return x_0


def training_loss(experiment: Experiment, denoiser: Denoiser, x_0: Tensor, rng: torch.Generator) -> dict[str, Tensor]:
    """Losses of a batch x_0 (B, 2, H, W), scalars: `loss` to minimise, and its parts `generation`, `completion`.

    The first `generation_share` of the batch learns p(x_0), the rest p(x_0 | known pixels): for a network that is told
    the known pixels, cf. conditional diffusion for LiDAR upsampling (Helgesen et al. 2024, arXiv 2405.04889).
    """
    x_0 = augment(x_0, rng, experiment.data.roll, experiment.data.mirror)
    count = round(experiment.training.generation_share * len(x_0))
    parts = {}
    if count:
        parts["generation"] = generation_loss(experiment, denoiser, x_0[:count], rng)
    if count < len(x_0):
        parts["completion"] = completion_loss(denoiser, x_0[count:], rng)
    share = count / len(x_0)
    total = share * parts.get("generation", 0) + (1 - share) * parts.get("completion", 0)
    return {"loss": torch.as_tensor(total), **parts}


def noise(x_0: Tensor, rng: torch.Generator) -> Tensor:
    """Unit Gaussian noise like x_0, drawn on the generator's device."""
    return torch.randn(x_0.shape, generator=rng, device=rng.device).to(x_0)


def generation_loss(experiment: Experiment, denoiser: Denoiser, x_0: Tensor, rng: torch.Generator) -> Tensor:
    """Mean loss at uniformly drawn times, scalar."""
    diffusion = experiment.diffusion
    t = torch.rand(len(x_0), generator=rng, device=rng.device).to(x_0)
    return denoiser.loss(
        x_0,
        t,
        noise(x_0, rng),
        loss=diffusion.loss,
        gamma=diffusion.gamma,
        mean_weight=diffusion.mean_weight,
    ).mean()


def completion_loss(denoiser: Denoiser, x_0: Tensor, rng: torch.Generator) -> Tensor:
    """Mean absolute error of the hidden pixels, scalar; half of the times are 1, where completion begins.

    The absolute error has the median as its optimum, which is the same in metres and in any depth code.
    """
    known = random_known(x_0, rng).to(x_0)
    t = torch.rand(2, len(x_0), generator=rng).to(x_0)
    t = torch.where(t[1] < 0.5, t[0], torch.ones_like(t[0]))
    return denoiser.given(x_0, known).loss(x_0, t, noise(x_0, rng), mask=1 - known, loss="l1", gamma=None).mean()


def random_known(x_0: Tensor, rng: torch.Generator) -> Tensor:
    """Bool (B, C, H, W): per sample a random pattern of known pixels, of one of six kinds.

    Half of the samples also hide where the sensor measured nothing (-1 in x_0), as in a scan whose drop-outs are to be
    filled; a tenth hide all reflectance.
    """
    known = []
    for x in x_0:
        draw = torch.rand(10, generator=rng).tolist()
        mask = _pattern(x.shape[1], x.shape[2], draw, rng).expand(x.shape).clone()
        if draw[8] < 0.5:
            mask &= x[:1] > -1
        if draw[9] < 0.1:
            mask[1] = False
        known.append(mask)
    return torch.stack(known)


def _pattern(height: int, width: int, draw: list[float], rng: torch.Generator) -> Tensor:
    """Bool (H, W): even beams (half of all), uneven beams, points, a lost sector, a lost rectangle, or beams + points."""
    mask = torch.ones(height, width, dtype=torch.bool)
    if draw[0] < 0.6:  # every k-th beam, k = 2, 3, 4, 4, 4, 6, 8
        step = (2, 3, 4, 4, 4, 6, 8)[int(draw[1] * 7)]
        first = 0 if draw[2] < 0.5 else int(draw[3] * step)
        mask = torch.zeros_like(mask)
        mask[first::step] = True
    elif draw[0] < 0.7:  # any beams, one in eight to one in two
        mask = mask & (torch.rand(height, 1, generator=rng) < 1 / 8 + 3 / 8 * draw[1])
    if draw[0] > 0.7 and draw[0] < 0.82 or draw[4] < 0.1:  # a share of the points, 2 % to 80 %
        share = math.exp(math.log(0.02) + draw[5] * math.log(40))
        mask = mask & (torch.rand(height, width, generator=rng) < share)
    if 0.82 <= draw[0] < 0.91:  # a sector of 20 to 180 degrees is lost
        lost = int(width * (20 + 160 * draw[1]) / 360)
        mask[:, :lost] = False
        mask = mask.roll(int(draw[2] * width), dims=1)
    if draw[0] >= 0.91:  # a rectangle is lost
        rows, columns = int(height * (0.1 + 0.9 * draw[1])), int(width * (0.02 + 0.2 * draw[2]))
        top = int(draw[3] * (height - rows + 1))
        mask[top : top + rows, :columns] = False
        mask = mask.roll(int(draw[6] * width), dims=1)
    return mask
