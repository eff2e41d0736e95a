"""Every network at 64 x 1024: parameters, GFLOP and milliseconds of one evaluation for one scan.

python benchmarks/models.py                                 all, on this CPU with its threads
python benchmarks/models.py r2dm-h default --threads 1      some of them
python benchmarks/models.py --device cuda --batch-size 8    on a GPU, eight scans at once

One evaluation is one call of the network: a denoising or Langevin step of a diffusion model, a scan of a GAN, a pass of
LiDAR-SR, all pixels of ILN. GFLOP are 2 for each multiplication in a matrix product or convolution. Weights are random.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.networks.fill_unet import NOISES, Known
from lidarsynth.networks.interpolation import METHODS
from lidarsynth.networks.pointnet import PointNet
from lidarsynth.networks.rays import Rays, padded
from lidarsynth.systems.cascade.known import known_of, rays_told
from lidarsynth.systems.gan.build import build_discriminator
from lidarsynth.systems.gan.family import GAN
from lidarsynth.systems.table import SYSTEMS, build_network
from lidarsynth.systems.upsampling.model import queries_at

ROWS = (
    *("r2dm-h", "default", "lidargen", "r2dm-refinenet", "vanilla-gan", "dusty-v1", "dusty-v2"),
    *("lidar-sr", "iln", "iln-0d", "iln-2d", "liif", "nearest", "bilinear", "bicubic"),
    *("rangenet-53", "rangenet-21", "rangenet-street", "pointnet"),
)


def wide(name: str) -> Experiment:
    """The preset with images of 64 x 1024."""
    return with_fields(preset(name), {"data.height": 64, "data.width": 1024})


def call_of(experiment: Experiment, network: nn.Module, count: int, device: str) -> Callable[[], object]:
    """One evaluation for `count` scans."""
    word, height, width = experiment.model.network, experiment.data.height, experiment.data.width
    image = torch.randn(count, 2, height, width, device=device)
    if SYSTEMS[word] is GAN:
        z = torch.randn(count, network.latent_channels, device=device)  # type: ignore[arg-type]
        return lambda: network(z, torch.full((1, 1, 1, 1), 0.5, device=device))
    if word == "conditional-unet":
        mask = torch.zeros_like(image)
        mask[:, :, ::4] = 1
        return lambda: network(image, torch.zeros((), device=device), image, mask)
    if word == "cascade":  # all pixels of a scan, in one step
        sensor, shape = build_sensor(experiment), (count, height, width)
        metres, told = np.random.default_rng(0).uniform(2, 80, shape).astype(np.float32), np.zeros(shape, bool)
        told[:, ::4] = True
        known = Known(*(part.to(device) for part in known_of(metres, metres / 80, told, True, padded(sensor))))
        rays = Rays(*(part.to(device).expand(count, *part.shape[1:]) for part in rays_told(sensor)))
        noise = torch.zeros(count, NOISES, *padded(sensor), device=device)
        return lambda: network.surest(known, rays, noise)  # type: ignore[union-attr]
    if word in METHODS:
        mask = torch.zeros_like(image)
        mask[:, :, ::4] = 1
        return lambda: network(image, mask)
    low = image[:, :1, ::4]
    if word == "lidar-sr":
        return lambda: network(low)
    if word in ("iln", "liif"):
        asked = queries_at(np.arange(height) / 4, np.arange(width), (height // 4, width)).to(device)
        return lambda: _in_pieces(network, low, asked)
    if word == "rangenet":
        return lambda: network(torch.randn(count, 5, height, width, device=device))
    return lambda: network(image, torch.zeros((), device=device))


def _in_pieces(network: nn.Module, low: Tensor, asked: Tensor) -> None:
    """All queries, so many at once as `UpsamplingModel` takes."""
    features = network.encode(low)  # type: ignore[operator]
    for piece in asked.split(16_384):
        network.decode(low, features, piece.expand(len(low), -1, -1))  # type: ignore[operator]


@torch.no_grad()
def measured(call: Callable[[], object], repeats: int, device: str) -> tuple[float, float]:
    """FLOP and the shortest time in seconds of a call: other work on the machine only adds."""
    with FlopCounterMode(display=False) as counter:
        call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return counter.get_total_flops(), min(times)


def count(network: nn.Module) -> int:
    """Parameters."""
    return sum(p.numel() for p in network.parameters())


def row(name: str, scans: int, repeats: int, device: str) -> tuple[str, float, float]:
    """Parameters as words, and GFLOP and milliseconds for one scan."""
    if name == "pointnet":
        pointnet = PointNet().eval().to(device)
        points = torch.randn(scans, 3, 64 * 1024, device=device)
        flop, seconds = measured(lambda: pointnet(points), repeats, device)
        return f"{count(pointnet):,}", flop / scans / 1e9, seconds / scans * 1e3
    experiment = wide(name)
    network = build_network(experiment).to(device)
    flop, seconds = measured(call_of(experiment, network, scans, device), repeats, device)
    words = f"{count(network):,}"
    if SYSTEMS[experiment.model.network] is GAN:
        words += f" + {count(build_discriminator(experiment)):,}"
    assert build_sensor(experiment).width == 1024
    return words, flop / scans / 1e9, seconds / scans * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=ROWS, metavar="MODEL", help=", ".join((*PRESETS, "pointnet")))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch-size", type=int, default=1, help="scans at once")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    if unknown := [name for name in args.models if name not in (*PRESETS, "pointnet")]:
        parser.error(f"expected models of {', '.join((*PRESETS, 'pointnet'))}, found {', '.join(unknown)}")
    torch.set_num_threads(args.threads)
    where = f"{args.threads} threads" if args.device == "cpu" else torch.cuda.get_device_name(args.device)
    print(f"| network | parameters (+ discriminator) | GFLOP | ms, {where} | times the first row's speed |")
    print("|---|---:|---:|---:|---:|")
    first = None
    for name in args.models:
        words, gigaflop, milliseconds = row(name, args.batch_size, args.repeats, args.device)
        first = first or milliseconds
        print(f"| {name} | {words} | {gigaflop:.1f} | {milliseconds:.1f} | {first / milliseconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
