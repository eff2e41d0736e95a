"""Weights of full-width reference networks that are computed, not stored (shared/fixtures/README_baselines.md)."""

import hashlib
import math

import numpy as np
import torch
from torch import Tensor, nn


def uniforms(key: str, seed: int, count: int) -> np.ndarray:
    """u(key, seed, i) in [0, 1), i = 0 .. count - 1, float32: SplitMix64 from the SHA-256 of the name."""
    digest = hashlib.sha256(f"{seed}:{key}".encode("ascii")).digest()
    x = np.frombuffer(digest[:8], "<u8")[0] + np.arange(count, dtype=np.uint64)
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return ((x >> np.uint64(40)).astype(np.float64) / 2**24).astype(np.float32)


def upsampling_weights(network: nn.Module, seed: int) -> dict[str, Tensor]:
    """Every tensor of a LiDAR-SR, ILN or LIIF network by the rules of the fixtures."""
    return {key: upsampling_weight(key, value, seed) for key, value in network.state_dict().items()}


def upsampling_weight(key: str, like: Tensor, seed: int) -> Tensor:
    if key.endswith("num_batches_tracked"):
        return torch.zeros_like(like)
    if key.endswith("running_mean"):
        low, high = -0.2, 0.2
    elif key.endswith("running_var"):
        low, high = 0.5, 1.5
    elif like.ndim == 1:
        low, high = (0.7, 1.3) if key.endswith("weight") else (-0.2, 0.2)
    else:
        gain = 24 if key.startswith("attention.") else 4
        high = float(np.float32(round(math.sqrt(gain / like[0].numel()), 5)))
        low = -high
    value = np.float32(low) + np.float32(high - low) * uniforms(key, seed, like.numel())
    return torch.from_numpy(value).view(like.shape)
