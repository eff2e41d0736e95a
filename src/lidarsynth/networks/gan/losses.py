"""Losses of the GANs: non-saturating, R1 and path length (StyleGAN2, Karras et al. 2020)."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F


def discriminator_loss(logits_real: Tensor, logits_fake: Tensor) -> Tensor:
    """softplus(-D(x)) + softplus(D(G(z))), each averaged over all elements; scalar."""
    return F.softplus(-logits_real).mean() + F.softplus(logits_fake).mean()


def generator_loss(logits_fake: Tensor) -> Tensor:
    """Non-saturating loss softplus(-D(G(z))), averaged over all elements; scalar. Goodfellow et al. 2014."""
    return F.softplus(-logits_fake).mean()


def r1_penalty(logits_real: Tensor, images: Tensor) -> Tensor:
    """Mean over the batch of |d sum D / d image|^2, differentiable; scalar. Mescheder et al. 2018.

    `images` (B,...) must require a gradient and `logits_real` be computed from them. The published loss is this times
    half the weight, times the interval between lazy steps: 16/2.
    """
    (gradient,) = torch.autograd.grad(logits_real.sum(), images, create_graph=True)
    return gradient.square().flatten(1).sum(1).mean()


def path_lengths(images: Tensor, w: Tensor, noise: Tensor) -> Tensor:
    """Lengths |J^T noise| / sqrt(H W), differentiable: images, noise (B,C,H,W), styles w (...,D) -> (...). StyleGAN2.

    `noise` ~ N(0,I). The published runs leave this term out (weight 0).
    """
    projection = (images * noise / math.sqrt(images.shape[2] * images.shape[3])).sum()
    (gradient,) = torch.autograd.grad(projection, w, create_graph=True)
    return gradient.square().sum(-1).sqrt()


def path_length_penalty(lengths: Tensor, running_mean: Tensor, decay: float = 0.01) -> tuple[Tensor, Tensor]:
    """(mean squared distance of the lengths to their running mean, the new running mean without gradient)."""
    running_mean = torch.lerp(running_mean, lengths.detach().mean(), decay)
    return (lengths - running_mean).square().mean(), running_mean
