"""Experiment -> objects: the only place that assembles a model; and our folder format, save and load."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import SCHEDULES, Schedule, ve
from lidarsynth.experiment.folder import RECORD, WEIGHTS, read_experiment
from lidarsynth.experiment.record import Adversarial, Experiment, Score, Segmentation, Upsampling
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.conditional import CANDIDATES, ConditionalUNet
from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.gan import dcgan as gan
from lidarsynth.networks.gan import dusty2
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.interpolation import METHODS, Interpolation
from lidarsynth.networks.lidar_sr import LidarSR
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.networks.refinenet import RefineNet, geometric_sigmas
from lidarsynth.networks.tensors import load_weights

GANS = ("vanilla-gan", "dusty-v1", "dusty-v2")
UPSAMPLERS = ("lidar-sr", "iln", "liif")  # networks that put beams between known ones


def build_network(experiment: Experiment) -> nn.Module:
    """The experiment's network with fresh weights and, where it has them, the sensor's ray angles; for evaluation.

    Raises ValueError for a word that is not in NETWORKS.
    """
    word = experiment.model.network
    if word not in NETWORKS:
        raise ValueError(f"model.network: expected one of {', '.join(NETWORKS)}, found {word!r}")
    return NETWORKS[word](experiment, build_sensor(experiment)).eval()


def _unet(experiment: Experiment, sensor: Sensor, in_channels: int = 2, out_channels: int = 2) -> EfficientUNet:
    model = experiment.model
    unet = EfficientUNet(
        in_channels=in_channels,
        out_channels=out_channels,
        resolution=(sensor.height, sensor.width),
        base_channels=model.base_channels,
        temb_channels=model.temb_channels,
        channel_multipliers=model.channel_multipliers,
        num_residual_blocks=model.num_residual_blocks,
        gn_num_groups=model.gn_num_groups,
        gn_eps=model.gn_eps,
        attn_num_heads=model.attn_num_heads,
        coords_encoding=model.coords_encoding,
        ring=model.ring,
        stem=model.stem,
        dropout=model.dropout,
    )
    unet.coords.copy_(torch.from_numpy(sensor.ray_angles())[None])
    return unet


def _refinenet(experiment: Experiment, sensor: Sensor) -> RefineNet:
    """For images in [-1, 1]: with a score group the published score network, else a noise predictor."""
    score = experiment.score or Score()
    divide = experiment.diffusion.kind == "score"
    network = RefineNet(2, experiment.model.base_channels, score.levels, unit_range=False, divide=divide)
    network.sigmas.copy_(geometric_sigmas(score.levels, score.sigma_max, score.sigma_min))
    return network


def _conditional(experiment: Experiment, sensor: Sensor) -> ConditionalUNet:
    model = experiment.model
    return ConditionalUNet(_unet(experiment, sensor, 8, 2 * (1 + CANDIDATES + model.around) if model.candidates else 2))


def _rangenet(experiment: Experiment, sensor: Sensor) -> RangeNet:
    layers = (experiment.segmentation or Segmentation()).layers
    return RangeNet(layers, experiment.model.base_channels, dropout=experiment.model.dropout)


def _lidar_sr(experiment: Experiment, sensor: Sensor) -> LidarSR:
    model, group = experiment.model, experiment.upsampling or Upsampling()
    return LidarSR(group.factor, model.base_channels, model.dropout, group.keras)


def _iln(experiment: Experiment, sensor: Sensor) -> ILN:
    model, group = experiment.model, experiment.upsampling or Upsampling()
    blocks = sum(model.num_residual_blocks)
    return ILN(group.depth, model.attn_num_heads, model.base_channels, blocks, model.dropout)


def _liif(experiment: Experiment, sensor: Sensor) -> LIIF:
    channels = experiment.model.base_channels
    return LIIF(channels, 4 * channels, sum(experiment.model.num_residual_blocks))


def _interpolation(experiment: Experiment, sensor: Sensor) -> Interpolation:
    return Interpolation(experiment.model.network)


def _gan(experiment: Experiment, sensor: Sensor) -> ScanGenerator:
    """The generator of a GAN of inverse depth. Raises ValueError for another codec."""
    model, group, codec = experiment.model, experiment.adversarial or Adversarial(), experiment.data.codec
    if codec not in ("inverse", "inverse-minmax"):
        raise ValueError(f"data.codec: expected inverse or inverse-minmax for {model.network}, found {codec!r}")
    size, widths = (sensor.height, sensor.width), (model.base_channels, group.max_channels)
    if model.network == "dusty-v2":
        latents = (group.latent_channels, group.style_channels)
        angles = torch.from_numpy(sensor.ray_angles())[None]
        return ScanGenerator(dusty2.Generator(size, *latents, *widths, group.temperature), angles)
    drops = model.network == "dusty-v1"
    return ScanGenerator(gan.Generator(size, group.latent_channels, *widths, drops, group.iros21, group.temperature))


def build_discriminator(experiment: Experiment) -> nn.Module:
    """What a GAN's generator is trained against, with fresh weights: images (B, 1, H, W) -> logits, large = real."""
    model, group, sensor = experiment.model, experiment.adversarial or Adversarial(), build_sensor(experiment)
    size = (sensor.height, sensor.width)
    widths = (group.discriminator_channels or model.base_channels, group.max_channels)
    if model.network == "dusty-v2":
        return dusty2.Discriminator(size, *widths)
    return gan.Discriminator(size, *widths, vertical="reflect" if group.iros21 else "replicate")


def _cascade(experiment: Experiment, sensor: Sensor) -> Cascade:
    model, width = experiment.model, experiment.model.base_channels
    if len(set(model.num_residual_blocks)) > 1:
        raise ValueError(f"model.num_residual_blocks: expected as many at each level of a cascade, found "
                         f"{model.num_residual_blocks}")  # fmt: skip
    coarse = CoarseUNet(width, model.channel_multipliers, model.num_residual_blocks[0])
    return Cascade(coarse, FillUNet((width, width * 3 // 2, width * 2, width * 5 // 2)))


NETWORKS: dict[str, Callable[[Experiment, Sensor], nn.Module]] = {
    "cascade": _cascade,
    "efficient-unet": _unet,
    "conditional-unet": _conditional,
    "rangenet": _rangenet,
    "refinenet": _refinenet,
    "lidar-sr": _lidar_sr,
    "iln": _iln,
    "liif": _liif,
    **dict.fromkeys(METHODS, _interpolation),
    **dict.fromkeys(GANS, _gan),
}


def build_denoiser(experiment: Experiment, network: nn.Module) -> Denoiser:
    """The network with the experiment's schedule and kind."""
    diffusion = experiment.diffusion
    if diffusion.schedule not in SCHEDULES:
        raise ValueError(f"diffusion.schedule: expected one of {', '.join(SCHEDULES)}, found {diffusion.schedule!r}")
    return Denoiser(network, _schedule(experiment), diffusion.kind, diffusion.clip)


def _schedule(experiment: Experiment) -> Schedule:
    """Images here lie in [-1, 1], twice as wide as those of the score group, and so are its noise levels."""
    if experiment.score is None:
        return SCHEDULES[experiment.diffusion.schedule]()
    if experiment.diffusion.schedule != "ve":
        raise ValueError(f"diffusion.schedule: expected ve beside a score group, found {experiment.diffusion.schedule}")
    return ve(2 * experiment.score.sigma_min, 2 * experiment.score.sigma_max)


def load_folder(folder: str | Path) -> tuple[Experiment, nn.Module]:
    """A saved model: its experiment and its network. Raises ValueError when either file is not as it should be."""
    experiment, path = read_experiment(folder), Path(folder) / WEIGHTS
    network = build_network(experiment)
    try:
        weights = load_file(path)
    except FileNotFoundError:
        raise ValueError(f"{folder}: expected {WEIGHTS} beside {RECORD}, found none") from None
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: expected safetensors weights, found {error}") from None
    load_weights(network, weights, str(path))
    return experiment, network
