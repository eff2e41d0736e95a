"""How far the layouts that a cascade draws are from those of streets, and whether drafts or columns are to blame.

python benchmarks/layouts.py hdl-64e-kitti vlp-16 [--model default] [--grids 128] [--seed 4711]

Of each sensor, grids of held-out streets, of other ones (the floor), drawn after drafts of true grids with noise, and
drawn as generation draws them. Against the first, all others:

- the distance of numbers that each scene has (Wasserstein's, in standard deviations of the streets'): shares of its
  rays that meet something above the ground nearer than 3, 6, 10 and 25 m, and that return, the mean of ln range, and
  how far it is to what stands at either side (the nearer, the farther), ahead and behind;
- the power of waves of ln range along the turn, relative, longer than 120 degrees, than 60, 30, 15 and 8, and down to
  5.6: below 1, too smooth;
- the share of neighbours along a ring whose ln ranges differ by more than 0.02, 0.16 and 0.5, relative.

A minute of a core a sensor: what to look at after every change of drafts or columns, before scans are judged.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from lidarsynth.diffusion.samplers import generators, noise_like
from lidarsynth.networks.coarse_unet import left_filled
from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.drafts import drafted
from lidarsynth.networks.grid_judge import NEAR, STANDS
from lidarsynth.networks.rays import decode_range
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.images import grid_of
from lidarsynth.systems.cascade.layout import DRAFT, draft, told_of
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.weights.load import load

SEED, TOGETHER, EACH = 4711, 32, 16  # of held-out streets, and every so many of their images is another street's
EDGES = (0.02, 0.16, 0.5)  # of ln range
WAVES = (1, 3, 6, 12, 24, 45, 65)  # waves a turn, of bands
NOTHING = 80.0  # metres to what stands where nothing does


def scene_numbers(metres: np.ndarray, elevation: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """(B, 10) of grids (B, 16, 128) in metres, 0 for no return, whose columns begin behind and turn right; elevation in
    radians and the way to flat ground in metres, each (16, 1)."""
    returned = metres > 0
    stands = returned & (metres < STANDS * flat)
    shares = [(stands & (metres < near)).mean((1, 2)) for near in NEAR]
    mean = [np.log(one[one > 0]).mean() if (one > 0).any() else 0 for one in metres]
    free = np.where(stands, metres * np.cos(elevation), NOTHING).min(1)
    azimuth = np.pi - 2 * np.pi * np.arange(metres.shape[-1]) / metres.shape[-1]
    sides = [np.median(free[:, part > 0.8], 1) for part in (np.sin(azimuth), -np.sin(azimuth))]
    ends = [np.median(free[:, part > 0.9], 1) for part in (np.cos(azimuth), -np.cos(azimuth))]
    both = [pick(pair, axis=0) for pair in (sides, ends) for pick in (np.min, np.max)]
    return np.stack([*shares, returned.mean((1, 2)), mean, *both], 1)


def waves(metres: Tensor) -> np.ndarray:
    """(6,) power of ln range of grids (B, 16, 128) along the turn, by bands of WAVES."""
    log_range = left_filled(metres.clamp(min=0.1).log()[:, None], metres > 0)[:, 0]
    power = torch.fft.rfft(log_range - log_range.mean((0, 2), keepdim=True)).abs().square().mean((0, 1))
    return np.array([power[first:end].mean().item() for first, end in pairwise(WAVES)])


def edges(metres: Tensor) -> np.ndarray:
    """(3,) shares of neighbours along a ring whose ln ranges differ by more than EDGES."""
    beside, log_range = metres.roll(1, -1), metres.clamp(min=0.1).log()
    step = (log_range - log_range.roll(1, -1)).abs()[(metres > 0) & (beside > 0)]
    return np.array([(step > one).float().mean().item() for one in EDGES])


def layouts(model: CascadeModel, count: int, seed: int) -> Iterator[tuple[str, Tensor]]:
    """Grids (count, 16, 128) in metres: of streets, other ones, drawn after drafts of true ones, and as generated."""
    network, sensor = model.network, model.sensor
    assert network.columns is not None
    rows, columns = grid_of(sensor)
    streets = SyntheticStreets(seed, 2 * count * EACH, sensor)
    images = [streets.image(EACH * k) for k in range(2 * count)]
    true = told_of(images, rows, columns)
    metres = decode_range(true.code) * true.returned
    yield "streets", metres[:count]
    yield "other streets", metres[count:]
    drawn: tuple[list[Grid], list[Grid]] = [], []
    for first in range(0, count, TOGETHER):
        part = slice(first, min(first + TOGETHER, count))
        rng = generators(first, part.stop - first)
        rays, standing = model._grid_rays(rows, columns, count=len(rng))
        x_0 = network.coarse.encode(metres[part], true.shade[part], standing)
        t = torch.full((len(rng),), DRAFT)
        _, alpha, sigma = network.coarse.schedule.at(t, x_0)
        perfect = drafted(network.coarse, alpha * x_0 + sigma * noise_like(x_0, rng), t, rays, standing)
        for kind, after in zip(drawn, (perfect, draft(network, rays, standing, rng)), strict=True):
            kind.append(draw(network.columns, rays, after, rng))
    for word, kind in zip(("after true drafts", "drawn"), drawn, strict=True):
        yield word, torch.cat([decode_range(grid.code) * grid.returned for grid in kind])


def report(model: CascadeModel, count: int, seed: int) -> Iterator[str]:
    """A line for each kind of layouts but the streets'."""
    elevation = np.deg2rad(np.asarray(model.sensor.elevations)[grid_of(model.sensor)[0]])[:, None]
    flat = np.where(elevation < -0.005, model.sensor.mount / np.sin(-elevation).clip(1e-3), np.inf)
    kinds = layouts(model, count, seed)
    _, streets = next(kinds)
    expected = scene_numbers(streets.numpy(), elevation, flat)
    for word, metres in kinds:
        pairs = zip(scene_numbers(metres.numpy(), elevation, flat).T, expected.T, strict=True)
        far = [wasserstein_distance(*pair) for pair in pairs] / (expected.std(0) + 1e-6)
        yield (f"{word:18} {far.mean():.3f} ({_listed(far)}); waves {_listed(waves(metres) / waves(streets))}; "
               f"edges {_listed(edges(metres) / edges(streets))}")  # fmt: skip


def _listed(numbers: np.ndarray) -> str:
    return " ".join(f"{one:.2f}" for one in numbers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", nargs="+")
    parser.add_argument("--model", default="default")
    parser.add_argument("--grids", type=int, default=128)
    parser.add_argument("--seed", type=int, default=SEED, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for sensor in args.sensors:
        model = load(args.model)
        if not isinstance(model, CascadeModel) or model.network.columns is None:
            parser.error(f"expected a cascade that draws columns, found {args.model}")
        print(f"{sensor}, {args.grids} grids")
        with torch.inference_mode():
            for line in report(model.into(sensor), args.grids, args.seed):
                print(line, flush=True)


if __name__ == "__main__":
    main()
