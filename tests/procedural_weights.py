"""Weights of full-width reference networks that are computed, not stored: SplitMix64 of the key and the index."""

import hashlib
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn


def procedural_uniform(key: str, seed: int, count: int) -> np.ndarray:
    """`count` float32 numbers in [0,1), exact in float32."""
    start = int.from_bytes(hashlib.sha256(f"{seed}:{key}".encode("ascii")).digest()[:8], "little")
    out, chunk = np.empty(count, np.float32), 1 << 16  # a chunk stays in the cache
    for first in range(0, count, chunk):
        x = np.arange(first, min(first + chunk, count), dtype=np.uint64)
        x += np.uint64((start + 0x9E3779B97F4A7C15) % 2**64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            x ^= x >> np.uint64(shift)
            x *= np.uint64(factor)
        x ^= x >> np.uint64(31)
        out[first : first + len(x)] = (x >> np.uint64(40)) * np.float32(2**-24)
    return out


def procedural_tensor(key: str, seed: int, shape: torch.Size, low: float, high: float) -> Tensor:
    u = procedural_uniform(key, seed, shape.numel())
    u *= np.float32(high) - np.float32(low)
    u += np.float32(low)
    return torch.from_numpy(u).view(shape)


GAN_RANGES = [  # (which keys, range), the first that fits counts
    (lambda key: key.endswith("ema_var"), (0.5, 1.5)),
    (lambda key: key.endswith("phase"), (0.0, 6.28)),
    (lambda key: key.endswith("w_avg"), (-0.5, 0.5)),
    (lambda key: key.startswith("mapping_network") and key.endswith("weight"), (-170.0, 170.0)),
    (lambda key: key.startswith("mapping_network"), (-50.0, 50.0)),
    (lambda key: key.endswith("bias"), (-0.5, 0.5)),
    (lambda key: True, (-1.7, 1.7)),
]


def gan_weights(structure: dict[str, Tensor], seed: int, freq_tables: dict[str, Any]) -> dict[str, Tensor]:
    """Weights of the full-size GAN fixtures for a state dict of that structure; filters and constants stay."""
    weights = {}
    for key, value in structure.items():
        if key.endswith(("kernel", "raydrop_const")):
            weights[key] = value
        elif key.endswith("freqs"):
            u = procedural_uniform(key, seed, 2 * len(value)).reshape(-1, 2)
            table = np.array(freq_tables[key]["azimuth_list"], np.float32)
            elevation = (2 * u[:, 0] - 1) * np.float32(freq_tables[key]["band_h"])
            azimuth = table[np.floor(u[:, 1] * len(table)).astype(int)]
            weights[key] = torch.from_numpy(np.stack([elevation, azimuth], 1)).view(value.shape)
        else:
            low, high = next(limits for fits, limits in GAN_RANGES if fits(key))
            weights[key] = procedural_tensor(key, seed, value.shape, low, high)
    return weights


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
    value = np.float32(low) + np.float32(high - low) * procedural_uniform(key, seed, like.numel())
    return torch.from_numpy(value).view(like.shape)
