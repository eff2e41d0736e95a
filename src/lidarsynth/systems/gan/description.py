"""What is said of GANs."""

from __future__ import annotations

import torch

from lidarsynth.experiment.record import Adversarial, Experiment
from lidarsynth.systems.description import About, Description
from lidarsynth.systems.gan.build import build_discriminator

PAPERS = {
    "vanilla-gan": "Caccia et al., IROS 2019",
    "dusty-v1": "Nakashima & Kurazume, IROS 2021",
    "dusty-v2": "Nakashima et al., WACV 2023, arXiv 2210.11750",
}


def _network(experiment: Experiment) -> str:
    group, model = experiment.adversarial or Adversarial(), experiment.model
    made = f"latents of {group.latent_channels}, base {model.base_channels}, at most {group.max_channels} channels"
    second = " with a mask of images (DUSty-II)" if group.image_mask else ""
    return f"generator of {model.network}{second}, {made}; range only"


def _discriminator(experiment: Experiment) -> dict[str, str]:
    with torch.device("meta"):  # counted without memory
        count = sum(parameter.numel() for parameter in build_discriminator(experiment).parameters())
    group = experiment.adversarial or Adversarial()
    r1 = f"R1 of weight {group.r1_weight:g} every {group.r1_every} steps" if group.r1_weight else "no R1"
    return {"discriminator": f"{count:,} parameters, in training only; {r1}"}


def _about(experiment: Experiment) -> About:
    word = experiment.model.network
    return About(
        f"A generative adversarial network that generates the ranges of LiDAR scans, without reflectance, made with "
        f"lidarsynth after {word} ({PAPERS[word]}).",
        ('model = ls.load("{repo_id}")', "images = model.generate(4, seed=0)",
         'dense = model.complete(ls.read("scan.pcd"))  # by inversion'),
        ("gan",),
    )  # fmt: skip


DESCRIPTION = Description(_network, _discriminator, _about)
