"""How the cascade learns: the fill by absolute errors and by energy scores, the coarse stage by flow matching.

What a process draws for its share of a batch as a whole, the columns that are judged and spoilt and the pixels that
classes overlap in, depends on how the batch is shared; lessons are of every second image of each share. All else is a
function of (seed, step, position), as with `tuned`, which learns nothing of these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import Schedule
from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.between_beams import BetweenBeams
from lidarsynth.networks.between_columns import BetweenColumns
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import BINS, COLUMNS, LOWEST, ROWS, CoarseUNet
from lidarsynth.networks.column_neighbours import Grid, known_grid, spoilt
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.drafts import LEARNED, drafted
from lidarsynth.networks.fill_unet import NOISES, Filled, FillUNet, Known, draw_noise
from lidarsynth.networks.rays import Rays, encode_range
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade.examples import EVERY, CascadeBatch, Crops, check_labelled, draw, grid
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import NamingObjective
from lidarsynth.systems.cascade.observing import ObserverObjective
from lidarsynth.systems.cascade.scores import (
    SEAM,
    absolute_errors,
    energy_score,
    expected_errors,
    joined,
    misnamed,
    truth,
)
from lidarsynth.systems.cascade.speckle import calmed
from lidarsynth.systems.diffusion.validation import strips
from lidarsynth.training.examples import OF_ANY, Streets, TrainingImages
from lidarsynth.training.randomness import sample_rng
from lidarsynth.training.task import Images, Phase, Task

PARTS = ("sample", "median", "likeliest", "layout", "guide", "columns", "between", "beams", "observed", "named",
         "inside")  # fmt: skip
# Share of the times of the coarse stage that are even in log_snr, from pure noise to EARLIER, where it is decided how
# open a scene is.
EARLY, EARLIER = 0.2, 0.5
FITTED = 256  # streets that the standards of the coarse stage are measured on


class FillObjective(nn.Module):
    """`objective(batch)` -> losses (n,) of the crops: `sample`, energy scores of two draws, and `median`, errors."""

    def __init__(self, network: FillUNet):
        super().__init__()
        self.network = network

    def forward(self, batch: CascadeBatch) -> dict[str, Tensor]:
        n, crops = batch.crops.samples, batch.crops
        return {"sample": self._sample(crops, n), "median": self._median(crops, n)}

    def _sample(self, crops: Crops, n: int) -> Tensor:
        if n == 0:
            return _of_none(self.network)
        known, rays, metres, reflectance, _ = _part(crops, slice(None, n))
        shape = (1, metres.shape[2], metres.shape[3])
        draws = [draw_noise(shape, sample_rng(s, 0, k)) for k in (0, 1) for s in crops.seeds[:n]]
        twice = (type(part)(*(torch.cat([t, t]) for t in part)) for part in (known, rays))
        filled = self.network(*twice, torch.cat(draws).to(metres))
        first, second = (
            joined(Filled(*(p[h] for p in filled[:3])), known, rays) for h in (slice(None, n), slice(n, None))
        )
        return energy_score(first, second, truth(metres, reflectance, rays))

    def _median(self, crops: Crops, n: int) -> Tensor:
        known, rays, metres, reflectance, classes = _part(crops, slice(n, None))
        noise = metres.new_zeros(len(metres), 3, *metres.shape[2:])
        if not len(metres):
            return _of_none(self.network)
        learns = self.network.classes is not None
        filled = self.network(known, rays, noise, classify=learns)
        errors = absolute_errors(filled, known, rays, metres, reflectance)
        return errors + 0.2 * misnamed(filled, rays, classes) if learns else errors


class LikeliestObjective(nn.Module):
    """`objective(batch)` -> `likeliest` (n,): `expected_errors` of the crops that are not drawn."""

    def __init__(self, network: FillUNet):
        super().__init__()
        self.network = network

    def forward(self, batch: CascadeBatch) -> dict[str, Tensor]:
        known, rays, metres, reflectance, _ = _part(batch.crops, slice(batch.crops.samples, None))
        if not len(metres):
            return {"likeliest": _of_none(self.network)}
        known = known._replace(reflectance=calmed(known.reflectance, known.metres, known.lit))
        filled = self.network(known, rays, metres.new_zeros(len(metres), NOISES, *metres.shape[2:]))
        return {"likeliest": expected_errors(filled, known, rays, metres, reflectance)}


def _completed(batch: CascadeBatch) -> int:
    """How many crops learn the most likely image."""
    return len(batch.crops.seeds) - batch.crops.samples


def _of_none(network: nn.Module) -> Tensor:
    """The losses (0,) of no crops, whose gradients are 0: a share of a batch may have none of a kind, and a distributed
    wrapper waits for the gradient of every parameter."""
    return torch.stack([parameter.sum() for parameter in network.parameters()]).sum().expand(0)


class CoarseObjective(nn.Module):
    """`objective(batch)` -> `layout` (n,): squared error of the velocity (Lipman et al. 2023); `guide`, that of the
    network that guides; `columns`, negative log-likelihoods of half of the columns; `between`, of every second column
    of finer grids; `beams`, of every second beam of taller ones; of what there is."""

    def __init__(
        self,
        network: CoarseUNet,
        guide: CoarseUNet | None = None,
        columns: ColumnTransformer | None = None,
        between: BetweenColumns | None = None,
        beams: BetweenBeams | None = None,
    ):
        super().__init__()
        self.network, self.guide, self.columns, self.between, self.beams = network, guide, columns, between, beams

    def forward(self, batch: CascadeBatch) -> dict[str, Tensor]:
        metres, reflectance, rays, standing = batch.grids
        x_0 = self.network.encode(metres, reflectance, standing)
        rngs = [sample_rng(seed, 1, 0) for seed in batch.crops.seeds]
        t = layout_times(self.network.schedule, rngs).to(x_0)
        eps = torch.stack([torch.randn(x_0.shape[1:], generator=rng) for rng in rngs]).to(x_0)
        learners = {"layout": self.network, **({"guide": self.guide} if self.guide else {})}
        denoisers = {part: Denoiser(one, one.schedule, "velocity", clip=False, condition=(rays,))
                     for part, one in learners.items()}  # fmt: skip
        losses = {part: denoiser.loss(x_0, t, eps, gamma=None) for part, denoiser in denoisers.items()}
        if self.columns is not None:
            rng = sample_rng(batch.crops.seeds[0], 2, 0)
            whole = known_grid(metres, reflectance)
            judged = torch.randperm(COLUMNS, generator=rng)[: COLUMNS // 2].to(rays.device)
            draft = self.draft(x_0, eps, rays, standing, rng)
            losses["columns"] = self.columns(whole, rays, draft, judged, spoilt(whole, rng)).sum(1)
        if self.between is not None:
            whole, rays = known_grid(batch.finer.metres, batch.finer.reflectance), batch.finer.rays
            known, hidden = (Grid(*(part[..., k::2] for part in whole)) for k in (0, 1))
            losses["between"] = self.between(known, rays[..., ::2], hidden, rays[..., 1::2]).sum(1)
        if self.beams is not None:
            whole, rays = known_grid(batch.taller.metres, batch.taller.reflectance), batch.taller.rays
            known, hidden = (Grid(*(part[:, k::2] for part in whole)) for k in (0, 1))
            judged = torch.arange(SEAM, rays.shape[-1] - SEAM, device=rays.device)
            losses["beams"] = self.beams(known, rays[:, :, ::2], hidden, rays[:, :, 1::2], judged).sum(1)
        return losses

    @torch.no_grad()
    def draft(self, x_0: Tensor, eps: Tensor, rays: Tensor, standing: Tensor, rng: torch.Generator) -> Tensor:
        """(b, 7, 16, 128) drafts that become x_0, of any of the times that columns learn."""
        low, high = LEARNED
        t = (low + (high - low) * torch.rand(len(x_0), generator=rng)).to(x_0)
        _, alpha, sigma = self.network.schedule.at(t, x_0)
        return drafted(self.network, alpha * x_0 + sigma * eps, t, rays, standing)


def layout_times(schedule: Schedule, rngs: Sequence[torch.Generator]) -> Tensor:
    """(n,) times that the coarse stage learns, one of each generator: sigmoid(1.1 N), and the share EARLY."""
    normal, early, share = (torch.cat([draw(1, generator=rng) for rng in rngs])
                            for draw in (torch.randn, torch.rand, torch.rand))  # fmt: skip
    return torch.where(early < EARLY, schedule.along(1, EARLIER, share).float(), torch.sigmoid(1.1 * normal))


def _part(crops: Crops, chosen: slice) -> tuple[Known, Rays, Tensor, Tensor, Tensor]:
    known, rays = (type(part)(*(t[chosen] for t in part)) for part in (crops.known, crops.rays))
    return known, rays, crops.metres[chosen], crops.reflectance[chosen], crops.classes[chosen]  # type: ignore[return-value]


def fit_standard(network: CoarseUNet, images: Sequence[RangeImage]) -> None:
    """Measure mean and spread of range code and reflectance by standing elevation, smoothed over five degrees."""
    sums, rng = np.zeros((2, 3, BINS)), np.random.default_rng(0)
    for image in images:
        metres, reflectance, _, standing = grid(image, rng)
        returned = (metres > 0).numpy()
        place = np.clip(np.round(np.degrees(standing.numpy())[returned]) - LOWEST, 0, BINS - 1).astype(int)
        for channel, values in enumerate((encode_range(metres), 2 * reflectance - 1)):
            chosen = values.numpy()[returned]
            for power in range(3):
                sums[channel, power] += np.bincount(place, chosen**power, BINS)
    kernel = np.array([1, 2, 3, 2, 1]) / 9
    count, total, square = np.apply_along_axis(
        lambda s: np.convolve(np.pad(s, 2, mode="edge"), kernel, "valid"), 2, sums
    ).transpose(1, 0, 2)
    mean = total / np.maximum(count, 1e-9)
    spread = np.sqrt(np.maximum(square / np.maximum(count, 1e-9) - mean**2, 1e-4))
    seen, degrees = count[0] > 20, np.arange(BINS)
    tables = [[np.interp(degrees, degrees[seen], row[seen]) for row in table] for table in (mean, spread)]
    network.standard.copy_(torch.tensor(np.array(tables)))


def phases(experiment: Experiment, network: nn.Module) -> tuple[Phase, ...]:
    """The fills' parts and the coarse stage's; the standards of a fresh coarse stage are measured on virtual streets.

    With a base, the part alone of what is not shared with it.
    """
    assert isinstance(network, Cascade)
    likeliest: tuple[Phase, ...] = ()
    if network.likeliest is not None:
        likeliest = (Phase(LikeliestObjective(network.likeliest), "likeliest", count=_completed),)
    own = likeliest
    if network.observer is not None:
        objective = ObserverObjective(network.observer, network.surest, shining=not experiment.base)
        own = (*likeliest, Phase(objective, "observer", every=EVERY))
    if network.classes is not None and (experiment.model.own_classes or not experiment.base):
        own = (*own, Phase(NamingObjective(network.classes), "classes"))
    if experiment.base:
        return own
    if network.inside is not None:
        own = (*own, Phase(NamingObjective(network.inside, inside=True), "inside"))
    if bool((network.coarse.standard[1] == 1).all()):
        streets = VirtualStreets(experiment.training.seed + 1, FITTED)
        fit_standard(network.coarse, [streets.image(i) for i in range(0, FITTED, 4)])
    if network.guide is not None:
        network.guide.standard.copy_(network.coarse.standard)
    parts = (network.coarse, network.guide, network.columns, network.between, network.beams)
    return Phase(FillObjective(network.fill), "fill"), Phase(CoarseObjective(*parts), "coarse"), *own


def optimizers(experiment: Experiment, network: nn.Module) -> dict[str, torch.optim.Optimizer]:
    """AdamW for each stage; the coarse one, with all but the fills, at half the rate.

    With a base, for what is not shared with it.
    """
    assert isinstance(network, Cascade)
    training = experiment.training
    parts = (network.coarse, network.guide, network.columns, network.between, network.beams)
    stage = [parameter for part in parts if part is not None for parameter in part.parameters()]
    coarse = {"params": stage, "factor": 0.5}
    options = {"lr": training.learning_rate, "betas": training.betas, "weight_decay": 0.01}
    learned: dict[str, torch.optim.Optimizer] = {}
    if not experiment.base:
        learned["fill"] = torch.optim.AdamW(network.fill.parameters(), **options)
        learned["coarse"] = torch.optim.AdamW([coarse], **options)
    classes = network.classes if experiment.model.own_classes or not experiment.base else None
    inside = None if experiment.base else network.inside
    each = {"likeliest": network.likeliest, "observer": network.observer, "classes": classes, "inside": inside}
    for name, own in each.items():
        if own is not None:
            learned[name] = torch.optim.AdamW(own.parameters(), **options)
    return learned


@torch.no_grad()
def judge(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """Mean absolute errors of hidden pixels, in metres, with every second and every fourth beam known; with `classes`
    of its own, the share of labelled returns that get theirs."""
    assert isinstance(network, Cascade)
    errors: dict[str, float] = {}
    for every in (2, 4):
        for image in images:
            model = CascadeModel(network, image.sensor, experiment)
            known = np.zeros(image.shape, bool)
            known[::every] = True
            filled = model.complete(image.keep(known), known)
            error = float(np.abs(filled.range - image.range)[~known].mean())
            errors[f"beams_{every}"] = errors.get(f"beams_{every}", 0.0) + error / len(images)
    return errors | (_named_rightly(experiment, network, images) if experiment.model.own_classes else {})


def _named_rightly(experiment: Experiment, network: Cascade, images: Sequence[RangeImage]) -> dict[str, float]:
    """`classes`, where images have labels."""
    right = []
    for image in images:
        known = image.mask & (0 if image.label is None else image.label > 0)
        named = CascadeModel(network, image.sensor, experiment).with_labels().complete(image, np.ones_like(image.mask))
        right.append((named.label == image.label)[known.astype(bool)])
    every = np.concatenate(right)
    return {"classes": float(every.mean())} if len(every) else {}


def pictures(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of scans generated in the sensors of the images."""
    assert isinstance(network, Cascade)
    models = [CascadeModel(network, image.sensor, experiment) for image in images[:count]]
    return [strips(model.generate(1, seed=i)[0]) for i, model in enumerate(models)]


def _suits(experiment: Experiment, images: Images, learned: bool) -> None:
    """Raises ValueError where classes are to be learned from images that have none, and where samples are to be
    drawn in the beams of the grid from images that have fewer."""
    if learned and experiment.model.own_classes:
        check_labelled(images)
    if not learned or not isinstance(images, TrainingImages) or experiment.training.generation_share == 0:
        return
    of_any = isinstance(images, Streets) and not OF_ANY.isdisjoint(images.words)  # which have as many
    if not of_any and images.sensor.height < ROWS:
        raise ValueError(f"expected images of at least {ROWS} beams to learn to generate from, found "
                         f"{images.sensor.height}; `tuned` learns to complete any")  # fmt: skip


CASCADE = Task(
    parts=PARTS,
    draw=draw,
    phases=phases,
    judge=judge,
    pictures=pictures,
    optimizers=optimizers,
    buffers=False,
    suits=_suits,
)
