"""How the cascade learns: the fill by absolute errors and by energy scores, the coarse stage by flow matching."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import flow
from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.between_beams import BetweenBeams
from lidarsynth.networks.between_columns import BetweenColumns
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import BINS, COLUMNS, LOWEST, CoarseUNet
from lidarsynth.networks.column_neighbours import Grid, known_grid, spoilt
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import NOISES, Filled, FillUNet, Known, draw_noise
from lidarsynth.networks.rays import Rays, decode_range, encode_range
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade.examples import CascadeBatch, Crops, draw, grid
from lidarsynth.systems.cascade.layout import BOUND
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.speckle import calmed
from lidarsynth.systems.diffusion.validation import strips
from lidarsynth.training.randomness import sample_rng
from lidarsynth.training.task import Phase, Task

DARK = -0.15  # what the fill learns where a return reads 0
SEAM = 16  # columns at the ends of a crop that are not judged: beyond them its turn would go on
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
            return crops.metres[:0, 0, 0, 0]
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
            return metres[:, 0, 0, 0]
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
            return {"likeliest": metres[:, 0, 0, 0]}
        known = known._replace(reflectance=calmed(known.reflectance, known.metres, known.lit))
        filled = self.network(known, rays, metres.new_zeros(len(metres), NOISES, *metres.shape[2:]))
        return {"likeliest": expected_errors(filled, known, rays, metres, reflectance)}


class CoarseObjective(nn.Module):
    """`objective(batch)` -> `layout` (n,): squared error of the velocity (Lipman et al. 2023), t = sigmoid(1.1 N);
    `guide`, that of the network that guides; `columns`, negative log-likelihoods of half of the columns; `between`, of
    every second column of finer grids; `beams`, of every second beam of taller ones; of what there is."""

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
        t = torch.sigmoid(1.1 * torch.cat([torch.randn(1, generator=rng) for rng in rngs])).to(x_0)
        eps = torch.stack([torch.randn(x_0.shape[1:], generator=rng) for rng in rngs]).to(x_0)
        learners = {"layout": self.network, **({"guide": self.guide} if self.guide else {})}
        denoisers = {part: Denoiser(one, flow(BOUND), "velocity", clip=False, condition=(rays,))
                     for part, one in learners.items()}  # fmt: skip
        losses = {part: denoiser.loss(x_0, t, eps, gamma=None) for part, denoiser in denoisers.items()}
        if self.columns is not None:
            rng = sample_rng(batch.crops.seeds[0], 2, 0)
            whole = known_grid(metres, reflectance)
            judged = torch.randperm(COLUMNS, generator=rng)[: COLUMNS // 2].to(rays.device)
            losses["columns"] = self.columns(whole, rays, judged, spoilt(whole, rng)).sum(1)
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


def _part(crops: Crops, chosen: slice) -> tuple[Known, Rays, Tensor, Tensor, Tensor]:
    known, rays = (type(part)(*(t[chosen] for t in part)) for part in (crops.known, crops.rays))
    return known, rays, crops.metres[chosen], crops.reflectance[chosen], crops.classes[chosen]  # type: ignore[return-value]


def absolute_errors(filled: Filled, known: Known, rays: Rays, metres: Tensor, reflectance: Tensor) -> Tensor:
    """(b,): of hidden returns, in code and metres, and of their reflectance; and the cross-entropy of returning.

    The absolute error has the median as its optimum, in metres and in any code alike.
    """
    inside, returned = rays.inside > 0, metres > 0
    hidden = ~known.told & inside
    sought = hidden & returned & ~known.returned
    code = _mean((filled.code - encode_range(metres)).abs(), sought)
    far = _mean((decode_range(filled.code) - metres).abs(), sought)
    shade = _mean((filled.reflectance - _dark(reflectance, returned)).abs(), ~known.lit & inside & returned)
    drop = _mean(F.binary_cross_entropy_with_logits(filled.logit, returned.float(), reduction="none"), hidden)
    return 2 * code + 0.1 * far + 6 * shade + 0.5 * drop


def expected_errors(filled: Filled, known: Known, rays: Rays, metres: Tensor, reflectance: Tensor) -> Tensor:
    """(b,): errors of hidden pixels as they are judged, where an empty one counts as 0 m and reflects nothing, by the
    chance of returning; with those of `absolute_errors`, less of each.

    So what may as well be empty is nearer, and is empty where that errs less.
    """
    inside, returned = rays.inside > 0, metres > 0
    hidden = ~known.told & ~known.returned & inside
    chance, far = torch.sigmoid(2 * filled.logit), decode_range(filled.code)
    off = torch.where(returned, chance * (far - metres).abs() + (1 - chance) * metres, chance * far)
    dark = (filled.reflectance - reflectance).abs()
    shade = torch.where(returned, chance * dark + (1 - chance) * reflectance, chance * filled.reflectance.abs())
    code = _mean((filled.code - encode_range(metres)).abs(), hidden & returned)
    lit = _mean(dark, ~known.lit & inside & returned)
    drop = _mean(F.binary_cross_entropy_with_logits(filled.logit, returned.float(), reduction="none"), hidden)
    return 1.5 * code + 0.25 * _mean(off, hidden) + 4 * _mean(shade, hidden) + 3 * lit + 0.35 * drop


def _dark(reflectance: Tensor, returned: Tensor) -> Tensor:
    """Reflectance with DARK in the place of 0, so that draws of it, which are cut at 0, are often 0."""
    return torch.where(returned & (reflectance <= 0), DARK, reflectance)


def misnamed(filled: Filled, rays: Rays, classes: Tensor) -> Tensor:
    """(b,): cross-entropy of the classes (b, 1, H, W) of all pixels of which somebody has said one."""
    assert filled.classes is not None
    entropy = F.cross_entropy(filled.classes, classes[:, 0], reduction="none")[:, None]
    return _mean(entropy, (classes > 0) & (rays.inside > 0))


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """(b,) means over `mask`, but for the crop's ends."""
    values, mask = values[..., SEAM:-SEAM], mask[..., SEAM:-SEAM]
    return (values * mask).sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1)


def joined(filled: Filled, known: Known, rays: Rays) -> Tensor:
    """What energy scores compare, (b, 3, H, W): returns, range and reflectance, with known pixels as they are."""
    share = torch.where(known.told, known.returned.float(), filled.logit.sigmoid())
    code = torch.where(known.returned, encode_range(known.metres), filled.code)
    shade = torch.where(known.lit, _dark(known.reflectance, known.lit), filled.reflectance)
    return _comparable(share, code, shade, rays)


def truth(metres: Tensor, reflectance: Tensor, rays: Rays) -> Tensor:
    """`joined` of what was measured."""
    returned = metres > 0
    return _comparable(returned.float(), encode_range(metres), _dark(reflectance, returned), rays)


def _comparable(share: Tensor, code: Tensor, shade: Tensor, rays: Rays) -> Tensor:
    x = torch.cat([2 * share - 1, 3 * share * (code - encode_range(rays.ground)), 3 * share * shade], 1)
    return (x * (rays.inside > 0))[..., SEAM:-SEAM]


def energy_score(first: Tensor, second: Tensor, truth: Tensor) -> Tensor:
    """(b,): E|X - y| - E|X - X'| / 2 of two draws, lowest when draws are distributed as the truth (Gneiting & Raftery
    2007), summed over pixels and patches of values, and of differences to the next pixel along a ring and below, for
    texture."""
    total = truth.new_zeros(len(truth))
    for size, weight in (((1, 1), 1.0), ((2, 4), 1.0), ((8, 16), 0.5)):
        total = total + weight * _score(first, second, truth, size)
    for a, b, y in zip(*map(_differences, (first, second, truth)), strict=True):
        for size in ((1, 1), (2, 8)):
            total = total + 0.5 * _score(a, b, y, size)
    return total


def _score(first: Tensor, second: Tensor, truth: Tensor, size: tuple[int, int]) -> Tensor:
    to_truth = (_distance(first, truth, size) + _distance(second, truth, size)) / 2
    return to_truth - _distance(first, second, size) / 2


def _distance(a: Tensor, b: Tensor, size: tuple[int, int]) -> Tensor:
    """(b,): Euclidean distances of patches, on average."""
    squares = (a - b).square().sum(1, keepdim=True)
    if size != (1, 1):
        squares = F.avg_pool2d(squares, size)
    return (squares + 1e-6).sqrt().mean((1, 2, 3))


def _differences(x: Tensor) -> tuple[Tensor, Tensor]:
    """Steps along a ring and to the beam below, of range (small ones stretched) and reflectance."""
    steps = x[:, 1:, :, 1:] - x[:, 1:, :, :-1], x[:, 1:, 1:] - x[:, 1:, :-1]
    along, down = (torch.cat([torch.asinh(12 * d[:, :1]) / 2, d[:, 1:]], 1) for d in steps)
    return along, down


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
    likeliest = () if network.likeliest is None else (Phase(LikeliestObjective(network.likeliest), "likeliest"),)
    if experiment.base:
        return likeliest
    if bool((network.coarse.standard[1] == 1).all()):
        streets = VirtualStreets(experiment.training.seed + 1, FITTED)
        fit_standard(network.coarse, [streets.image(i) for i in range(0, FITTED, 4)])
    if network.guide is not None:
        network.guide.standard.copy_(network.coarse.standard)
    parts = (network.coarse, network.guide, network.columns, network.between, network.beams)
    return Phase(FillObjective(network.fill), "fill"), Phase(CoarseObjective(*parts), "coarse"), *likeliest


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
    if network.likeliest is not None:
        learned["likeliest"] = torch.optim.AdamW(network.likeliest.parameters(), **options)
    return learned


@torch.no_grad()
def judge(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """Mean absolute errors of hidden pixels, in metres, with every second and every fourth beam known."""
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
    return errors


def pictures(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of scans generated in the sensors of the images."""
    assert isinstance(network, Cascade)
    models = [CascadeModel(network, image.sensor, experiment) for image in images[:count]]
    return [strips(model.generate(1, seed=i)[0]) for i, model in enumerate(models)]


CASCADE = Task(
    parts=("sample", "median", "likeliest", "layout", "guide", "columns", "between", "beams"),
    draw=draw,
    phases=phases,
    judge=judge,
    pictures=pictures,
    optimizers=optimizers,
    buffers=False,
)
